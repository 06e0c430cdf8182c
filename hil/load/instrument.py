"""The load machine of a bench that is an instrument of its own: set, read in every cycle, and let go of."""

from collections.abc import Callable
from typing import Any, NamedTuple

from drivers.errors import BadInput
from drivers.instruments.dynamometer import Dynamometer, LineCounts, LoadReading
from drivers.timebase import NS_PER_S, Clock, Duration, Instant
from drivers.wire.serial_line import ByteLine, open_line
from hil.configuration.config_load_machine import SIMULATED, LoadMachineConfig
from virtual_bus.drive.servo import SimulatedServo
from virtual_bus.instruments.dynamometer.brake import Brake, ServoShaft
from virtual_bus.instruments.dynamometer.hosting import TimelineLine
from virtual_bus.instruments.dynamometer.instrument import Instrument
from virtual_bus.instruments.serial_line.line_faults import LineFaults
from virtual_bus.timeline import SimulatedClock

TOLERANCE = 0.05
"""A measured torque within this share of the asked one counts as reached."""


class _Plateau:
    """What was measured while one torque was asked for."""

    def __init__(self, at: Instant, asked_nm: float) -> None:
        self.at, self.asked_nm = at, asked_nm
        self.reached_at: Instant | None = None
        self.readings: list[tuple[Instant, float]] = []

    def add(self, reading: LoadReading) -> None:
        self.readings.append((reading.at, reading.torque_nm))
        if self.reached_at is None and abs(reading.torque_nm - self.asked_nm) <= TOLERANCE * self.asked_nm:
            self.reached_at = reading.at

    def as_json(self, zero: Instant) -> dict[str, Any]:
        """Measured: the mean over the second half, when it has settled."""
        settled = [torque_nm for _, torque_nm in self.readings[len(self.readings) // 2 :]]
        reached_at = self.reached_at
        return {
            "at_s": (self.at - zero) / NS_PER_S,
            "asked_nm": self.asked_nm,
            "measured_nm": sum(settled) / len(settled) if settled else None,
            "reached_ms": None if reached_at is None else (reached_at - self.at) / 1e6,
            "readings": len(self.readings),
        }


class Wait(NamedTuple):
    """How a load machine lets time pass while it has to wait."""

    until: Callable[[Instant], None]
    clock: Clock


class InstrumentLoadMachine:
    """A serial load machine on the shaft of one axis."""

    def __init__(
        self,
        dynamometer: Dynamometer,
        axis: str,
        wait: Wait,
        record: Callable[[str, LoadReading], None],
        every: Duration | None = None,
    ) -> None:
        """``record`` takes the axis and each reading. ``every``: how often it is told the torque of a load
        over time; None: of each step, and what came of it."""
        self.axis = axis
        self._dynamometer = dynamometer
        self._wait = wait
        self._record = record
        self._every = every
        self._due_nm: float | None = None
        """Of a load over time, not told yet."""
        self._due_at = Instant(0)
        self._begun_at: Instant | None = None
        self._plateaus: list[_Plateau] = []
        self._kept = 0

    def connect(self) -> str:
        """Open the brake and learn who is there. Raises PeerFault."""
        return self._dynamometer.connect(self._wait.until)

    def begin(self, at: Instant) -> None:
        """The run's time zero; readings before it are not kept."""
        self._begun_at = at
        self._dynamometer.take_readings()
        self._dynamometer.tally = LineCounts()

    def set_torque(self, torque_nm: float) -> None:
        """Ask for a load torque, N m. Does not wait."""
        if self._every is not None:
            self._due_nm = torque_nm
            return
        self._dynamometer.set_torque(torque_nm)
        self._plateaus.append(_Plateau(self._wait.clock.now(), torque_nm))

    def attend(self, now: Instant) -> None:
        """Once in each cycle: speak with the instrument, and keep what it measured. Raises PeerFault."""
        if self._every is not None and self._due_nm is not None and now >= self._due_at:
            self._dynamometer.set_torque(self._due_nm)
            self._due_nm, self._due_at = None, Instant(now + self._every)
        self._dynamometer.pump(now)
        self._keep()

    def take_off(self) -> None:
        """Open the brake and see that it did. Raises PeerFault."""
        self._due_nm = None
        self._dynamometer.take_off(self._wait.until)
        self._keep()

    def close(self) -> None:
        """Give the port back."""
        self._dynamometer.close()

    def figures(self) -> dict[str, Any]:
        """For the summary."""
        tally = self._dynamometer.tally
        zero = self._begun_at or Instant(0)
        return {
            "axis": self.axis,
            "identity": self._dynamometer.identity,
            "readings": self._kept,
            "late": tally.late,
            "spoilt": tally.spoilt,
            "stamp_error_us_max": tally.error_ns_max / 1e3,
            "steps": [plateau.as_json(zero) for plateau in self._plateaus if plateau.readings],
        }

    def _keep(self) -> None:
        for reading in self._dynamometer.take_readings():
            if self._begun_at is None or reading.at < self._begun_at:
                continue
            self._kept += 1
            self._record(self.axis, reading)
            if self._plateaus:
                self._plateaus[-1].add(reading)


def instrument_line(
    config: LoadMachineConfig, source: str, clock: Clock, servo: SimulatedServo | None, seed: int
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
    brake = Brake(ServoShaft(servo), config.torque_max_nm)
    instrument = Instrument(brake, config.kind)
    return TimelineLine(clock.timeline, instrument, config.baud, LineFaults(), seed)
