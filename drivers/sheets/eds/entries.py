"""Turns the options of one variable or sub-object into a typed entry."""

import re
from dataclasses import dataclass, field

from servobench.drivers.canopen.data_types import BITS, DataType
from servobench.drivers.canopen.objects301 import Cia301
from servobench.drivers.sheets.eds import types
from servobench.drivers.sheets.eds.numbers import Spelled, integer
from servobench.drivers.sheets.eds.sections import EdsSection, Option, Sections, section_name
from servobench.drivers.sheets.eds.values import NOTHING, Place, Scalar, Value, read_value

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
