"""One variable or sub-object: its options into a typed entry."""

import re
from dataclasses import dataclass, field

from drivers.canopen.data_types import BITS, DataType
from drivers.sheets.eds import types
from drivers.sheets.eds.numbers import integer
from drivers.sheets.eds.repairs import RepairLog
from drivers.sheets.eds.sections import EdsSection, Option, Sections, section_name
from drivers.sheets.eds.standard import standard_type
from drivers.sheets.eds.values import NOTHING, Place, Scalar, Value, read_value

CONSUMER_HEARTBEAT = 0x1016
ACCESS_TYPES = ("ro", "wo", "rw", "rwr", "rww", "const")
_ACCESS = {
    "r": "ro",
    "read": "ro",
    "readonly": "ro",
    "w": "wo",
    "write": "wo",
    "writeonly": "wo",
    "wr": "rw",
    "readwrite": "rw",
    "rwrw": "rw",
    "rowo": "rw",
    "constant": "const",
    "co": "const",
    "rwread": "rwr",
    "rwwrite": "rww",
    "readwriteread": "rwr",
    "readwritewrite": "rww",
    "readwriteinput": "rwr",
    "readwriteoutput": "rww",
}
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
    """Unit, factor and description, which python canopen knows beside the standard."""
    line: int = 0


class EntryReader:
    """Makes entries of sections."""

    def __init__(self, sections: Sections, node_id: int | None, log: RepairLog) -> None:
        self._sections = sections
        self._node_id = node_id
        self._log = log

    def entry(self, section: EdsSection, index: int, sub: int | None) -> Entry:
        """The variable (``sub`` None) or sub-object that ``section`` defines."""
        data_type = self.data_type(section, index, sub)
        place = Place(section.name, index, sub, data_type)
        made = Entry(index, sub or 0, self.name(section), data_type, self._access(section))
        made.line = section.line
        made.mappable = self._mappable(section)
        made.default = read_value(section.option("DefaultValue"), place, self._log)
        made.configured = read_value(section.option("ParameterValue"), place, self._log)
        self._limits(made, section, place)
        made.denotation = section.text("Denotation")
        made.flags = self._flags(section)
        made.storage = section.text("StorageLocation") or None
        made.extras = {
            key: section.text(key) for key in ("Unit", "Factor", "Description") if section.text(key)
        }
        return made

    def name(self, section: EdsSection) -> str:
        """ParameterName; one made up where it is missing."""
        if section.text("ParameterName"):
            return section.text("ParameterName")
        made = f"Object {section.name}"
        self._log.add(section.name, "ParameterName is missing", f"named {made!r}", section.line)
        return made

    def number(self, section: EdsSection, option_name: str) -> int | None:
        """A number of the object's structure; None if it is absent, empty or none, which is noted."""
        option = section.options.get(option_name.lower())
        if option is None:
            return None
        found = integer(option.value) if option.value else None
        if found is None:
            fault = (
                f"{option.name} is empty"
                if not option.value
                else f"{option.name} is {option.value!r}, no number"
            )
            self._log.add(section.name, fault, "left out", option.line)
            return None
        self._note_oddity(section, option, found.value, found.oddity)
        return found.value

    def data_type(self, section: EdsSection, index: int, sub: int | None) -> int:
        """DataType, or the standard's, or DOMAIN."""
        option = section.option("DataType")
        if option is None:
            empty = section.options.get("datatype")
            fault, line = (
                ("DataType is empty", empty.line) if empty else ("DataType is missing", section.line)
            )
            return self._supposed_type(section, index, sub, fault, line)
        code = self._type_number(section, option)
        if code is None or not code:
            return self._supposed_type(section, index, sub, f"DataType is {option.value!r}", option.line)
        if code in types.KNOWN_TYPES:
            return code
        defined = self._defined_type(code)
        if defined is not None:
            return defined
        return self._supposed_type(section, index, sub, f"data type {code:04X}h is unknown", option.line)

    def _type_number(self, section: EdsSection, option: Option) -> int | None:
        text = option.value.strip()
        if re.fullmatch(r"0\d{3}", text) and int(text) > 7:
            # Four digits with zeros in front are how type indices are written, and those are hexadecimal.
            self._note_oddity(section, option, int(text, 16), "hexadecimal without 0x")
            return int(text, 16)
        found = integer(text)
        if found is not None:
            self._note_oddity(section, option, found.value, found.oddity)
            return found.value
        named = types.type_by_name(text)
        if named is not None:
            self._log.add(
                section.name, f"DataType is {text!r}", f"read as {types.type_name(named)}", option.line
            )
        return named

    def _defined_type(self, code: int) -> int | None:
        """CANFestival's editor defines a limited type in a section [A0], its base in [A0sub1]."""
        for name in (f"{code:X}sub1", section_name(code, 1)):
            section = next(
                (self._sections[key] for key in self._sections if key.upper() == name.upper()), None
            )
            found = integer(section.text("DefaultValue")) if section is not None else None
            if found is not None and found.value in types.KNOWN_TYPES:
                return found.value
        return None

    def _supposed_type(self, section: EdsSection, index: int, sub: int | None, fault: str, line: int) -> int:
        known = standard_type(index, sub)
        if known is None and integer(section.text("ObjectType") or "7") == (types.DOMAIN_OBJECT, ""):
            return DataType.DOMAIN
        if known is not None:
            action = f"taken for {types.type_name(known)}, as in the standard"
        elif sub == 0:
            known, action = DataType.UNSIGNED8, "taken for UNSIGNED8, as every sub-index 0"
        else:
            known, action = DataType.DOMAIN, "taken for a DOMAIN"
        self._log.add(section.name, fault, action, line)
        return known

    def _access(self, section: EdsSection) -> str:
        option = section.option("AccessType")
        if option is None:
            line = section.options["accesstype"].line if "accesstype" in section.options else section.line
            self._log.add(section.name, "AccessType is missing", "taken for rw", line)
            return "rw"
        text = option.value.strip().lower()
        if text in ACCESS_TYPES:
            return text
        read = _ACCESS.get(re.sub(r"[^a-z]", "", text), "rw")
        self._log.add(section.name, f"AccessType is {option.value!r}", f"taken for {read}", option.line)
        return read

    def _mappable(self, section: EdsSection) -> bool:
        option = section.option("PDOMapping")
        if option is not None and option.value.strip().lower() in _MAPPABLE_WORDS:
            read = _MAPPABLE_WORDS[option.value.strip().lower()]
            self._log.add(
                section.name, f"PDOMapping is {option.value!r}", f"taken for {int(read)}", option.line
            )
            return read
        return bool(self.number(section, "PDOMapping"))

    def _flags(self, section: EdsSection) -> int:
        return self.number(section, "ObjFlags") or 0 if section.option("ObjFlags") else 0

    def _limits(self, made: Entry, section: EdsSection, place: Place) -> None:
        if place.data_type not in BITS:
            return
        low = read_value(section.option("LowLimit"), place, self._log).at(self._node_id)
        high = read_value(section.option("HighLimit"), place, self._log).at(self._node_id)
        default = made.default.at(self._node_id)
        line = next(
            (section.options[key].line for key in ("lowlimit", "highlimit") if key in section.options), 0
        )
        if low is not None and high is not None and low > high:  # type: ignore[operator]
            self._log.add(
                section.name, f"LowLimit {low!r} is above HighLimit {high!r}", "both left out", line
            )
            low = high = None
        elif low == high == 0 and default and made.access not in ("ro", "const"):
            self._log.add(section.name, "both limits are 0, the default is not", "both left out", line)
            low = high = None
        elif made.index == CONSUMER_HEARTBEAT and made.sub and isinstance(high, int) and high <= 0xFFFF:
            fault = f"HighLimit {high} leaves no room for a node-ID in bits 16 to 22"
            self._log.add(section.name, fault, "both left out", line)
            low = high = None
        elif _beyond(default, low, high):
            fault = f"DefaultValue {default!r} is beyond the limits {low!r} to {high!r}"
            self._log.add(section.name, fault, "kept", section.options["defaultvalue"].line)
        made.low, made.high = low, high

    def _note_oddity(self, section: EdsSection, option: Option, value: int, oddity: str) -> None:
        if oddity:
            fault = f"{option.name} is {option.value!r}"
            self._log.add(section.name, fault, f"{oddity}: read as {value}", option.line)


def _beyond(default: Scalar | None, low: Scalar | None, high: Scalar | None) -> bool:
    if not isinstance(default, int | float):
        return False
    below = isinstance(low, int | float) and default < low
    return below or (isinstance(high, int | float) and default > high)
