"""A node's objects by SDO, as integers and text."""

from struct import Struct
from struct import error as struct_error

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.sdo import object_name
from servobench.drivers.errors import PeerFault, TransferAborted
from servobench.drivers.printable import printable

_STRUCTS = {code: Struct(f"<{code}") for code in "bBhHiIqQ"}


class SettingRefused(PeerFault):
    """A device holds another value than the one written."""


class RemoteObjects:
    """Typed access to the object dictionary of one node. Every call pumps the network.

    Each method raises TransferAborted if the node refuses, NoAnswer if it is silent. ``code`` is a
    ``struct`` character: b B h H i I for INTEGER8 UNSIGNED8 ... UNSIGNED32.
    """

    def __init__(self, network: CanopenNetwork, node_id: int) -> None:
        self.network = network
        self.node_id = node_id

    def read(self, index: int, sub: int = 0, code: str = "I") -> int:
        """Read an integer object. Extra octets beyond the type are tolerated."""
        data = self.network.upload(self.node_id, index, sub)
        width = _STRUCTS[code].size
        if not data:
            raise SettingRefused(f"node {self.node_id} sent no data for {object_name(index, sub)}")
        return int.from_bytes(data[:width], "little", signed=code.islower())

    def read_if_there(self, index: int, sub: int = 0, code: str = "I") -> int | None:
        """Read an integer object; None if the node lacks it, or does not let it be read."""
        try:
            return self.read(index, sub, code)
        except TransferAborted:
            return None

    def read_text(self, index: int, sub: int = 0) -> str:
        """Read a VISIBLE_STRING, printable; empty if the node has none. Octets beyond Latin-1 do not
        occur."""
        try:
            data = self.network.upload(self.node_id, index, sub)
        except TransferAborted:
            return ""
        return printable(data.split(b"\0", 1)[0].decode("latin-1").strip())

    def write(self, index: int, sub: int, code: str, value: int) -> None:
        """Write an integer object and wait for the confirmation. Raises ValueError if it does not fit."""
        try:
            data = _STRUCTS[code].pack(value)
        except struct_error as error:
            raise ValueError(f"{object_name(index, sub)}: {value} does not fit {code!r}") from error
        self.network.download(self.node_id, index, sub, data)

    def write_verified(self, index: int, sub: int, code: str, value: int) -> None:
        """Write an integer object and read it back; raises SettingRefused if the node holds another value."""
        self.write(index, sub, code, value)
        held = self.read(index, sub, code)
        if held != value:
            raise SettingRefused(
                f"node {self.node_id} holds {held} in {object_name(index, sub)}", f"{value} was written to it"
            )
