"""Values of defaults, limits and parameters, by the data type of their object."""

import struct
from dataclasses import dataclass
from typing import NamedTuple

from servobench.drivers.canopen.data_types import REAL_BITS, SIGNED_BITS, TIME_BITS, UNSIGNED_BITS, DataType
from servobench.drivers.canopen.objects301 import Cia301, is_communication, is_mapping
from servobench.drivers.cia402.profile import DRIVE_PROFILE
from servobench.drivers.sheets.eds import types
from servobench.drivers.sheets.eds.numbers import (
    LENGTH_MAX,
    Formula,
    Spelled,
    formula,
    integer,
    is_formula,
    real,
)
from servobench.drivers.sheets.eds.sections import EdsSection, Option

Scalar = int | float | str | bytes
_NO_NUMBER = frozenset({"-", "--", "n/a", "na", "none", "null", "?", "unknown", "var", "variable"})


class Value(NamedTuple):
    """The value of an option: a value, or a formula of the node-ID; neither if it is empty."""

    value: Scalar | None = None
    formula: Formula | None = None
    text: str = ""

    def at(self, node_id: int | None) -> Scalar | None:
        """Return the value on a node; None if it needs a node-ID and none is given."""
        if self.formula is None:
            return self.value
        return None if node_id is None else self.formula.at(node_id)


NOTHING = Value()


@dataclass(frozen=True, slots=True)
class Place:
    """The object that a value belongs to, and the line of its option."""

    section: EdsSection
    index: int
    sub: int | None
    data_type: int


def read_value(option: Option | None, place: Place) -> Value:
    """Read a default, limit or parameter value of the object's type; an impossible one is left out."""
    if option is None:
        return NOTHING
    if place.data_type in types.TEXT_TYPES:
        return Value(option.value, text=option.value)
    if place.data_type in types.BYTE_TYPES:
        return _bytes(option, place)
    if place.data_type in REAL_BITS:
        return _real(option, place)
    if is_formula(option.value):
        return _formula(option, place)
    return _integer(option, place)


def _bytes(option: Option, place: Place) -> Value:
    tidy = option.value.replace(" ", "").replace(",", "")
    digits = tidy[2:] if tidy[:2].lower() == "0x" else tidy
    try:
        return Value(bytes.fromhex(digits), text=option.value)
    except ValueError:
        pass
    if place.data_type == DataType.OCTET_STRING:
        _note(option, place, "read as text")
        return Value(option.value.encode("latin-1", errors="replace"), text=option.value)
    _note(option, place, "left out, for a DOMAIN holds octets")
    return NOTHING


def _real(option: Option, place: Place) -> Value:
    bits = REAL_BITS[place.data_type]
    text = option.value.strip()
    if text[:2].lower() == "0x":
        pattern = integer(text)
        if pattern is not None and 0 <= pattern.value < 1 << bits:
            if not pattern.value:
                return Value(0.0, text=text)
            raw = pattern.value.to_bytes(bits // 8, "little")
            value = struct.unpack("<f" if bits == 32 else "<d", raw)[0]
            _note(option, place, f"taken for the bits of {value:g}")
            return Value(value, text=text)
    spelled = real(text)
    if spelled is None:
        _note(option, place, f"left out, for {_no_number(option)}")
        return NOTHING
    if spelled[1]:
        _note(option, place, f"{spelled[1]}: read as {spelled[0]:g}")
    return Value(spelled[0], text=text)


def _no_number(option: Option) -> str:
    long = len(option.value) > LENGTH_MAX
    return f"no number has {len(option.value)} characters" if long else "it is no number"


def _formula(option: Option, place: Place) -> Value:
    parsed = formula(option.value)
    if parsed is None:
        _note(option, place, "left out, for it is no formula of $NODEID")
        return NOTHING
    read = _formula_text(parsed)
    if parsed.oddity:
        _note(option, place, f"{parsed.oddity}: read as {read}")
    return Value(None, parsed, read)


def _formula_text(parsed: Formula) -> str:
    node = "$NODEID" if parsed.factor == 1 else f"{parsed.factor}*$NODEID"
    return f"{node}+0x{parsed.base & 0xFFFF_FFFF:X}"


def _integer(option: Option, place: Place) -> Value:
    spelled = _spelled(option.value, place)
    if spelled is None:
        none = option.value.strip().lower() in _NO_NUMBER
        _note(option, place, "left out" if none else f"left out, for {_no_number(option)}")
        return NOTHING
    value, oddity = fitted(spelled.value, place.data_type, option.value)
    if value is None:
        name = types.type_name(place.data_type)
        _note(option, place, f"left out, for {name} does not hold it")
        return NOTHING
    oddity = spelled.oddity or oddity
    if oddity:
        _note(option, place, f"{oddity}: read as {value}")
    return Value(value, text=option.value)


def _spelled(text: str, place: Place) -> Spelled | None:
    """Parse a number; digits that make sense only as hexadecimal are read as such."""
    spelled = integer(text)
    if spelled is None or not text.strip().isdecimal():
        return spelled
    digits = text.strip()
    wide = int(digits, 16)
    if is_mapping(place.index) and place.sub:
        hexadecimal = len(digits) == 8 and wide >> 16 >= 0x1000 and 1 <= wide & 0xFF <= 64
    elif place.index == Cia301.DEVICE_TYPE:
        hexadecimal = wide & 0xFFFF == DRIVE_PROFILE and spelled.value & 0xFFFF != DRIVE_PROFILE
    elif (is_communication(place.index) and place.sub == 1) or place.index in types.COB_ID_OBJECTS:
        # Bits 11 to 29 of a COB-ID of 11 bits are 0.
        hexadecimal = len(digits) == 8 and wide & 0x3FFF_F800 == 0
    else:
        hexadecimal = False
    return Spelled(wide, "hexadecimal without 0x") if hexadecimal else spelled


def fitted(value: int, data_type: int, text: str) -> tuple[int | None, str]:
    """Return the value as its type holds it, with any oddity; None if it does not fit.

    A signed value may be written as its bits: FFFFFFFFh for -1 is common, and no fault in hexadecimal.
    """
    signed = SIGNED_BITS.get(data_type)
    if signed is not None:
        if -1 << (signed - 1) <= value < 1 << (signed - 1):
            return value, ""
        if 0 <= value < 1 << signed:
            odd = "" if "x" in text.lower() else "beyond its signed type"
            return value - (1 << signed), odd
        return None, ""
    bits = UNSIGNED_BITS.get(data_type) or TIME_BITS.get(data_type)
    if bits is None or 0 <= value < 1 << bits:
        return value, ""
    if data_type == DataType.BOOLEAN:
        return 1, "beyond BOOLEAN"
    if -1 << (bits - 1) <= value < 0:
        return value + (1 << bits), "negative in an unsigned type"
    return None, ""


def _note(option: Option, place: Place, action: str) -> None:
    place.section.mend(f"{option.name} is {option.value[:60]!r}", action, option.line)
