"""Where a maker's drives keep the motor data entered into them, and in which convention.

    [motor]
    source = "..."                      source of the whole table
    whole = true                        optional: taken only where the drive has every object of the table
    [motor.resistance_ohm]
    index = 0x2701
    sub = 1                             0 if absent
    type = "UNSIGNED16"
    unit = 1e-3                         ohm of one raw unit; 1 if absent
    between = "lines"                   or "phase", of the star that stands for the winding
    unset = [800]                       raw values that mean "not set", beside 0

The quantities and the words of their conventions are :data:`QUANTITIES`. They are values that somebody
entered: nothing here is measured.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final, NamedTuple

from servobench.drivers.errors import BadInput


class MotorQuantity(NamedTuple):
    """A motor quantity that a drive may hold."""

    title: str
    unit: str
    """SI; per phase of the star, current rms."""
    key: str
    """Key of the convention; empty if there is only one."""
    words: Mapping[str, float]
    """The possible conventions, each with the factor to ``unit``."""


_ONE: Final[Mapping[str, float]] = MappingProxyType({"": 1.0})
_BETWEEN: Final[Mapping[str, float]] = MappingProxyType({"phase": 1.0, "lines": 0.5})
"""Between two lines of a star lie two phases; a delta is treated as its equivalent star."""
QUANTITIES: Final[Mapping[str, MotorQuantity]] = MappingProxyType({
    "pole_pairs": MotorQuantity("pole pairs", "", "", _ONE),
    "resistance_ohm": MotorQuantity("resistance", "ohm", "between", _BETWEEN),
    "inductance_d_h": MotorQuantity("inductance d", "H", "between", _BETWEEN),
    "inductance_q_h": MotorQuantity("inductance q", "H", "between", _BETWEEN),
    "rated_current_a": MotorQuantity(
        "rated current", "A rms", "ampere", {"rms": 1.0, "peak": 1.0 / math.sqrt(2.0), "own": 1.0}
    ),
    "torque_constant_nm_a": MotorQuantity(
        "torque constant", "N m/A rms", "ampere", {"rms": 1.0, "peak": math.sqrt(2.0), "own": 1.0}
    ),
})  # fmt: skip
"""``own``: no source says whether the drive's ampere is rms or peak; its currents all are in the same."""
TYPES: Final[Mapping[str, tuple[int, bool]]] = MappingProxyType({
    "INTEGER8": (1, True), "UNSIGNED8": (1, False), "INTEGER16": (2, True),
    "UNSIGNED16": (2, False), "INTEGER32": (4, True), "UNSIGNED32": (4, False),
})  # fmt: skip
"""Data types by their CiA 301 names: number of octets, and True if signed."""
POLE_PAIRS_MAX: Final = 200
"""Torque motors have some tens, and this many make 1 kHz in the windings at 300 r/min: more is a slip of the
pen, or an object that holds something else."""


class NotTold(ValueError):
    """A raw value that says nothing about a motor; the text says why."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MotorObject:
    """An object with one quantity."""

    quantity: str
    """Key of :data:`QUANTITIES`."""
    index: int
    sub: int = 0
    type: str
    """Key of :data:`TYPES`."""
    unit: float = 1.0
    convention: str = ""
    unset: tuple[int, ...] = ()

    @property
    def factor(self) -> float:
        """SI units, by the convention of :class:`MotorQuantity`, of one raw unit."""
        return self.unit * QUANTITIES[self.quantity].words[self.convention]

    def value(self, data: bytes) -> tuple[float, int]:
        """Decode the octets of an upload: the value in SI units, and raw.

        Extra octets are tolerated if the value fits the type. Raises NotTold for a value that is outside the
        type, was never set, or is impossible.
        """
        octets, signed = TYPES[self.type]
        raw = int.from_bytes(data, "little", signed=signed)
        if len(data) < octets or not -self._most - 1 <= raw <= self._most:
            raise NotTold(f"{data.hex(' ') or 'no octet'} is no {self.type}")
        if raw == 0 or raw in self.unset:
            raise NotTold(f"{raw}, as nobody has set it")
        value = raw * self.factor
        if value < 0.0 or (self.quantity == "pole_pairs" and not _is_count(value)):
            raise NotTold(f"{raw}, which cannot be")
        return value, raw

    def raw(self, value: float) -> int:
        """Return the raw value nearest to a value in SI units; limited to the largest of the type."""
        return min(max(1, round(value / self.factor)), self._most)

    @property
    def _most(self) -> int:
        octets, signed = TYPES[self.type]
        return int((1 << (8 * octets - signed)) - 1)


def _is_count(value: float) -> bool:
    return value == int(value) <= POLE_PAIRS_MAX


@dataclass(frozen=True, slots=True, kw_only=True)
class MotorObjects:
    """The objects of one family of drives."""

    source: str
    whole: bool = False
    """Only a drive with all of these objects keeps the quantities there: other drives of the maker use the
    same indices for something else."""
    objects: tuple[MotorObject, ...]


def refuse_unknown(table: Mapping[str, Any], known: set[str], name: str, place: str = "") -> None:
    """Raise BadInput for an unknown key of ``table``, at ``place`` in the file ``name``."""
    for key in table:
        if key not in known:
            raise BadInput(name, f"{place}{key}", table[key], f"one of {', '.join(sorted(known))}")


def one_line(text: object) -> str:
    """Return a source without the line ends that TOML keeps; empty for none."""
    return " ".join(str(text or "").split())


def read_motor_objects(table: Mapping[str, Any], name: str) -> MotorObjects:
    """Read the ``[motor]`` table of the file ``name``. Raises BadInput."""
    source = one_line(table.get("source"))
    if not source:
        raise BadInput(name, "motor.source", table.get("source"), "where the objects stand")
    refuse_unknown(table, {"source", "whole", *QUANTITIES}, name, "motor.")
    return MotorObjects(
        source=source,
        whole=bool(table.get("whole", False)),
        objects=tuple(_object(key, table[key], name) for key in QUANTITIES if key in table),
    )


def _object(quantity: str, table: Mapping[str, Any], name: str) -> MotorObject:
    convention, words = QUANTITIES[quantity].key, QUANTITIES[quantity].words
    known = {"index", "sub", "type", "unit", "unset"} | ({convention} if convention else set())
    place = f"motor.{quantity}"
    refuse_unknown(table, known, name, f"{place}.")
    if not isinstance(table.get("index"), int):
        raise BadInput(name, f"{place}.index", table.get("index"), "the index of an object")
    if table.get("type") not in TYPES:
        raise BadInput(name, f"{place}.type", table.get("type"), f"one of {', '.join(TYPES)}")
    if convention and table.get(convention) not in words:
        raise BadInput(name, f"{place}.{convention}", table.get(convention), f"one of {', '.join(words)}")
    if not table.get("unit", 1.0) > 0.0:
        raise BadInput(name, f"{place}.unit", table["unit"], "a value > 0")
    return MotorObject(
        quantity=quantity,
        index=table["index"],
        sub=table.get("sub", 0),
        type=table["type"],
        unit=float(table.get("unit", 1.0)),
        convention=table[convention] if convention else "",
        unset=tuple(table.get("unset", ())),
    )
