"""Where a maker's drives keep the gains of their own current, speed and position loops.

    [gains]
    source = "..."
    [gains.speed]
    form = "parallel"                   P + I/s + D s; or "ideal": P (1 + I/s + D s)
    output = "torque"                   or "current"; of a position loop also "speed"
    ampere = "rms"                      of an output "current", as in [motor]
    rate_hz = 2500                      how often the loop is computed
    p = { index = 0x30A2, sub = 1, type = "UNSIGNED32", unit = 1e-6 }
    i = ...

The loops, their gains and SI units are :data:`LOOPS` and :data:`GAINS`. ``unit``: SI units of one raw unit.
Without it no source tells the unit, and without ``form`` none tells the structure: such gains are read, shown
and put back, and none is computed.
"""

import math
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Final, NamedTuple

from servobench.drivers.errors import BadInput
from servobench.drivers.vendors.motor_objects import QUANTITIES, TYPES, one_line, refuse_unknown


class GainUnits(NamedTuple):
    """SI units of the gains of a loop, of the parallel form."""

    p: str
    i: str
    d: str


LOOPS: Final[Mapping[str, Mapping[str, GainUnits]]] = MappingProxyType({
    "current": MappingProxyType({"voltage": GainUnits("V/A", "V/(A s)", "V s/A")}),
    "speed": MappingProxyType({
        "torque": GainUnits("N m s/rad", "N m/rad", "N m s^2/rad"),
        "current": GainUnits("A s/rad", "A/rad", "A s^2/rad"),
    }),
    "position": MappingProxyType({
        "speed": GainUnits("1/s", "1/s^2", "1"),
        "torque": GainUnits("N m/rad", "N m/(rad s)", "N m s/rad"),
        "current": GainUnits("A/rad", "A/(rad s)", "A s/rad"),
    }),
})  # fmt: skip
"""By loop and by what it puts out. An ideal I is 1/s, an ideal D s. V/A are the same in rms and in peak
values."""
GAINS: Final[Mapping[str, str]] = MappingProxyType({
    "p": "proportional gain",
    "i": "integral gain",
    "d": "differential gain",
    "p_d": "proportional gain, d axis",
    "i_d": "integral gain, d axis",
    "filter_hz": "cut-off frequency of the filter",
    "feed_speed": "feed-forward of the speed",
    "feed_acceleration": "feed-forward of the acceleration",
})  # fmt: skip
"""By key: title. Without ``p_d`` a current loop's gains are those of both axes."""
FORMS: Final = ("parallel", "ideal")
REAL: Final = "REAL32"
GAIN_TYPES: Final = (*TYPES, REAL)
"""Data types by their CiA 301 names."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GainObject:
    """An object with one gain."""

    index: int
    sub: int = 0
    type: str
    """One of :data:`GAIN_TYPES`."""
    unit: float | None = None
    """SI units of one raw unit; None: not told."""

    @property
    def octets(self) -> int:
        """Length of its value."""
        return 4 if self.type == REAL else TYPES[self.type][0]

    def raw(self, data: bytes) -> float:
        """Decode the octets of an upload. Raises ValueError for too few."""
        if len(data) < self.octets:
            raise ValueError(f"{data.hex(' ') or 'no octet'} is no {self.type}")
        if self.type == REAL:
            return float(struct.unpack("<f", data[:4])[0])
        return int.from_bytes(data[: self.octets], "little", signed=TYPES[self.type][1])

    def data(self, raw: float) -> bytes:
        """Encode a raw value, rounded to what the type holds. Raises OverflowError."""
        if self.type == REAL:
            return struct.pack("<f", raw)
        return round(raw).to_bytes(self.octets, "little", signed=TYPES[self.type][1])

    def value(self, raw: float) -> float | None:
        """Return a raw value in SI units; None where its unit is not told."""
        return None if self.unit is None else raw * self.unit

    def nearest(self, value: float) -> float:
        """Return the raw value nearest to one in SI units, within the type. Raises ValueError: no unit."""
        if self.unit is None:
            raise ValueError("the unit is not told")
        if self.type == REAL:
            return float(struct.unpack("<f", struct.pack("<f", value / self.unit))[0])
        octets, signed = TYPES[self.type]
        most = (1 << (8 * octets - signed)) - 1
        return min(max(round(value / self.unit), -most - 1 if signed else 0), most)


@dataclass(frozen=True, slots=True, kw_only=True)
class LoopGains:
    """The gain objects of one loop."""

    loop: str
    """Key of :data:`LOOPS`."""
    form: str = ""
    """One of :data:`FORMS`; empty: not told."""
    output: str = ""
    """What the loop puts out; empty: not told."""
    ampere: str = "own"
    """Convention of an output "current": a word of the torque constant in
    :data:`servobench.drivers.vendors.motor_objects.QUANTITIES`."""
    rate_hz: float | None = None
    objects: Mapping[str, GainObject] = field(default_factory=dict)
    """By keys of :data:`GAINS`."""

    @property
    def lack(self) -> str:
        """What keeps the bench from computing P and I; empty: nothing does."""
        if not self.form:
            return f"no public document tells the structure of the {self.loop} loop"
        if not self.output:
            return f"no public document tells what the {self.loop} loop puts out"
        untold = [key for key in ("p", "i", "d") if key in self.objects and self.objects[key].unit is None]
        if "p" not in self.objects or untold:
            return f"no public document tells the unit of {', '.join(untold) or 'p'} of the {self.loop} loop"
        return ""

    def unit_of(self, key: str) -> str:
        """Return the SI unit of a gain, as text; empty where it is not told."""
        each = self.objects.get(key)
        if key == "filter_hz":
            return "Hz"
        if each is None or each.unit is None or not self.output:
            return ""
        units, kind = LOOPS[self.loop][self.output], key[0]
        if kind == "p":
            return units.p
        if kind == "i":
            return "1/s" if self.form == "ideal" else units.i
        if kind == "d":
            return "s" if self.form == "ideal" else units.d
        return ""

    def parallel(self, held: Mapping[str, float]) -> dict[str, float]:
        """Return P, I and D in the parallel form and SI units, of raw values by key; what is absent is 0."""
        told = {key: self.objects[key].value(raw) or 0.0 for key, raw in held.items() if key in "pid"}
        scale = told.get("p", 0.0) if self.form == "ideal" else 1.0
        return {
            "p": told.get("p", 0.0),
            "i": scale * told.get("i", 0.0),
            "d": scale * told.get("d", 0.0),
        }

    def raw(self, parallel: Mapping[str, float]) -> dict[str, float]:
        """Return raw values by key of P, I and D in the parallel form and SI units.

        Raises ValueError where :attr:`lack` says so, for a gain that no object takes, and for an ideal form
        without P.
        """
        if self.lack:
            raise ValueError(self.lack)
        values: dict[str, float] = {}
        for key, value in parallel.items():
            if key not in self.objects:
                if value:
                    raise ValueError(f"the {self.loop} loop has no {GAINS[key]}")
                continue
            if self.form == "ideal" and key != "p":
                if not parallel["p"]:
                    raise ValueError(f"an ideal form has no {GAINS[key]} without P")
                value /= parallel["p"]
            values[key] = self.objects[key].nearest(value)
        for key, twin in (("p", "p_d"), ("i", "i_d")):
            if key in values and twin in self.objects:
                values[twin] = self.objects[twin].nearest(self.objects[key].value(values[key]) or 0.0)
        return values


@dataclass(frozen=True, slots=True, kw_only=True)
class GainObjects:
    """The gain objects of one family of drives."""

    source: str
    loops: Mapping[str, LoopGains]
    """By keys of :data:`LOOPS`; what no source tells is absent."""

    def __iter__(self) -> Iterator[GainObject]:
        """Iterate over all objects."""
        for loop in self.loops.values():
            yield from loop.objects.values()


def read_gains(table: Mapping[str, Any], name: str) -> GainObjects:
    """Read the ``[gains]`` table of the file ``name``. Raises BadInput."""
    source = one_line(table.get("source"))
    if not source:
        raise BadInput(name, "gains.source", table.get("source"), "where the objects stand")
    refuse_unknown(table, {"source", *LOOPS}, name, "gains.")
    return GainObjects(
        source=source, loops={key: _loop(key, table[key], name) for key in LOOPS if key in table}
    )


def _loop(loop: str, table: Mapping[str, Any], name: str) -> LoopGains:
    place = f"gains.{loop}"
    refuse_unknown(table, {"form", "output", "ampere", "rate_hz", *GAINS}, name, f"{place}.")
    outputs, words = tuple(LOOPS[loop]), tuple(QUANTITIES["torque_constant_nm_a"].words)
    for key, known in (("form", FORMS), ("output", outputs), ("ampere", words)):
        if key in table and table[key] not in known:
            raise BadInput(name, f"{place}.{key}", table[key], f"one of {', '.join(known)}")
    if not table.get("rate_hz", 1.0) > 0.0:
        raise BadInput(name, f"{place}.rate_hz", table["rate_hz"], "a value > 0")
    return LoopGains(
        loop=loop,
        form=table.get("form", ""),
        output=table.get("output", outputs[0] if len(outputs) == 1 else ""),
        ampere=table.get("ampere", "own"),
        rate_hz=table.get("rate_hz"),
        objects={key: _object(f"{place}.{key}", table[key], name) for key in GAINS if key in table},
    )


def _object(place: str, table: Mapping[str, Any], name: str) -> GainObject:
    refuse_unknown(table, {"index", "sub", "type", "unit"}, name, f"{place}.")
    if not isinstance(table.get("index"), int):
        raise BadInput(name, f"{place}.index", table.get("index"), "the index of an object")
    if table.get("type") not in GAIN_TYPES:
        raise BadInput(name, f"{place}.type", table.get("type"), f"one of {', '.join(GAIN_TYPES)}")
    if not (table.get("unit", 1.0) > 0.0 and math.isfinite(table.get("unit", 1.0))):
        raise BadInput(name, f"{place}.unit", table["unit"], "a value > 0")
    return GainObject(**table)
