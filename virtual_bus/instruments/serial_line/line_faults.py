"""What goes wrong on a simulated serial line, drawn from a seed: faults of cables, boards and firmware."""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from drivers.errors import BadInput
from drivers.key_advice import nearest
from drivers.timebase import NS_PER_S, Duration, Instant, duration_s

_PROBABILITIES = ("drop", "garble", "truncate", "noise", "terminator", "refuse", "lose")
BITS_A_BYTE = 10
"""Start bit, eight data bits, stop bit."""


@dataclass(frozen=True, slots=True)
class LineFaults:
    """Probabilities are per line (what ends with a terminator) from the device to the host."""

    baud: int = 0
    """Bytes take their time in both directions; 0: as fast as a USB adapter hands them on."""
    drop: float = 0.0
    """The line does not come at all."""
    garble: float = 0.0
    """One byte of it becomes another."""
    truncate: float = 0.0
    """Its end is missing, terminator included."""
    noise: float = 0.0
    """Bytes that mean nothing come before it."""
    terminator: float = 0.0
    """It ends with a line feed instead of its own terminator."""
    lose: float = 0.0
    """A byte of what the host sends gets lost, per piece that the device reads."""
    late_ms: float = 0.0
    """So much later than it could come."""
    unplug_after_s: float = 0.0
    """The device goes away so long after its start; 0: never."""
    refuse: float = 0.0
    """A frame to be sent is refused, as with a full transmit queue; for adapters only."""
    status: int = 0
    """Flags that an adapter tells beside its own when asked for its status."""

    @classmethod
    def parse(cls, entries: list[str], option: str = "--fault") -> "LineFaults":
        """From ``NAME=VALUE`` each. Raises BadInput."""
        known = {field.name: field.type for field in fields(cls)}
        values: dict[str, Any] = {}
        for entry in entries:
            name, sign, text = entry.partition("=")
            if name not in known or not sign:
                near = nearest(name, known)
                remedy = f"did you mean {near}?" if near else f"known are {', '.join(known)}"
                raise BadInput(option, "", entry, "NAME=VALUE of a fault of the line", remedy)
            values[name] = _number(entry, text, known[name] is int, option)
        for name in _PROBABILITIES:
            if not 0.0 <= values.get(name, 0.0) <= 1.0:
                raise BadInput(option, "", f"{name}={values[name]}", "a probability, 0 to 1")
        return cls(**values)

    def time_on_line(self, count: int) -> Duration:
        """How long ``count`` bytes take."""
        return Duration(-(-count * BITS_A_BYTE * NS_PER_S // self.baud) if self.baud else 0)

    def goes_at(self, started_at: Instant) -> Instant | None:
        """When the device goes away; None: never."""
        return Instant(started_at + duration_s(self.unplug_after_s)) if self.unplug_after_s else None


def _number(entry: str, text: str, whole: bool, option: str) -> float:
    try:
        value = int(text, 0) if whole else float(text)
    except ValueError:
        value = -1.0
    if not 0.0 <= value < 1e9:
        raise BadInput(option, "", entry, f"{'a whole number' if whole else 'a number'} not below 0")
    return value


class LineSpoiler:
    """Does to lines what :class:`LineFaults` asks for; every fault has a random stream of its own."""

    def __init__(self, faults: LineFaults, seed: int) -> None:
        self.faults = faults
        self.spoilt = 0
        """Lines that did not go out as they should have."""
        self._streams = {
            name: np.random.Generator(np.random.PCG64([seed, number]))
            for number, name in enumerate(_PROBABILITIES)
        }

    def strikes(self, name: str) -> bool:
        """Whether the fault ``name`` happens this time."""
        probability: float = getattr(self.faults, name)
        return probability > 0.0 and bool(self._streams[name].random() < probability)

    def lose(self, data: bytes) -> bytes:
        """What of ``data``, sent by the host, gets to the device."""
        if not data or not self.strikes("lose"):
            return data
        self.spoilt += 1
        place = int(self._streams["lose"].integers(len(data)))
        return data[:place] + data[place + 1 :]

    def spoil(self, line: bytes) -> bytes:
        """What of ``line``, which ends with its terminator, gets to the host."""
        spoilt = line
        if self.strikes("terminator"):
            spoilt = spoilt.rstrip(b"\r\n") + b"\n"
        if self.strikes("garble"):
            place = int(self._streams["garble"].integers(len(spoilt)))
            other = bytes([(spoilt[place] + 1 + int(self._streams["garble"].integers(255))) & 0xFF])
            spoilt = spoilt[:place] + other + spoilt[place + 1 :]
        if self.strikes("truncate"):
            spoilt = spoilt[: int(self._streams["truncate"].integers(len(spoilt)))]
        if self.strikes("drop"):
            spoilt = b""
        if self.strikes("noise"):
            spoilt = self._streams["noise"].bytes(int(self._streams["noise"].integers(1, 9))) + spoilt
        self.spoilt += spoilt != line
        return spoilt
