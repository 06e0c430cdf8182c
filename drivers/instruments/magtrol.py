"""The serial protocol of Magtrol's dynamometer controllers; no I/O.

Sources: DSP6001 user's manual, chapter 8 (8.6, command set); DSP7000 user's manual, 7.2 (data format), 7.4
(command set; 7.4.2 OD, 7.4.6 Q, 7.4.7 MODE); DSP6000 manual, chapter 5 (serial line, example of the data
string: ``S 1725T22.60R``). Commands are upper case, one a line, ended by CR LF. Only OD, *IDN? and their
like are answered; a command that is not understood shows on the instrument's own display and nowhere else.
There is no checksum: a digit that became another digit passes for a reading.
"""

import re
from typing import NamedTuple

from servobench.drivers.rotation import RAD_S_PER_RPM

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
