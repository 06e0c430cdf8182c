"""Lines into sections with their options (CiA 306-1 clause 4: the form of Windows' ini files)."""

import difflib
import re
from dataclasses import dataclass
from typing import NamedTuple

from servobench.drivers.errors import printable
from servobench.drivers.sheets.eds.numbers import Spelled, integer
from servobench.drivers.sheets.eds.text import RepairLog


class Option(NamedTuple):
    """``name=value`` as in a line of the file."""

    name: str
    value: str
    line: int


class EdsSection:
    """A section; option names are case-insensitive. Repairs go to ``log``."""

    def __init__(self, name: str, line: int, log: RepairLog) -> None:
        self.name = name
        self.line = line
        self._log = log
        self.options: dict[str, Option] = {}

    def option(self, name: str) -> Option | None:
        """Return an option with a value; None if it is absent or empty."""
        entry = self.options.get(name.lower())
        return entry if entry is not None and entry.value else None

    def text(self, name: str) -> str:
        """Return the value of an option; empty if there is none."""
        entry = self.options.get(name.lower())
        return entry.value if entry is not None else ""

    def number(self, name: str) -> int | None:
        """Return a whole number in any spelling; None if it is absent, empty or none, which is noted."""
        option = self.options.get(name.lower())
        if option is None:
            return None
        spelled = integer(option.value) if option.value else None
        if spelled is None:
            told = f"{option.value[:60]!r}, no number" if option.value else "empty"
            self.mend(f"{name} is {told}", "left out", option.line)
            return None
        self.note_oddity(option, spelled)
        return spelled.value

    def note_oddity(self, option: Option, spelled: Spelled) -> None:
        """Note an odd spelling of a number, if it is one."""
        if spelled.oddity:
            action = f"{spelled.oddity}: read as {spelled.value}"
            self.mend(f"{option.name} is {option.value!r}", action, option.line)

    def mend(self, fault: str, action: str, line: int | None = None) -> None:
        """Note a repair in this section; without a line in that of its header."""
        self._log.add(self.name, fault, action, self.line if line is None else line)


@dataclass(frozen=True, slots=True)
class ObjectName:
    """The content of an object section's name."""

    index: int
    sub: int | None


Sections = dict[str, EdsSection]

_HEADER = re.compile(r"^\[([^\]]*)\](.*)$")
_TORN_HEADER = re.compile(
    r"^\[\s*((?:0[xX])?[0-9A-Fa-f]{4}(?:\s*sub\s*[0-9A-Fa-f]{1,2})?)\s*$", re.IGNORECASE
)
_OBJECT = re.compile(r"^([0-9A-F]{4})(?:sub([0-9A-F]{1,2}))?$", re.IGNORECASE)
_LOOSE_OBJECT = re.compile(
    r"^(?:0x)?([0-9A-F]{4})h?(?:[\s_.,:/-]*(?:sub[\s_-]*(?:index)?[\s_-]*|(?<=[.,:/_-]))(?:0x)?([0-9A-F]{1,2})h?)?$",
    re.IGNORECASE,
)
_OBJECT_NAME_MAX = 60
"""Characters: twice the length of ``0x1A00 - sub-index 0x02 h``. The pattern takes quadratic time."""
_TABLE = re.compile(r"^([0-9A-F]{4})(Name|Value|Denotation|ObjectLinks)$", re.IGNORECASE)
COMMISSIONING = "DeviceComissioning"
"""The section that makes a DCF; CiA 306-1 spells it with one m, and who spells it right means the same."""
_WELL_KNOWN = {
    name.lower(): name
    for name in (
        *("FileInfo", "DeviceInfo", "DummyUsage", "Comments", COMMISSIONING),
        *("MandatoryObjects", "OptionalObjects", "ManufacturerObjects", "StandardDataTypes"),
        *("DynamicChannels", "Tools", "ToolInfos", "SupportedModules"),
    )
}
_SECOND_NAMES = {"devicecommissioning": COMMISSIONING, "devicecommisioning": COMMISSIONING}
OBJECT_OPTIONS = (
    *("ParameterName", "ObjectType", "DataType", "AccessType", "DefaultValue", "PDOMapping", "SubNumber"),
    *("LowLimit", "HighLimit", "ObjFlags", "CompactSubObj", "StorageLocation", "Denotation"),
    *("ParameterValue", "UploadFile", "DownloadFile", "ParamRefd", "Unit", "Factor", "Description"),
)
_OBJECT_OPTIONS = {name.lower(): name for name in OBJECT_OPTIONS}
_FREE_TEXT = frozenset({"parametername", "description", "denotation"})
_NUMBER_AND_COMMENT = re.compile(
    r"^\s*((?:\$NODEID\s*\+\s*)?[+-]?(?:0[xX][0-9A-Fa-f]+|\d+))\s*;", re.IGNORECASE
)
_GUESSES_MAX = 1000
"""Names compared with the words of the standard: a vendor misspells a few, and each comparison is slow."""
_LIKENESS = 0.88
"""Below it a misspelt option may be another one: LowLimit and a vendor's LowLimit2 are 0.94 alike."""


def object_of(name: str) -> ObjectName | None:
    """The object that a section defines; None if it defines none."""
    match = _OBJECT.match(name)
    if match is None:
        return None
    index, sub = match.groups()
    return ObjectName(int(index, 16), None if sub is None else int(sub, 16))


def table_of(name: str) -> tuple[int, str] | None:
    """Index and kind (name, value, denotation, objectlinks) of a section that belongs to an object."""
    match = _TABLE.match(name)
    return None if match is None else (int(match[1], 16), match[2].lower())


def section_name(index: int, sub: int | None = None) -> str:
    """``1A00sub2``."""
    return f"{index:04X}" if sub is None else f"{index:04X}sub{sub:X}"


def read_sections(lines: list[str], log: RepairLog) -> Sections:
    """Sections with their options; of two alike the first counts, as Windows reads them."""
    reader = _Reader(log)
    for number, raw in enumerate(lines, start=1):
        line = raw.strip(" \t\0\x1a\ufeff\xa0\v\f")
        if line and line[0] not in ";#":
            reader.take(_shown(line, number, log), number)
    return reader.sections


def _shown(line: str, number: int, log: RepairLog) -> str:
    """A line that can go to a terminal; a tab is a blank."""
    line = line.replace("\t", " ")
    shown = printable(line)
    if shown != line:
        log.add("file", "a control character", f"read as text: {shown[:40]}", number)
    return shown


class _Reader:
    def __init__(self, log: RepairLog) -> None:
        self.sections: Sections = {}
        self._log = log
        self._current: EdsSection | None = None
        self._guesses: dict[str, str | None] = {}

    def take(self, line: str, number: int) -> None:
        if line[0] == "[":
            header = _HEADER.match(line) or _TORN_HEADER.match(line)
            if header is not None:
                self._begin(header, line, number)
                return
        self._take_option(line, number)

    def _begin(self, header: re.Match[str], line: str, number: int) -> None:
        written = header[1].strip()
        name = _canonical(written)
        rest = header[2].strip() if header.re is _HEADER else "no closing bracket"
        if rest and rest[0] not in ";#":
            action = f"read as [{name}]"
            self._log.add(name, f"the line is {line[:60]!r}", action, number)
        elif name.lower() != written.lower() and not _padded_sub(written):
            self._log.add(name, f"the section is called {written!r}", f"read as [{name}]", number)
        known = self.sections.get(name)
        if known is not None:
            known.mend(f"the section occurs twice, first in line {known.line}", "taken as one", number)
            self._current = known
            return
        self._current = self.sections[name] = EdsSection(name, number, self._log)

    def _take_option(self, line: str, number: int) -> None:
        section = self._current
        written, equals, value = line.partition("=")
        written = written.strip()
        if section is None or not (equals or self._rescued(section, line, number)):
            name = section.name if section is not None else "file"
            if not line.startswith("//"):
                self._log.add(name, f"this is no option: {line[:40]!r}", "left out", number)
            return
        if not equals:
            written, _, value = line.replace(":", " ", 1).partition(" ")
        self._keep(section, Option(self._option_name(section, written, number), value.strip(), number))

    def _rescued(self, section: EdsSection, line: str, number: int) -> bool:
        """A known option whose = is missing."""
        first, _, rest = line.replace(":", " ", 1).partition(" ")
        if first.lower() not in _OBJECT_OPTIONS or not rest.strip() or object_of(section.name) is None:
            return False
        section.mend(f"{first} has no =", f"read as {first}={rest.strip()[:30]}", number)
        return True

    def _option_name(self, section: EdsSection, written: str, number: int) -> str:
        if object_of(section.name) is None:
            return written
        name = _OBJECT_OPTIONS.get(written.lower())
        if name is not None:
            return name
        name = self._meant(written)
        if name is None:
            return written
        section.mend(f"the option is called {written!r}", f"read as {name}", number)
        return name

    def _meant(self, written: str) -> str | None:
        """Return the option that a misspelt one means; None if it is a vendor's own."""
        if written not in self._guesses and len(self._guesses) < _GUESSES_MAX:
            bare = re.sub(r"[\s_-]", "", written).lower()
            alike = difflib.get_close_matches(bare, _OBJECT_OPTIONS, n=1, cutoff=_LIKENESS)
            own = not alike or (bare[:-1] == alike[0] and bare[-1].isdecimal())
            self._guesses[written] = None if own else _OBJECT_OPTIONS[alike[0]]
        return self._guesses.get(written)

    def _keep(self, section: EdsSection, option: Option) -> None:
        key = option.name.lower()
        free = key in _FREE_TEXT or section.name == "Comments"
        value = _without_comment(option.value, free)
        known = section.options.get(key)
        if known is None or not (known.value or not value):
            section.options[key] = Option(option.name, value, option.line)
        elif value != known.value:
            fault = f"{option.name} occurs twice, as {known.value[:60]!r} and {value[:60]!r}"
            section.mend(fault, "the first counts" if value else "the empty one is left out", option.line)


def _canonical(written: str) -> str:
    """Return ``1A00sub2`` for any case and padding."""
    loose = _LOOSE_OBJECT.match(written) if len(written) <= _OBJECT_NAME_MAX else None
    if loose is not None:
        return section_name(int(loose[1], 16), None if loose[2] is None else int(loose[2], 16))
    table = table_of(written)
    if table is not None:
        return f"{table[0]:04X}{table[1].capitalize()}"
    lower = written.lower()
    return _WELL_KNOWN.get(lower) or _SECOND_NAMES.get(lower) or written


def _padded_sub(written: str) -> bool:
    """``1018sub01`` is no fault."""
    return _OBJECT.match(written) is not None


def _without_comment(value: str, free: bool) -> str:
    """Strip a comment, which follows a blank or a number; a semicolon in a text is part of it."""
    numbered = None if free else _NUMBER_AND_COMMENT.match(value)
    if numbered is not None:
        return numbered[1]
    pattern = r"(?:^|\s);" if free else r"(?:^|\s);|;\s*$"
    return re.split(pattern, value, maxsplit=1)[0].strip()
