"""All load machines of a run: found for their drives, attended to, and let go of on every way out.

That of a simulated drive is an object in its dictionary; any other is an instrument, set and read in every
cycle.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.errors import BadInput, PeerFault, TransferAborted
from servobench.drivers.instruments.dynamometer import Dynamometer, LineCounts, LoadReading
from servobench.drivers.timebase import NS_PER_S, US_PER_S, Clock, Duration, Instant
from servobench.drivers.wire.adapters import SIMULATED
from servobench.drivers.wire.serial_line import ByteLine, open_line
from servobench.hil.configuration.config import BenchConfig, LoadMachineConfig
from servobench.hil.configuration.references import Load, SignalFile
from servobench.hil.loop.protocol import LoadMachine
from servobench.hil.recording.run_recorder import RunRecorder
from servobench.virtual_bus.drive.load_object import (
    LOAD_COURSE_SUB,
    LOAD_DELAY_SUB,
    LOAD_MACHINE,
    LOAD_NUMBER_SUB,
    LOAD_TORQUE_SUB,
    SIMULATED_DRIVE,
    LoadCourse,
)
from servobench.virtual_bus.instruments.dynamometer import Brake, Instrument, Shaft, TimelineLine
from servobench.virtual_bus.instruments.serial_line import LineFaults
from servobench.virtual_bus.timeline import SimulatedClock

if TYPE_CHECKING:
    from servobench.virtual_bus.drive.servo import SimulatedServo

TOLERANCE = 0.05
"""A measured torque within this share of the asked one counts as reached."""
Say = Callable[[str, str], None]
"""Takes a text for the reader and its level."""
NM_PER_COUNT = 1e-3


@dataclass(slots=True)
class _Plateau:
    """Measurements during one torque."""

    at: Instant
    asked_nm: float
    reached_at: Instant | None = None
    readings: list[float] = field(default_factory=list)

    def add(self, reading: LoadReading) -> None:
        self.readings.append(reading.torque_nm)
        if self.reached_at is None and abs(reading.torque_nm - self.asked_nm) <= TOLERANCE * self.asked_nm:
            self.reached_at = reading.at

    def as_json(self, zero: Instant) -> dict[str, Any]:
        """Measured: the mean over the second half, when it has settled."""
        settled = self.readings[len(self.readings) // 2 :]
        reached_at = self.reached_at
        return {
            "at_s": (self.at - zero) / NS_PER_S,
            "asked_nm": self.asked_nm,
            "measured_nm": sum(settled) / len(settled) if settled else None,
            "reached_ms": None if reached_at is None else (reached_at - self.at) / 1e6,
            "readings": len(self.readings),
        }


@dataclass(slots=True)
class InstrumentLoadMachine:
    """A serial load machine on the shaft of one axis."""

    dynamometer: Dynamometer
    axis: str
    network: CanopenNetwork
    """Lets time pass while it has to wait: heartbeats go on, and in simulated time the instrument acts."""
    record: Callable[[str, LoadReading], None]
    """Takes the axis and each reading."""
    every: Duration | None = None
    """How often it is told the torque of a load over time; None: of each step, and what came of it."""
    _due_nm: float | None = field(default=None, init=False)
    """Torque of a load over time, not sent yet."""
    _due_at: Instant = field(default=Instant(0), init=False)
    _begun_at: Instant | None = field(default=None, init=False)
    _plateaus: list[_Plateau] = field(default_factory=list, init=False)
    _kept: int = field(default=0, init=False)

    def connect(self) -> str:
        """Open the brake and learn who is there. Raises PeerFault."""
        return self.dynamometer.connect(self.network.pump)

    def begin(self, at: Instant) -> None:
        """The run's time zero; readings before it are not kept."""
        self._begun_at = at
        self.dynamometer.take_readings()
        self.dynamometer.tally = LineCounts()

    def set_torque(self, torque_nm: float) -> None:
        """Ask for a load torque, N m. Does not wait."""
        if self.every is not None:
            self._due_nm = torque_nm
            return
        self.dynamometer.set_torque(torque_nm)
        self._plateaus.append(_Plateau(self.network.clock.now(), torque_nm))

    def attend(self, now: Instant) -> None:
        """Once in each cycle: speak with the instrument, and keep what it measured. Raises PeerFault."""
        if self.every is not None and self._due_nm is not None and now >= self._due_at:
            self.dynamometer.set_torque(self._due_nm)
            self._due_nm, self._due_at = None, Instant(now + self.every)
        self.dynamometer.pump(now)
        self._keep()

    def take_off(self) -> None:
        """Open the brake and see that it did. Raises PeerFault."""
        self._due_nm = None
        self.dynamometer.take_off(self.network.pump)
        self._keep()

    def close(self) -> None:
        """Give the port back."""
        self.dynamometer.close()

    def figures(self) -> dict[str, Any]:
        """For the summary."""
        tally = self.dynamometer.tally
        zero = self._begun_at or Instant(0)
        return {
            "axis": self.axis,
            "identity": self.dynamometer.identity,
            "readings": self._kept,
            "late": tally.late,
            "spoilt": tally.spoilt,
            "stamp_error_us_max": tally.error_ns_max / 1e3,
            "steps": [plateau.as_json(zero) for plateau in self._plateaus if plateau.readings],
        }

    def _keep(self) -> None:
        for reading in self.dynamometer.take_readings():
            if self._begun_at is None or reading.at < self._begun_at:
                continue
            self._kept += 1
            self.record(self.axis, reading)
            if self._plateaus:
                self._plateaus[-1].add(reading)


def instrument_line(
    config: LoadMachineConfig, source: str, clock: Clock, servo: "SimulatedServo | None", seed: int
) -> ByteLine:
    """The line to the instrument: its serial port, or that of one simulated on the shaft of ``servo``.

    Raises BusDown if the port cannot be opened, BadInput for a simulated one without a simulated drive.
    """
    if config.port != SIMULATED:
        return open_line(config.port, config.baud, "load machine")
    if servo is None or not isinstance(clock, SimulatedClock):
        raise BadInput(
            source,
            "load_machine.port",
            config.port,
            "a serial port, because the drive is not simulated in this process",
            "simulate the instrument beside the drive: hil simulate --load-machine PATH, and name PATH here",
        )
    brake = Brake(Shaft(servo), config.torque_max_nm)
    instrument = Instrument(brake, config.kind)
    return TimelineLine(clock.timeline, instrument, config.baud, LineFaults(), seed)


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
        _take_off(self._network, self._node_id)


def _take_off(network: CanopenNetwork, node_id: int) -> None:
    network.download(node_id, LOAD_MACHINE, LOAD_COURSE_SUB, bytes([LoadCourse.OFF]))
    network.download(node_id, LOAD_MACHINE, LOAD_TORQUE_SUB, _raw(0.0))


def _raw(torque_nm: float) -> bytes:
    return round(torque_nm / NM_PER_COUNT).to_bytes(4, "little", signed=True)


def find_load_machine(
    network: CanopenNetwork, node_id: int, source: str, axis: str, wanted: Sequence[Load]
) -> ObjectLoadMachine | ShaftLoad | None:
    """Return the load machine for the ``wanted`` loads on a simulated drive's shaft; None if there are none.

    2100h is read and written only on a drive that is :data:`SIMULATED_DRIVE` by its 1018h and 1008h. Where no
    load is wanted, one that an earlier run has left there is taken off at once.
    Raises BadInput if the bench asks for a load that nothing can make, PeerFault.
    """
    product = network.writes.products.get(node_id)
    if product != SIMULATED_DRIVE:
        if not wanted:
            return None
        raise _no_load_machine(source, axis, f"a load for {product or 'an unnamed device'}")
    over_time = next((entry for entry in wanted if isinstance(entry, SignalFile)), None)
    try:
        if not wanted:
            left = [network.upload(node_id, LOAD_MACHINE, sub) for sub in (LOAD_TORQUE_SUB, LOAD_COURSE_SUB)]
            if any(map(any, left)):
                _take_off(network, node_id)
            return None
        if over_time is None:
            network.upload(node_id, LOAD_MACHINE, LOAD_TORQUE_SUB)
            return ObjectLoadMachine(network, node_id)
        number = int.from_bytes(network.upload(node_id, LOAD_MACHINE, LOAD_NUMBER_SUB), "little")
    except TransferAborted:
        if not wanted:
            return None
        raise _no_load_machine(source, axis, f"a load for {product}, which was made without 2100h") from None
    from servobench.hil.load.simulated_load import load_table

    if number != load_table(over_time.signal).number:
        held = "another file" if number else "none"
        expected = f"a drive that was started with this file; node {node_id} has {held}"
        remedy = f"hil simulate --load {node_id}={over_time.path}"
        raise BadInput(source, f"load.{axis}[0].path", over_time.path, expected, remedy)
    return ShaftLoad(network, node_id, over_time)


def _no_load_machine(source: str, axis: str, asked: str) -> BadInput:
    return BadInput(
        source,
        f"load.{axis}",
        asked,
        f"a load for the {SIMULATED_DRIVE}, the only drive with a load machine (2100h)",
        f"take load.{axis} out of the file, or couple an instrument to the shaft: [load_machine]",
    )


class LoadMachines:
    """The load machines of a bench."""

    def __init__(
        self,
        config: BenchConfig,
        network: CanopenNetwork,
        recorder: RunRecorder,
        servos: "Sequence[SimulatedServo]",
    ) -> None:
        """``servos``: the drives simulated in this process, in the order of the axes; empty if elsewhere."""
        self._config = config
        self._network = network
        self._recorder = recorder
        self._servos = dict(zip(config.axes, servos, strict=False))
        self._objects: list[ObjectLoadMachine | ShaftLoad] = []
        self._instrument: InstrumentLoadMachine | None = None

    def find(self, drive: ServoDrive, say: Say) -> LoadMachine | None:
        """Return the load machine of ``drive``, off now; None if there is none, or the shaft has its loads
        itself.

        Raises BadInput if the bench asks for a load that nothing can make, PeerFault if it fails.
        """
        if drive.name == self._config.load_machine_axis:
            return self._connect(drive.name, say)
        entries = self._config.load.get(drive.name, ())
        machine = find_load_machine(drive.network, drive.node_id, self._config.source, drive.name, entries)
        if machine is not None:
            machine.take_off()
            self._objects.append(machine)
        return machine if isinstance(machine, ObjectLoadMachine) else None

    @property
    def chore(self) -> Callable[[Instant], None] | None:
        """The action of each cycle; None if there is none."""
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
        instrument = config.load_machine
        line = instrument_line(instrument, config.source, clock, self._servos.get(axis), config.bench.seed)
        dynamometer = Dynamometer(line, clock, instrument.dialect, instrument.settings)
        over_time = any(isinstance(entry, SignalFile) for entry in config.load.get(axis, ()))
        every = instrument.settings.reading_every if over_time else None
        self._instrument = InstrumentLoadMachine(dynamometer, axis, self._network, self._record, every)
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
