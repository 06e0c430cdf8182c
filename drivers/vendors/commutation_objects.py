"""Where a maker's drives keep the angle between encoder and rotor, and the order of the motor's lines.

    [commutation]
    source = "..."
    offset = { index = 0x2001, sub = 0, type = "INTEGER16", turn = 4096 }
    swapped = { index = 0x2003, sub = 5, type = "UNSIGNED8" }
    pole_pairs = { index = 0x2003, sub = 1, type = "UNSIGNED8" }
    angle = { index = ..., type = ..., turn = ... }

``offset`` is added to the encoder's electrical angle, ``angle`` is the sum, by which the drive commutates;
``turn``: raw units of an electrical turn. ``swapped``: 1 for a motor whose angle falls while the encoder's
rises. Each is optional.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from servobench.drivers.errors import BadInput
from servobench.drivers.vendors.motor_objects import TYPES, one_line, refuse_unknown

ANGLES: Final = ("offset", "angle")
COMMUTATION_KEYS: Final = (*ANGLES, "swapped", "pole_pairs")


@dataclass(frozen=True, slots=True, kw_only=True)
class CommutationObject:
    """One object of the table."""

    index: int
    sub: int = 0
    type: str
    """Key of :data:`servobench.drivers.vendors.motor_objects.TYPES`."""
    turn: int = 0
    """Raw units of an electrical turn; 0: it is no angle."""

    def raw(self, data: bytes) -> int:
        """Decode the octets of an upload."""
        octets, signed = TYPES[self.type]
        return int.from_bytes(data[:octets], "little", signed=signed)

    def data(self, raw: int) -> bytes:
        """Encode a value; an angle is brought into the range of its type. Raises OverflowError."""
        octets, signed = TYPES[self.type]
        if self.turn:
            raw %= self.turn
            if raw >= 1 << (8 * octets - signed):
                raw -= self.turn
        return raw.to_bytes(octets, "little", signed=signed)


@dataclass(frozen=True, slots=True, kw_only=True)
class CommutationObjects:
    """The objects of one family of drives; None: no public document tells one."""

    source: str
    offset: CommutationObject | None = None
    angle: CommutationObject | None = None
    swapped: CommutationObject | None = None
    pole_pairs: CommutationObject | None = None

    @property
    def settings(self) -> tuple[CommutationObject, ...]:
        """Those that are written."""
        return tuple(each for each in (self.offset, self.swapped, self.pole_pairs) if each is not None)


def read_commutation(table: Mapping[str, Any], name: str) -> CommutationObjects:
    """Read the ``[commutation]`` table of the file ``name``. Raises BadInput."""
    source = one_line(table.get("source"))
    if not source:
        raise BadInput(name, "commutation.source", table.get("source"), "where the objects stand")
    refuse_unknown(table, {"source", *COMMUTATION_KEYS}, name, "commutation.")
    objects = {key: _object(key, table[key], name) for key in COMMUTATION_KEYS if key in table}
    return CommutationObjects(source=source, **objects)


def _object(key: str, table: Mapping[str, Any], name: str) -> CommutationObject:
    place = f"commutation.{key}"
    refuse_unknown(
        table, {"index", "sub", "type"} | ({"turn"} if key in ANGLES else set()), name, f"{place}."
    )
    if not isinstance(table.get("index"), int):
        raise BadInput(name, f"{place}.index", table.get("index"), "the index of an object")
    if table.get("type") not in TYPES:
        raise BadInput(name, f"{place}.type", table.get("type"), f"one of {', '.join(TYPES)}")
    if key in ANGLES and not table.get("turn", 0) > 0:
        raise BadInput(name, f"{place}.turn", table.get("turn"), "raw units of an electrical turn")
    return CommutationObject(**table)
