"""A Magtrol dynamometer controller without I/O: commands in, data strings out, and behind it a hysteresis
brake on a simulated shaft, with the loop that holds its torque.

Sources as in :mod:`servobench.drivers.instruments.magtrol`. Commands end with CR LF; what is not understood
is counted, as the real instrument shows it on its display, and is not answered. Of the command set: *IDN?,
OD, Q, MODE; of a DSP7000 with the number of the channel. The data string has a fixed length: six digits of
speed (a DSP6001: five), five characters of torque with its point, the direction.
"""

import math
from typing import TYPE_CHECKING, Final

from servobench.drivers.instruments.dynamometer import LINE_BYTES_MAX
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Instant

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
