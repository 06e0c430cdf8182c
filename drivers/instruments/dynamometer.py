"""A serial load machine: torque set-points out, torque and speed readings in, without waiting.

    set_torque  -->  command, no answer            repeated now and then, as a spoilt one goes unnoticed
    pump        -->  OD ....... data string        one request at a time
                     |-- too late: asked again, three times, then the instrument counts as lost
                     |-- spoilt:   asked again

The instrument does not time-stamp its answers. A reading is dated midway between the end of the request on
the line and the beginning of the answer, with its possible error.

``pump`` is called in each cycle of a loop; it reads and writes what the port has and takes, and returns.
Operations that wait (connecting, removing the load) call a function of the caller's that lets time pass.

The serial protocol of Magtrol's dynamometer controllers; no I/O.

Sources: DSP6001 user's manual, chapter 8 (8.6, command set); DSP7000 user's manual, 7.2 (data format), 7.4
(command set; 7.4.2 OD, 7.4.6 Q, 7.4.7 MODE); DSP6000 manual, chapter 5 (serial line, example of the data
string: ``S 1725T22.60R``). Commands are upper case, one a line, ended by CR LF. Only OD, *IDN? and their
like are answered; a command that is not understood shows on the instrument's own display and nowhere else.
There is no checksum: a digit that became another digit passes for a reading.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from servobench.drivers.errors import NoAnswer, PeerFault
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Clock, Duration, Instant
from servobench.drivers.wire.serial_line import BITS_A_BYTE, ByteLine, LineFull

TORQUE_UNITS_NM = {
    "N.m": 1.0,
    "N.cm": 1e-2,
    "N.mm": 1e-3,
    "kg.cm": 9.80665e-2,
    "g.cm": 9.80665e-5,
    "oz.in": 7.0615518e-3,
    "oz.ft": 8.4738622e-2,
    "lb.in": 0.11298483,
    "lb.ft": 1.3558179,
}
"""The units that the instruments can be set to show, in N m (Model 6200 manual, commands UI and UR)."""
TORQUE_DIGITS = 3
"""Decimals of a set-point."""

_READING = re.compile(rb"S *(\d{1,6})T *(-?\d{0,6}\.\d{0,5})([RLA])")
END = b"\r\n"


class DataString(NamedTuple):
    """A data string of the instrument, in SI units."""

    torque_nm: float
    speed_rad_s: float
    """Positive clockwise (R), as looked upon the shaft's end; without sign during an alarm."""
    alarm: bool
    """The instrument reports an alarm: temperature, overload, flow, or another quantity that it watches."""


class Dialect(NamedTuple):
    """The commands of one model, and of one channel of it."""

    kind: str
    ask: bytes
    """Requests speed, torque and direction."""
    release: bytes
    """Torque mode off, brake off."""
    torque: bytes
    """Prefix of a set-point."""
    unit: str = "N.m"
    clockwise_is_positive: bool = True

    identify: bytes = b"*IDN?" + END

    def set_torque(self, torque_nm: float) -> bytes:
        """Return the command that requests ``torque_nm``, N m; zero opens the brake."""
        shown = torque_nm / TORQUE_UNITS_NM[self.unit]
        if round(shown, TORQUE_DIGITS) == 0.0:
            return self.release
        return self.torque + f"{shown:.{TORQUE_DIGITS}f}".encode("ascii") + END

    def read(self, line: bytes) -> DataString | None:
        """Parse ``line``, without its line end, as a data string; None for anything else."""
        match = _READING.fullmatch(line.strip())
        if match is None or not any(digit in match[2] for digit in b"0123456789"):
            return None
        sign = {b"R": 1.0, b"L": -1.0, b"A": 1.0}[match[3]] * (1.0 if self.clockwise_is_positive else -1.0)
        torque_nm = float(match[2]) * TORQUE_UNITS_NM[self.unit]
        return DataString(torque_nm, sign * int(match[1]) * RAD_S_PER_RPM, match[3] == b"A")


def dialect(kind: str, channel: int = 1, unit: str = "N.m", clockwise_is_positive: bool = True) -> Dialect:
    """Return the dialect of an instrument of ``kind``; a DSP7000 in its 6001 mode is a ``magtrol_dsp6001``.

    Raises KeyError or ValueError for an unknown kind, channel or unit.
    """
    if unit not in TORQUE_UNITS_NM:
        raise KeyError(unit)
    if kind == "magtrol_dsp6001" and channel == 1:
        return Dialect(kind, b"OD\r\n", b"Q\r\n", b"Q", unit, clockwise_is_positive)
    if kind == "magtrol_dsp7000" and channel in (1, 2):
        number = b"%d" % channel
        return Dialect(
            kind,
            b"OD" + number + END,
            b"Q" + number + END,
            b"Q" + number + b",",
            unit,
            clockwise_is_positive,
        )
    raise ValueError(f"{kind} has no channel {channel}")


BAUD = 9600
ANSWER_TIMEOUT = Duration(NS_PER_S)
READING_EVERY = Duration(20 * NS_PER_MS)
"""A request of 4 bytes and an answer of 15 take 19.8 ms at 9600 baud."""
ATTEMPTS_MAX = 3
"""Requests for one reading before the instrument counts as lost."""
SPOILT_MAX = 10
"""Consecutive spoilt answers, as at a wrong baud rate or from another instrument, that end it too."""
REPEAT_NS = Duration(NS_PER_S // 2)
"""Repeat interval of a set-point."""
QUIET_NS = Duration(20 * NS_PER_MS)
"""Pause after a late or spoilt answer: nothing is requested, and late bytes are discarded."""
RELEASE_S = 3
"""Time within which a load must be removed."""
RESIDUE_NM, RESIDUE_SHARE = 0.02, 0.05
"""Residual load allowed: absolute, and as a share of the largest load requested (drag, instrument zero)."""
LINE_BYTES_MAX = 256
"""Limit for a line without an end; a data string has 15 bytes, and no command is longer."""
_STEP_NS = 5 * NS_PER_MS
"""Step while waiting: a quarter of :data:`READING_EVERY`."""


class LoadReading(NamedTuple):
    """One reading of the instrument."""

    at: Instant
    """On the bench's clock."""
    error_ns: Duration
    """Largest error of ``at``, either way."""
    torque_nm: float
    """Torque that the brake takes from the shaft."""
    speed_rad_s: float
    alarm: bool


@dataclass(frozen=True, slots=True)
class DynamometerSettings:
    """Timing of one instrument."""

    baud: int = BAUD
    answer_timeout: Duration = ANSWER_TIMEOUT
    """The manuals require at least a second."""
    reading_every: Duration = READING_EVERY
    """Interval between requests; longer if the line is slower."""


@dataclass(slots=True)
class LineCounts:
    """Line statistics."""

    readings: int = 0
    late: int = 0
    """Answers that did not come in time."""
    spoilt: int = 0
    """Lines that were not a reading."""
    unasked: int = 0
    """Unsolicited lines."""
    error_ns_max: int = 0


class Dynamometer:
    """One load machine on one serial line."""

    def __init__(self, line: ByteLine, clock: Clock, dialect: Dialect, settings: DynamometerSettings) -> None:
        self.identity = ""
        self.tally = LineCounts()
        self._line = line
        self._clock = clock
        self._dialect = dialect
        self._settings = settings
        self._rest = b""
        self._asked_at: Instant | None = None
        self._late = self._spoilt = 0
        """Consecutive late and spoilt answers."""
        self._next_at = Instant(0)
        self._quiet_until = Instant(0)
        self._wanted_nm = 0.0
        self._largest_nm = 0.0
        self._repeat_at = Instant(0)
        self._readings: list[LoadReading] = []
        self._text: bytes | None = None
        self._identifying = False

    def connect(self, wait: Callable[[Instant], None]) -> str:
        """Open the brake and identify the instrument; ``wait`` lets time pass until an instant.

        Raises NoAnswer.
        """
        self._send(self._dialect.release)
        for _ in range(ATTEMPTS_MAX):
            self._identifying, self._text = True, None
            self._send(self._dialect.identify)
            deadline = Instant(self._clock.now() + self._settings.answer_timeout)
            while self._text is None and self._clock.now() < deadline:
                wait(self._step(deadline))
                self._take_in(self._clock.now())
            self._identifying = False
            if self._text is not None:
                self.identity = self._text.decode("ascii", "replace")
                self.read_now(wait)
                return self.identity
        raise NoAnswer(
            f"no load machine answers on {self._line.name}",
            f"{ATTEMPTS_MAX} times asked for its identity in"
            f" {ATTEMPTS_MAX * self._settings.answer_timeout / NS_PER_S:g} s",
            "check port, cable (null modem) and the instrument's baud rate",
        )

    def set_torque(self, torque_nm: float) -> None:
        """Request ``torque_nm``, N m, against the motion of the shaft; sent at once. Raises PeerFault."""
        self._wanted_nm = torque_nm
        self._largest_nm = max(self._largest_nm, abs(torque_nm))
        self._send_torque(self._clock.now())

    def pump(self, now: Instant) -> None:
        """Take in received bytes and send what is due; return at once.

        Raises NoAnswer if the instrument is lost, PeerFault if its port is, or if it reports an alarm.
        """
        self._take_in(now)
        asked_at = self._asked_at
        if asked_at is not None and now - asked_at > self._settings.answer_timeout:
            self.tally.late += 1
            self._late += 1
            self._ask_again(now)
        if now >= self._repeat_at:
            self._send_torque(now)
        if self._asked_at is None and now >= self._next_at and now >= self._quiet_until:
            self._send(self._dialect.ask)
            self._asked_at = now
            self._next_at = Instant(now + self._settings.reading_every)

    def take_readings(self) -> list[LoadReading]:
        """Return the readings since the last call, oldest first."""
        readings, self._readings = self._readings, []
        return readings

    def read_now(self, wait: Callable[[Instant], None]) -> LoadReading:
        """Wait for the next reading. Raises as :meth:`pump` does."""
        known = self.tally.readings
        while self.tally.readings == known:
            self.pump(self._clock.now())
            wait(self._step())
        return self._readings[-1]

    def take_off(self, wait: Callable[[Instant], None]) -> None:
        """Remove the load and verify that it is gone. Raises PeerFault."""
        self.set_torque(0.0)
        deadline = Instant(self._clock.now() + RELEASE_S * NS_PER_S)
        residue_nm = max(RESIDUE_NM, RESIDUE_SHARE * self._largest_nm)
        self._asked_at, self._quiet_until = None, Instant(self._clock.now() + QUIET_NS)
        while True:
            reading = self.read_now(wait)
            if abs(reading.torque_nm) <= residue_nm:
                return
            if self._clock.now() > deadline:
                raise PeerFault(
                    f"the load machine on {self._line.name} still brakes",
                    f"{reading.torque_nm:.3g} N m {RELEASE_S} s after it was told to open",
                    "switch its brake off by hand",
                )

    def close(self) -> None:
        """Give the port back."""
        self._line.close()

    # ---- inside ---------------------------------------------------------------------------------------

    def _step(self, latest: Instant | None = None) -> Instant:
        step = Instant(self._clock.now() + _STEP_NS)
        return step if latest is None else min(step, latest)

    def _send_torque(self, now: Instant) -> None:
        self._send(self._dialect.set_torque(self._wanted_nm))
        self._repeat_at = Instant(now + REPEAT_NS)

    def _send(self, command: bytes) -> None:
        try:
            self._line.write(command)
        except LineFull as error:
            raise NoAnswer("the load machine takes no commands", str(error), "switch it on") from error
        except OSError as error:
            raise self._gone(error) from error

    def _take_in(self, now: Instant) -> None:
        try:
            data = self._line.read()
        except OSError as error:
            raise self._gone(error) from error
        if not data:
            return
        # CR LF, either alone, or the other way round: instruments and their settings differ
        *lines, rest = (self._rest + data).replace(b"\r", b"\n").split(b"\n")
        self._rest = rest[-LINE_BYTES_MAX:]
        for line in lines:
            if line:
                self._take(line, now)

    def _take(self, line: bytes, now: Instant) -> None:
        seen = self._dialect.read(line)
        if self._identifying and seen is None:
            if len(line) >= 3 and line.isascii() and line.decode("ascii").isprintable():
                self._text = line.strip()
            return
        asked_at = self._asked_at
        if asked_at is None:
            self.tally.unasked += 1
            return
        if seen is None:
            self.tally.spoilt += 1
            self._spoilt += 1
            self._ask_again(now)
            return
        self._asked_at, self._late, self._spoilt = None, 0, 0
        earliest = asked_at + self._on_line(len(self._dialect.ask))
        latest = now - self._on_line(len(line) + 2)
        middle = (earliest + latest) // 2 if latest > earliest else (asked_at + now) // 2
        error = Duration(max(latest - earliest, 0) // 2 + 1)
        self.tally.readings += 1
        self.tally.error_ns_max = max(self.tally.error_ns_max, error)
        reading = LoadReading(Instant(middle), error, seen.torque_nm, seen.speed_rad_s, seen.alarm)
        self._readings.append(reading)
        if seen.alarm:
            raise PeerFault(
                f"the load machine on {self._line.name} is in alarm",
                f"{seen.torque_nm:.3g} N m at {abs(seen.speed_rad_s):.0f} rad/s",
                "see its display, clear the cause and switch the alarm off there",
            )

    def _ask_again(self, now: Instant) -> None:
        self._asked_at = None
        if self._late >= ATTEMPTS_MAX or self._spoilt >= SPOILT_MAX:
            late, spoilt = self._late, self._spoilt
            self._late = self._spoilt = 0
            raise NoAnswer(
                f"the load machine on {self._line.name} gives no readings",
                f"since the last one {late} answers did not come and {spoilt} were spoilt",
                "check its cable, its supply and its baud rate",
            )
        self._rest = b""
        self._quiet_until = Instant(now + QUIET_NS)
        self._next_at = self._quiet_until

    def _on_line(self, count: int) -> int:
        return count * BITS_A_BYTE * NS_PER_S // self._settings.baud

    def _gone(self, error: OSError) -> PeerFault:
        return PeerFault("the load machine's port is gone", str(error), "check its cable")
