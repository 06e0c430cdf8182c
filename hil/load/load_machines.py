"""All load machines of a run: found for their drives, attended to, and let go of on every way out.

That of a simulated drive is an object in its dictionary; any other is an instrument.
"""

from collections.abc import Callable, Sequence
from typing import Any

from drivers.canopen.network import CanopenNetwork
from drivers.cia402.servo import ServoDrive
from drivers.errors import BadInput, PeerFault, TransferAborted
from drivers.instruments.dynamometer import Dynamometer, LoadReading
from drivers.timebase import Instant
from hil.configuration.config import BenchConfig
from hil.load.instrument import InstrumentLoadMachine, Wait, instrument_line
from hil.loop.axis_roles import LoadMachine
from hil.recording.run_recorder import RunRecorder
from virtual_bus.drive.servo import SimulatedServo
from virtual_bus.drive.servo_objects import LOAD_MACHINE

Say = Callable[[str, str], None]
"""Takes a text for the reader and its level."""
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


class LoadMachines:
    """What puts loads on the shafts of a bench."""

    def __init__(
        self,
        config: BenchConfig,
        network: CanopenNetwork,
        recorder: RunRecorder,
        servos: Sequence[SimulatedServo],
    ) -> None:
        """``servos``: the drives simulated in this process, in the order of the axes; empty if elsewhere."""
        self._config = config
        self._network = network
        self._recorder = recorder
        self._servos = dict(zip(config.axes, servos, strict=False))
        self._objects: list[ObjectLoadMachine] = []
        self._instrument: InstrumentLoadMachine | None = None

    def find(self, drive: ServoDrive, say: Say) -> LoadMachine | None:
        """The load machine on the shaft of ``drive``, with its load off; None if there is none.

        Raises BadInput if the bench asks for a load that nothing can make, PeerFault if it fails.
        """
        if drive.name == self._config.load_machine_axis:
            return self._connect(drive.name, say)
        wanted = bool(self._config.load.get(drive.name))
        machine = find_load_machine(drive.network, drive.node_id, self._config.source, drive.name, wanted)
        if machine is not None:
            machine.take_off()
            self._objects.append(machine)
        return machine

    @property
    def chore(self) -> Callable[[Instant], None] | None:
        """What is to be done in each cycle; None if there is nothing."""
        return None if self._instrument is None else self._instrument.attend

    def begin(self, at: Instant) -> None:
        """The run's time zero."""
        if self._instrument is not None:
            self._instrument.begin(at)

    def take_off(self, say: Say) -> None:
        """Take every load off and see that it is gone; what fails is said."""
        for machine in self._objects:
            self._try(machine.take_off, say)
        if self._instrument is not None:
            self._try(self._instrument.take_off, say)
            self._instrument.close()

    def figures(self) -> dict[str, Any] | None:
        """For the summary; None without an instrument."""
        return None if self._instrument is None else self._instrument.figures()

    def _connect(self, axis: str, say: Say) -> InstrumentLoadMachine:
        config, clock = self._config, self._network.clock
        assert config.load_machine is not None, "an axis has a load machine, so there is one"
        wanted = config.load_machine
        line = instrument_line(wanted, config.source, clock, self._servos.get(axis), config.bench.seed)
        dynamometer = Dynamometer(line, clock, wanted.dialect, wanted.settings)
        # pumping keeps the heartbeats going, and in simulated time lets the instrument act
        wait = Wait(self._network.pump, clock)
        self._instrument = InstrumentLoadMachine(dynamometer, axis, wait, self._record)
        say(f"{axis}: load machine on {line.name} is {self._instrument.connect()}", "INFO")
        return self._instrument

    def _record(self, axis: str, reading: LoadReading) -> None:
        self._recorder.load(reading.at, axis, reading.torque_nm, reading.speed_rad_s)

    @staticmethod
    def _try(act: Callable[[], None], say: Say) -> None:
        try:
            act()
        except PeerFault as error:
            say(f"the load may still be on: {error}", "ERROR")
