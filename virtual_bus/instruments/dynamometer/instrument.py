"""A Magtrol dynamometer controller without I/O: commands in, data strings out, a brake behind it.

Sources as in :mod:`drivers.instruments.magtrol`. Commands end with CR LF; what is not understood is counted,
as the real instrument shows it on its display, and is not answered. Of the command set: *IDN?, OD, Q, MODE;
of a DSP7000 with the number of the channel. The data string has a fixed length: six digits of speed (a
DSP6001: five), five characters of torque with its point, the direction.
"""

import math

from drivers.rotation import RAD_S_PER_RPM
from drivers.timebase import Instant
from virtual_bus.instruments.dynamometer.brake import Brake

LINE_BYTES_MAX = 256
_TORQUE_WIDTH = 5
_REST_RPM = 0.5


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
        rpm = self.brake.speed_rad_s(now) / RAD_S_PER_RPM
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
