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
from hil.configuration.references import Load, SignalFile
from hil.load.instrument import InstrumentLoadMachine, Wait, instrument_line
from hil.load.load_files import load_table
from hil.loop.axis_roles import LoadMachine
from hil.recording.run_recorder import RunRecorder
from virtual_bus.drive.servo import SimulatedServo
from virtual_bus.drive.servo_objects import LOAD_MACHINE, LoadCourse

Say = Callable[[str, str], None]
"""Takes a text for the reader and its level."""
LOAD_TORQUE_SUB, LOAD_COURSE_SUB, LOAD_NUMBER_SUB, LOAD_DELAY_SUB = 1, 3, 4, 5
NM_PER_COUNT = 1e-3
US_PER_S = 1e6


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


class ShaftLoad:
    """A load over time that a simulated shaft bears by itself, by 0x2100:3 and 5: no frame while it lasts."""

    def __init__(self, network: CanopenNetwork, node_id: int, load: SignalFile) -> None:
        self._network = network
        self._node_id = node_id
        self._load = load

    def begin_with_next_sync(self) -> None:
        """Have it begun by the SYNC that comes next. Raises PeerFault."""
        course = LoadCourse.HELD if self._load.between == "held" else LoadCourse.STRAIGHT
        delay_us = round(self._load.at_s * US_PER_S)
        self._network.download(self._node_id, LOAD_MACHINE, LOAD_DELAY_SUB, delay_us.to_bytes(4, "little"))
        self._network.download(self._node_id, LOAD_MACHINE, LOAD_COURSE_SUB, bytes([course]))

    def take_off(self) -> None:
        """Take the load off the shaft and wait for the confirmation. Raises PeerFault."""
        self._network.download(self._node_id, LOAD_MACHINE, LOAD_COURSE_SUB, bytes([LoadCourse.OFF]))
        self._network.download(self._node_id, LOAD_MACHINE, LOAD_TORQUE_SUB, _raw(0.0))


def _raw(torque_nm: float) -> bytes:
    return round(torque_nm / NM_PER_COUNT).to_bytes(4, "little", signed=True)


def find_load_machine(
    network: CanopenNetwork, node_id: int, source: str, axis: str, wanted: Sequence[Load]
) -> ObjectLoadMachine | ShaftLoad | None:
    """What puts loads on a simulated drive's shaft; None for a drive without it.

    Raises BadInput if the bench asks for a load (``wanted``) that nothing can produce.
    """
    over_time = next((entry for entry in wanted if isinstance(entry, SignalFile)), None)
    try:
        if over_time is None:
            network.upload(node_id, LOAD_MACHINE, LOAD_TORQUE_SUB)
            return ObjectLoadMachine(network, node_id)
        number = int.from_bytes(network.upload(node_id, LOAD_MACHINE, LOAD_NUMBER_SUB), "little")
    except TransferAborted:
        if not wanted:
            return None
        raise BadInput(
            source,
            f"load.{axis}",
            "a load",
            "none, for this drive has no load machine (object 0x2100)",
            "take the load out of the file, or run against a simulated drive",
        ) from None
    if number != load_table(over_time.signal).number:
        told = "another file" if number else "none"
        expected = f"a drive that was started with this file; node {node_id} has {told}"
        remedy = f"hil simulate --load {node_id}={over_time.path}"
        raise BadInput(source, f"load.{axis}[0].path", over_time.path, expected, remedy)
    return ShaftLoad(network, node_id, over_time)


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
        self._objects: list[ObjectLoadMachine | ShaftLoad] = []
        self._instrument: InstrumentLoadMachine | None = None

    def find(self, drive: ServoDrive, say: Say) -> LoadMachine | None:
        """What is told the loads of ``drive``, off now; None if there is none, or the shaft has them itself.

        Raises BadInput if the bench asks for a load that nothing can make, PeerFault if it fails.
        """
        if drive.name == self._config.load_machine_axis:
            return self._connect(drive.name, say)
        wanted = self._config.load.get(drive.name, ())
        machine = find_load_machine(drive.network, drive.node_id, self._config.source, drive.name, wanted)
        if machine is not None:
            machine.take_off()
            self._objects.append(machine)
        return machine if isinstance(machine, ObjectLoadMachine) else None

    @property
    def chore(self) -> Callable[[Instant], None] | None:
        """What is to be done in each cycle; None if there is nothing."""
        return None if self._instrument is None else self._instrument.attend

    def begin_with_next_sync(self) -> None:
        """The SYNC that comes next is the run's first: loads over time count from it. Raises PeerFault."""
        for machine in self._objects:
            if isinstance(machine, ShaftLoad):
                machine.begin_with_next_sync()

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
        over_time = any(isinstance(entry, SignalFile) for entry in config.load.get(axis, ()))
        every = wanted.settings.reading_every if over_time else None
        self._instrument = InstrumentLoadMachine(dynamometer, axis, wait, self._record, every)
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
