"""A Magtrol dynamometer controller without I/O: commands in, data strings out, and behind it a hysteresis
brake on a simulated shaft, with the loop that holds its torque.

Sources as in :mod:`servobench.drivers.instruments.dynamometer`. Commands end with CR LF; what is not
understood is counted, as the real instrument shows it on its display, and is not answered. Of the command
set: *IDN?, OD, Q, MODE; of a DSP7000 with the number of the channel. The data string has a fixed length: six
digits of speed (a DSP6001: five), five characters of torque with its point, the direction.

An emulated dynamometer at work: on a timeline in simulated time, or at a pseudo-terminal.
"""

import math
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Final

from servobench.drivers.instruments.dynamometer import LINE_BYTES_MAX
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant
from servobench.virtual_bus.frame import Frame
from servobench.virtual_bus.instruments.serial_line import DeviceLine, LineFaults, LineSpoiler, PseudoTerminal
from servobench.virtual_bus.timeline import Timeline

if TYPE_CHECKING:
    from servobench.virtual_bus.drive.servo import SimulatedServo

STEP_NS: Final = NS_PER_MS
"""The torque loop of the brake runs so often."""
RESPONSE_S: Final = 0.03
"""Time constant with which the torque follows its set-point: chosen here, of the order of a small brake's."""
_SETTLED_NM = 1e-4
"""A tenth of the last digit that the data string shows of less than 10 N m."""


class Shaft:
    """The shaft of a simulated drive, to which a brake is coupled."""

    def __init__(self, servo: "SimulatedServo") -> None:
        self._drive = servo.drive

    def speed_rad_s(self, now: Instant) -> float:
        """Its true speed."""
        self._drive.advance(now)
        return self._drive.firmware.speed_rad_s

    def brake(self, torque_nm: float, now: Instant) -> None:
        """Hold ``torque_nm`` against its motion from ``now`` on; at rest it sticks up to that torque."""
        self._drive.advance(now)
        self._drive.firmware.brake_shaft(torque_nm)


class Brake:
    """Takes power from the shaft and never gives any: its torque acts against the motion, like friction."""

    def __init__(self, shaft: Shaft, torque_max_nm: float, response_s: float = RESPONSE_S) -> None:
        self.torque_nm = 0.0
        """Torque held now."""
        self.shaft = shaft
        self._torque_max_nm = torque_max_nm
        self._set_point_nm = 0.0
        step_s = STEP_NS / NS_PER_S
        self._share = step_s / (response_s + step_s)

    def set_torque(self, torque_nm: float) -> None:
        """Follow this set-point from the next step on, within what the brake can hold."""
        self._set_point_nm = min(max(torque_nm, 0.0), self._torque_max_nm)

    @property
    def settled(self) -> bool:
        """The torque is that of the set-point."""
        return self.torque_nm == self._set_point_nm

    def step(self, now: Instant) -> None:
        """One step of the torque loop."""
        if self.settled:
            return
        away = self._set_point_nm - self.torque_nm
        if abs(away) < _SETTLED_NM:
            self.torque_nm = self._set_point_nm
        else:
            self.torque_nm += self._share * away
        self.shaft.brake(self.torque_nm, now)


_TORQUE_WIDTH = 5
_REST_RPM = 0.5
"""Below it the data string shows 0 rpm."""


class Instrument:
    """One controller with one brake, showing N m."""

    def __init__(self, brake: Brake, kind: str = "magtrol_dsp7000") -> None:
        """``kind``: as in the bench file; a DSP7000 can be told to behave as a DSP6001."""
        self.brake = brake
        self.alarm = False
        """Shown in place of the direction."""
        self.misunderstood = 0
        """Commands that it did not understand."""
        self._as_6001 = kind == "magtrol_dsp6001"
        self._rest = b""

    def take(self, data: bytes, now: Instant) -> list[bytes]:
        """The answers to what has come, each with its end."""
        *lines, rest = (self._rest + data).split(b"\r\n")
        self._rest = rest[-LINE_BYTES_MAX:]
        answers = [self._obey(line, now) for line in lines]
        return [answer + b"\r\n" for answer in answers if answer is not None]

    def _obey(self, line: bytes, now: Instant) -> bytes | None:
        if line == b"*IDN?":
            return b"MAGTROL DSP6001 SIMULATED 1.0" if self._as_6001 else b"MAGTROL DSP7001 SIMULATED 1.0"
        if line in (b"MODE0", b"MODE1") and (not self._as_6001 or line == b"MODE0"):
            self._as_6001 = line == b"MODE1"
            return None
        channel = b"" if self._as_6001 else b"1"
        if line == b"OD" + channel:
            return self._data(now)
        if line == b"Q" + channel:
            self.brake.set_torque(0.0)
            return None
        torque_nm = _number(line.removeprefix(b"Q" if self._as_6001 else b"Q1,"))
        if not line.startswith(b"Q") or torque_nm is None:
            self.misunderstood += 1
            return None
        self.brake.set_torque(torque_nm)
        return None

    def _data(self, now: Instant) -> bytes:
        rpm = self.brake.shaft.speed_rad_s(now) / RAD_S_PER_RPM
        turning = abs(rpm) >= _REST_RPM
        width = 5 if self._as_6001 else 6
        side = "A" if self.alarm else "R" if rpm >= 0.0 else "L"
        shown_nm = self.brake.torque_nm if turning else 0.0
        return f"S{round(abs(rpm)):{width}d}T{_fixed(shown_nm)}{side}".encode("ascii")


def _fixed(value: float) -> str:
    """``value`` in five characters, its point among them."""
    whole = len(str(int(value)))
    return f"{value:.{max(_TORQUE_WIDTH - 1 - whole, 0)}f}".ljust(_TORQUE_WIDTH, ".")[:_TORQUE_WIDTH]


def _number(text: bytes) -> float | None:
    """A set-point; None for what is none."""
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) and value >= 0.0 else None


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
