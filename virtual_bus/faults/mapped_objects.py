"""Which object lies where in which PDO, as the frames on a connection tell it.

What an SDO writes into the PDO parameters and is confirmed, and what it reads from them, is what the node
has: so it is known on any bus, without a data sheet and for any drive. A boot-up message puts a node's
parameters back to values that nobody has seen.

An object of a dictionary as a fault plan names it, and as the upper 24 bits of a mapping word have it.
"""

import re
from typing import Annotated, Any, Final, NamedTuple

from pydantic import Field, PlainValidator

from servobench.drivers.canopen.cob_ids import (
    CAN_ID,
    ERROR_CONTROL,
    EXTENDED,
    NODE_BITS,
    NOT_VALID,
    RPDOS,
    SDO_ANSWER,
    SDO_REQUEST,
    TPDOS,
)
from servobench.drivers.canopen.objects301 import (
    FIRST_OBJECT,
    MAPPING_OFFSET,
    PDO_PARAMETERS,
    RPDO_MAPPING,
    TPDO_MAPPING,
    is_mapping,
)
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.key_advice import nearest
from servobench.virtual_bus.bus.judge import Direction
from servobench.virtual_bus.frame import Frame

_BY_NAME: Final = {entry.name.lower(): int(entry) for entry in Object}
_BY_NUMBER: Final = re.compile(r"([0-9A-Fa-f]{4})(?::([0-9]{1,3}))?")
_EXPECTED: Final = 'an object, such as "606C", "1A00:1" or "velocity_actual_value"'


def place_of(text: str) -> int:
    """Index and sub-index of ``606C``, ``1A00:1`` or the name of a CiA 402 object. Error: ValueError."""
    if text in _BY_NAME:
        return _BY_NAME[text] << 8
    match = _BY_NUMBER.fullmatch(text)
    if match is None or int(match[2] or 0) > 0xFF:
        actual = f"{text}_actual_value"
        near = actual if actual in _BY_NAME else nearest(text, _BY_NAME)
        raise ValueError(f'"{near}", the nearest name' if near else _EXPECTED)
    return int(match[1], 16) << 8 | int(match[2] or 0)


def place_text(place: int) -> str:
    """``606Ch``, or ``1A00h:1``."""
    return f"{place >> 8:04X}h" + (f":{place & 0xFF}" if place & 0xFF else "")


def _named(value: Any) -> str:
    if not isinstance(value, str):
        raise ValueError(_EXPECTED)  # noqa: TRY004 - pydantic's validators tell by it
    place_of(value)
    return value


ObjectPlace = Annotated[str, PlainValidator(_named), Field(description=_EXPECTED)]
"""A field of a table."""


_PREDEFINED: Final = {Direction.HOST_TO_DRIVE: tuple(RPDOS), Direction.DRIVE_TO_HOST: tuple(TPDOS)}
_DOWNLOAD, _DOWNLOADED, _UPLOADED = 0x20, 0x60, 0x40
_COMMAND, _EXPEDITED, _SIZED = 0xE0, 0x02, 0x01
"""Bits of the first byte of an SDO frame (CiA 301, 7.2.4.3)."""


class SeenObject(NamedTuple):
    """Where an object lies in the frames of a PDO."""

    node: int
    place: int
    """Index and sub-index, as in the upper 24 bits of a mapping word."""
    first_bit: int
    bits: int


class SeenMappings:
    """Learns from frames, in the order in which they pass."""

    def __init__(self) -> None:
        self.revision = 0
        """Counts every change of what is known."""
        self._values: dict[int, dict[int, int]] = {}
        """PDO parameters of each node, by index and sub-index."""
        self._asked: dict[int, tuple[int, int]] = {}
        """By node what it has been asked to store and has not confirmed yet."""
        self._pdos: dict[tuple[int, int], list[SeenObject]] = {}

    @staticmethod
    def teaches(can_id: int) -> bool:
        """Return True if frames with that identifier may show mappings."""
        return SDO_ANSWER < can_id <= SDO_REQUEST + NODE_BITS or ERROR_CONTROL < can_id <= CAN_ID

    def objects(self, way: int, can_id: int) -> list[SeenObject]:
        """Return the objects in the PDO of that direction and identifier; empty if no such PDO is known."""
        return self._pdos.get((way, can_id), [])

    @property
    def nodes(self) -> frozenset[int]:
        """Those of which a PDO parameter is known."""
        return frozenset(self._values)

    def carries(self, node: int, place: int, ways: tuple[int, ...]) -> bool:
        """Return True if a known PDO of ``node`` carries an object, in one of those directions."""
        return any(
            each.node == node and each.place == place
            for (way, _), objects in self._pdos.items()
            if way in ways
            for each in objects
        )

    def watch(self, way: int, frame: Frame) -> None:
        """A frame passes."""
        node, data = frame.can_id & NODE_BITS, frame.data
        service = frame.can_id - node
        if service == ERROR_CONTROL:
            if way == Direction.DRIVE_TO_HOST and data == b"\x00":
                self._asked.pop(node, None)
                self._learn(node, None)
        elif len(data) == 8 and int.from_bytes(data[1:3], "little") in PDO_PARAMETERS:
            place = int.from_bytes(data[1:3], "little") << 8 | data[3]
            if service == SDO_REQUEST and way == Direction.HOST_TO_DRIVE:
                self._ask(node, place, data)
            elif service == SDO_ANSWER and way == Direction.DRIVE_TO_HOST:
                self._answer(node, place, data)

    def _ask(self, node: int, place: int, data: bytes) -> None:
        self._asked.pop(node, None)
        if data[0] & _COMMAND == _DOWNLOAD and data[0] & _EXPEDITED:
            self._asked[node] = place, _value(data)

    def _answer(self, node: int, place: int, data: bytes) -> None:
        asked = self._asked.pop(node, None)
        if data[0] & _COMMAND == _DOWNLOADED and asked is not None and asked[0] == place:
            self._learn(node, asked)
        elif data[0] & _COMMAND == _UPLOADED and data[0] & _EXPEDITED:
            self._learn(node, (place, _value(data)))

    def _learn(self, node: int, value: tuple[int, int] | None) -> None:
        """``value``: of a parameter; None: nothing about the node is known any more."""
        values = self._values.setdefault(node, {})
        if value is None:
            del self._values[node]
        elif values.get(value[0]) == value[1]:
            return
        else:
            values[value[0]] = value[1]
        self.revision += 1
        self._pdos = {}
        for each, known in self._values.items():
            for place in known:
                if is_mapping(place >> 8) and not place & 0xFF:
                    self._place(each, place >> 8, known)

    def _place(self, node: int, mapping: int, known: dict[int, int]) -> None:
        """Enter one PDO of which the count is known."""
        transmits = mapping >= TPDO_MAPPING
        way = Direction.DRIVE_TO_HOST if transmits else Direction.HOST_TO_DRIVE
        number = mapping - (TPDO_MAPPING if transmits else RPDO_MAPPING)
        predefined = _PREDEFINED[way]
        usual = predefined[number] + node if number < len(predefined) else NOT_VALID
        cob_id = known.get(mapping - MAPPING_OFFSET << 8 | 1, usual)
        if cob_id & (NOT_VALID | EXTENDED):
            return
        objects = self._pdos.setdefault((int(way), cob_id & CAN_ID), [])
        first_bit = 0
        for sub in range(1, known[mapping << 8] + 1):
            word = known.get(mapping << 8 | sub)
            if word is None:
                return  # what lies behind an entry that nobody has seen is not known
            if word >> 16 >= FIRST_OBJECT:
                objects.append(SeenObject(node, word >> 8, first_bit, word & 0xFF))
            first_bit += word & 0xFF


def _value(data: bytes) -> int:
    """Return the value of an expedited transfer."""
    length = 4 - (data[0] >> 2 & 3) if data[0] & _SIZED else 4
    return int.from_bytes(data[4 : 4 + length], "little")
