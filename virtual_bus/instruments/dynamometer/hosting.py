"""An emulated dynamometer at work: on a timeline in simulated time, or at a pseudo-terminal."""

from collections.abc import Sequence
from functools import partial

from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant
from servobench.virtual_bus.frame import Frame
from servobench.virtual_bus.instruments.dynamometer.instrument import STEP_NS, Instrument
from servobench.virtual_bus.instruments.serial_line.device_line import DeviceLine, LineFaults, LineSpoiler
from servobench.virtual_bus.instruments.serial_line.pseudo_terminal import PseudoTerminal
from servobench.virtual_bus.timeline import Timeline

ANSWER_NS = Duration(2 * NS_PER_MS)
"""From the end of a request to the beginning of its answer: chosen here."""


class TimelineLine:
    """Both ends of a serial line in simulated time, with the instrument at the far one.

    The near end is what a driver reads and writes (:class:`servobench.drivers.wire.serial_line.ByteLine`).
    """

    def __init__(
        self, timeline: Timeline, instrument: Instrument, baud: int, faults: LineFaults, seed: int
    ) -> None:
        self.name = "simulated"
        self._timeline = timeline
        self._instrument = instrument
        self._pace = LineFaults(baud=baud)
        self._late = Duration(round(faults.late_ms * NS_PER_MS))
        self._spoiler = LineSpoiler(faults, seed)
        self._come: list[bytes] = []
        self._to_free_at = self._from_free_at = Instant(0)
        self._stepping = False

    def read(self) -> bytes:
        """Return the instrument's output."""
        data = b"".join(self._come)
        self._come.clear()
        return data

    def write(self, data: bytes) -> None:
        """Send to the instrument; it has it when the last byte has passed."""
        start = max(self._timeline.now, self._to_free_at)
        self._to_free_at = Instant(start + self._pace.time_on_line(len(data)))
        self._timeline.post(self._to_free_at, lambda now: self._arrive(data, now))

    def close(self) -> None:
        """Nothing has to be given back."""

    def _arrive(self, data: bytes, now: Instant) -> None:
        for answer in self._instrument.take(data, now):
            line = self._spoiler.spoil(answer)
            start = max(now + ANSWER_NS + self._late, self._from_free_at)
            self._from_free_at = Instant(start + self._pace.time_on_line(len(line)))
            self._timeline.post(self._from_free_at, partial(self._hand_over, line))
        self._keep_stepping(now)

    def _hand_over(self, line: bytes, _now: Instant) -> None:
        self._come.append(line)

    def _keep_stepping(self, now: Instant) -> None:
        """The brake's torque loop runs only while there is something to do."""
        if not self._stepping and not self._instrument.brake.settled:
            self._stepping = True
            self._timeline.post(Instant(now + STEP_NS), self._step)

    def _step(self, now: Instant) -> None:
        self._instrument.brake.step(now)
        self._stepping = False
        self._keep_stepping(now)


class InstrumentAtTerminal:
    """An instrument at a pseudo-terminal, hosted as a device among the drives though it sends no frame.

    It is woken every millisecond, which is the pace of its brake's torque loop too.
    """

    def __init__(
        self,
        instrument: Instrument,
        terminal: PseudoTerminal,
        faults: LineFaults | None = None,
        seed: int = 0,
    ) -> None:
        self.wake_at: Instant | None = None
        self._instrument = instrument
        self._line = DeviceLine(terminal, faults or LineFaults(), seed)
        self._step_at = Instant(0)

    def start(self, now: Instant) -> Sequence[Frame]:
        """Power on, with the brake open."""
        self._line.start(now)
        self._step_at = now
        self.wake_at = Instant(now + STEP_NS)
        return ()

    def receive(self, frame: Frame, now: Instant) -> Sequence[Frame]:  # noqa: ARG002
        """The bus is not its business."""
        return ()

    def wake(self, now: Instant) -> Sequence[Frame]:
        """Serve the line, and let the brake follow."""
        for answer in self._instrument.take(self._line.read(now), now):
            self._line.send(answer, now)
        self._line.flush(now)
        if now - self._step_at > NS_PER_S:  # the process was held up: what was missed is not made up for
            self._step_at = now
        while self._step_at + STEP_NS <= now:
            self._step_at = Instant(self._step_at + STEP_NS)
            self._instrument.brake.step(now)
        self.wake_at = Instant(now + STEP_NS)
        return ()
