"""Turns the options of one variable or sub-object into a typed entry.

Values of defaults, limits and parameters, by the data type of their object.
"""

import re
import struct
from dataclasses import dataclass, field
from typing import NamedTuple

from servobench.drivers.canopen.objects301 import (
    BITS,
    REAL_BITS,
    SIGNED_BITS,
    TIME_BITS,
    UNSIGNED_BITS,
    Cia301,
    DataType,
    is_communication,
    is_mapping,
)
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
from servobench.drivers.sheets.eds.sections import EdsSection, Option, Sections, section_name

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


ACCESS_TYPES = ("ro", "wo", "rw", "rwr", "rww", "const")
_SPELLINGS = {
    "ro": "r read readonly",
    "wo": "w write writeonly",
    "rw": "wr readwrite rwrw rowo",
    "const": "constant co",
    "rwr": "rwread readwriteread readwriteinput",
    "rww": "rwwrite readwritewrite readwriteoutput",
}
_ACCESS = {word: access for access, words in _SPELLINGS.items() for word in words.split()}
_MAPPABLE_WORDS = {"default": True, "optional": True, "tpdo": True, "rpdo": True, "pdo": True, "none": False}


@dataclass(slots=True)
class Entry:
    """A variable or a sub-object."""

    index: int
    sub: int
    name: str
    data_type: int = DataType.DOMAIN
    access: str = "rw"
    mappable: bool = False
    default: Value = NOTHING
    configured: Value = NOTHING
    """ParameterValue of a DCF."""
    low: Scalar | None = None
    high: Scalar | None = None
    denotation: str = ""
    flags: int = 0
    """ObjFlags: bit 0 refuses a write on download, bit 1 refuses a read on scan (CiA 306-1)."""
    storage: str | None = None
    extras: dict[str, str] = field(default_factory=dict)
    """Unit, factor and description, which python canopen knows in addition to the standard."""


class EntryReader:
    """Makes entries from sections."""

    def __init__(self, sections: Sections, node_id: int | None) -> None:
        self._defined = {name.upper(): section for name, section in reversed(sections.items())}
        self._node_id = node_id

    def entry(self, section: EdsSection, index: int, sub: int | None) -> Entry:
        """Return the variable (``sub`` None) or sub-object that ``section`` defines."""
        data_type = self.data_type(section, index, sub)
        place = Place(section, index, sub, data_type)
        entry = Entry(
            index,
            sub or 0,
            self.name(section),
            data_type,
            _access(section),
            _mappable(section),
            read_value(section.option("DefaultValue"), place),
            read_value(section.option("ParameterValue"), place),
        )
        self._limits(entry, place)
        entry.denotation = section.text("Denotation")
        entry.flags = section.number("ObjFlags") or 0 if section.option("ObjFlags") else 0
        entry.storage = section.text("StorageLocation") or None
        entry.extras = {
            key: section.text(key) for key in ("Unit", "Factor", "Description") if section.text(key)
        }
        return entry

    def name(self, section: EdsSection) -> str:
        """Return ParameterName; an invented one if it is missing."""
        if section.text("ParameterName"):
            return section.text("ParameterName")
        name = f"Object {section.name}"
        section.mend("ParameterName is missing", f"named {name!r}")
        return name

    def data_type(self, section: EdsSection, index: int, sub: int | None) -> int:
        """Return DataType, or the standard's, or DOMAIN."""
        option = section.option("DataType")
        if option is None:
            empty = section.options.get("datatype")
            fault = "DataType is empty" if empty else "DataType is missing"
            return _supposed_type(section, index, sub, fault, empty.line if empty else section.line)
        code = _type_number(section, option)
        if not code:
            return _supposed_type(section, index, sub, f"DataType is {option.value!r}", option.line)
        if code in types.KNOWN_TYPES:
            return code
        defined = self._defined_type(code)
        if defined is not None:
            return defined
        return _supposed_type(section, index, sub, f"data type {code:04X}h is unknown", option.line)

    def _defined_type(self, code: int) -> int | None:
        """Resolve a limited type, which CANFestival's editor defines in a section [A0], its base in
        [A0sub1]."""
        for name in (f"{code:X}sub1", section_name(code, 1)):
            section = self._defined.get(name.upper())
            spelled = integer(section.text("DefaultValue")) if section is not None else None
            if spelled is not None and spelled.value in types.KNOWN_TYPES:
                return spelled.value
        return None

    def _limits(self, made: Entry, place: Place) -> None:
        if place.data_type not in BITS:
            return
        section = place.section
        low = read_value(section.option("LowLimit"), place).at(self._node_id)
        high = read_value(section.option("HighLimit"), place).at(self._node_id)
        default = made.default.at(self._node_id)
        fault = ""
        if low is not None and high is not None and low > high:  # type: ignore[operator]
            fault = f"LowLimit {low!r} is above HighLimit {high!r}"
        elif low == high == 0 and default and made.access not in ("ro", "const"):
            fault = "both limits are 0, the default is not"
        elif (
            made.index == Cia301.CONSUMER_HEARTBEAT_TIME
            and made.sub
            and isinstance(high, int)
            and high <= 0xFFFF
        ):
            fault = f"HighLimit {high} leaves no room for a node-ID in bits 16 to 22"
        elif _beyond(default, low, high):
            beyond = f"DefaultValue {default!r} is beyond the limits {low!r} to {high!r}"
            section.mend(beyond, "kept", section.options["defaultvalue"].line)
        if fault:
            lines = [section.options[key].line for key in ("lowlimit", "highlimit") if key in section.options]
            section.mend(fault, "both left out", lines[0])
            low = high = None
        made.low, made.high = low, high


def _type_number(section: EdsSection, option: Option) -> int | None:
    text = option.value.strip()
    spelled = integer(text)
    if re.fullmatch(r"0\d{3}", text) and int(text) > 7:
        # Four digits with zeros in front are how type indices are written, and those are hexadecimal.
        spelled = Spelled(int(text, 16), "hexadecimal without 0x")
    if spelled is not None:
        section.note_oddity(option, spelled)
        return spelled.value
    named = types.type_by_name(text)
    if named is not None:
        section.mend(f"DataType is {text!r}", f"read as {types.type_name(named)}", option.line)
    return named


def _supposed_type(section: EdsSection, index: int, sub: int | None, fault: str, line: int) -> int:
    known = types.standard_type(index, sub)
    if known is None and integer(section.text("ObjectType") or "7") == (types.DOMAIN_OBJECT, ""):
        return DataType.DOMAIN
    if known is not None:
        action = f"taken for {types.type_name(known)}, as in the standard"
    elif sub == 0:
        known, action = DataType.UNSIGNED8, "taken for UNSIGNED8, as every sub-index 0"
    else:
        known, action = DataType.DOMAIN, "taken for a DOMAIN"
    section.mend(fault, action, line)
    return known


def _access(section: EdsSection) -> str:
    option = section.options.get("accesstype")
    if option is None or not option.value:
        section.mend("AccessType is missing", "taken for rw", option.line if option else None)
        return "rw"
    text = option.value.strip().lower()
    if text in ACCESS_TYPES:
        return text
    read = _ACCESS.get(re.sub(r"[^a-z]", "", text), "rw")
    section.mend(f"AccessType is {option.value!r}", f"taken for {read}", option.line)
    return read


def _mappable(section: EdsSection) -> bool:
    option = section.option("PDOMapping")
    if option is not None and option.value.strip().lower() in _MAPPABLE_WORDS:
        read = _MAPPABLE_WORDS[option.value.strip().lower()]
        section.mend(f"PDOMapping is {option.value!r}", f"taken for {int(read)}", option.line)
        return read
    return bool(section.number("PDOMapping"))


def _beyond(default: Scalar | None, low: Scalar | None, high: Scalar | None) -> bool:
    if not isinstance(default, int | float):
        return False
    below = isinstance(low, int | float) and default < low
    return below or (isinstance(high, int | float) and default > high)
