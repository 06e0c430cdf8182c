"""Load on the shaft: the load machine that a simulated drive carries in its object dictionary."""

from drivers.canopen.network import CanopenNetwork
from drivers.errors import BadInput, TransferAborted
from virtual_bus.drive.servo_objects import LOAD_MACHINE

LOAD_TORQUE_SUB = 1
NM_PER_COUNT = 1e-3


class ObjectLoadMachine:
    """Sets the load torque by a confirmed SDO write that does not block: 0x2100:1, INTEGER32, mN m."""

    def __init__(self, network: CanopenNetwork, node_id: int) -> None:
        self._network = network
        self._node_id = node_id

    def set_torque(self, torque_nm: float) -> None:
        self._network.post_download(self._node_id, LOAD_MACHINE, LOAD_TORQUE_SUB, _raw(torque_nm))

    def take_off(self) -> None:
        """Take the load off the shaft and wait for the confirmation. Raises PeerFault."""
        self._network.download(self._node_id, LOAD_MACHINE, LOAD_TORQUE_SUB, _raw(0.0))


def _raw(torque_nm: float) -> bytes:
    return round(torque_nm / NM_PER_COUNT).to_bytes(4, "little", signed=True)


def find_load_machine(
    network: CanopenNetwork, node_id: int, source: str, axis: str, wanted: bool
) -> ObjectLoadMachine | None:
    """The load machine of a simulated drive; None for a drive without one.

    Raises BadInput if the bench asks for a load (``wanted``) that nothing can produce.
    """
    try:
        network.upload(node_id, LOAD_MACHINE, LOAD_TORQUE_SUB)
    except TransferAborted:
        if not wanted:
            return None
        raise BadInput(
            source,
            f"load.{axis}",
            "load steps",
            "none, for this drive has no load machine (object 0x2100)",
            "take the load steps out of the file, or run against a simulated drive",
        ) from None
    return ObjectLoadMachine(network, node_id)
