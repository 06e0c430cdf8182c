"""How a drive stamps its samples: which object, its unit, and when it is latched.

    [stamp]
    source = "..."                      source of the whole table
    index = 0x2F31                      1013h if absent
    sub = 0
    unit_us = 1.0                       one count
    resolution_us = 1.0                 by how much it advances at a time; a count if absent,
    resolution = "bit time"             or one bit of the bus
    bits = 32                           it counts modulo 2^bits
    latched = "arrival"                 at the end of the last SYNC, or at the "sampling", the default

The object is an UNSIGNED32. Keys left out default to 1013h of CiA 301 (7.5.2.16).
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import NS_PER_S, NS_PER_US, Duration
from servobench.drivers.vendors.motor_objects import one_line, refuse_unknown

_KEYS: Final = {
    "source", "index", "sub", "unit_us", "resolution_us", "resolution", "bits", "latched",
}  # fmt: skip
BIT_TIME: Final = "bit time"
LATCHED: Final = ("sampling", "arrival")
READS: Final = 4
"""Consecutive reads of a counter: SYNCs less than two read intervals apart cannot all fall outside them."""
BITS: Final = range(16, 33)
_INDEXES: Final = range(0x1000, 0x10000)
_SUBS: Final = range(256)


@dataclass(frozen=True, slots=True, kw_only=True)
class StampProfile:
    """The stamp of one family of drives; the defaults are those of CiA 301."""

    source: str = ""
    index: int = 0x1013
    sub: int = 0
    unit_ns: int = NS_PER_US
    resolution_ns: int = NS_PER_US
    """0: one bit of the bus."""
    bits: int = 32
    latched: str = "sampling"
    """One of :data:`LATCHED`."""

    @property
    def key(self) -> tuple[int, int]:
        """Index and sub-index."""
        return self.index, self.sub

    @property
    def of_events(self) -> bool:
        """True if in an event-driven TPDO the stamp is the instant of the event."""
        return self.latched != "arrival"

    def if_there(self, read: Callable[[int, int], int | None]) -> "StampProfile":
        """Return this profile, or CiA 301's if ``read`` finds no such object: not every drive of a make has
        it."""
        there = self.index == STANDARD_STAMP.index or read(self.index, self.sub) is not None
        return self if there else STANDARD_STAMP

    def as_it_counts(self, read: Callable[[int, int], int | None]) -> "StampProfile":
        """Return this profile, latched at the arrival of the SYNC if it stands still from one ``read`` to the
        next.

        Steps as long as a read look the same. Another master's SYNCs, faster than the reads, hide it.
        """
        if not self.of_events:
            return self
        last = read(*self.key)
        for _ in range(READS - 1):
            if last is None:
                break
            count = read(*self.key)
            if count == last:
                return replace(self, latched="arrival")
            last = count
        return self

    def resolution_at(self, bitrate_bit_s: int) -> Duration:
        """Return the step of the counter on a bus of that bit rate."""
        return Duration(self.resolution_ns or max(self.unit_ns, NS_PER_S // bitrate_bit_s))


STANDARD_STAMP: Final = StampProfile()


def read_stamp(table: Mapping[str, Any], name: str) -> StampProfile:
    """Read the ``[stamp]`` table of the file ``name``. Raises BadInput."""
    refuse_unknown(table, _KEYS, name, "stamp.")
    source = one_line(table.get("source"))
    index, sub, bits = table.get("index", 0x1013), table.get("sub", 0), table.get("bits", 32)
    unit_us, latched = table.get("unit_us", 1.0), table.get("latched", "sampling")
    resolution_us, bit_times = table.get("resolution_us", unit_us), table.get("resolution")
    counted = _is_number(unit_us) and unit_us > 0.0
    finer = counted and not (_is_number(resolution_us) and resolution_us >= unit_us)
    for key, value, right, expected in (
        ("source", table.get("source"), bool(source), "where the stamp is described"),
        ("index", index, index in _INDEXES, "the index of an object"),
        ("sub", sub, sub in _SUBS, "a sub-index, 0..255"),
        ("unit_us", unit_us, counted, "a value > 0"),
        ("resolution_us", resolution_us, not finer, f"at least unit_us = {unit_us}"),
        ("resolution", bit_times, bit_times in (None, BIT_TIME), f'"{BIT_TIME}", or resolution_us'),
        ("bits", bits, bits in BITS, f"{BITS[0]}..{BITS[-1]}"),
        ("latched", latched, latched in LATCHED, f"one of {', '.join(LATCHED)}"),
    ):
        if not right:
            raise BadInput(name, f"stamp.{key}", value, expected)
    return StampProfile(
        source=source,
        index=index,
        sub=sub,
        unit_ns=round(unit_us * NS_PER_US),
        resolution_ns=0 if bit_times else round(resolution_us * NS_PER_US),
        bits=bits,
        latched=latched,
    )


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
