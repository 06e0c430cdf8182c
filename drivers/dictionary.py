"""EDS and DCF files (CiA 306-1) into object dictionaries, tolerant of vendors' faults.

The file's text is decoded, read into sections, mended rule by rule, and then given to canopen's importer.
Each thing that was mended is a :class:`Repair`; nothing is mended silently.
"""

import io
import re
from collections.abc import Callable, Iterable, Iterator
from configparser import Error as ConfigError
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from canopen.objectdictionary import ObjectDictionary
from canopen.objectdictionary.eds import import_eds

from drivers.errors import BadInput

Sections = dict[str, dict[str, str]]

_SECTION = re.compile(r"^\[(.*)\]\s*$")
_OBJECT = re.compile(r"^([0-9A-F]{4})(?:sub([0-9A-F]{1,2}))?$", re.IGNORECASE)
_NODE_ID = re.compile(r"\$\s*NODE_?ID", re.IGNORECASE)
_VARIABLE, _RECORD, _DOMAIN_TYPE = "0x7", "0x9", "0x000F"
_VARIABLE_TYPES = ("0x7", "0x2")
_NUMBERS = ("ObjectType", "DataType", "PDOMapping", "SubNumber", "CompactSubObj")
_VALUES = ("DefaultValue", "ParameterValue", "LowLimit", "HighLimit")
_TEXT_TYPES = ("0x0009", "0x000A", "0x000B", "0x000F")
_OPTIONS = {
    name.lower(): name
    for name in (
        "ParameterName",
        "AccessType",
        "StorageLocation",
        "ObjFlags",
        "Denotation",
        *_NUMBERS,
        *_VALUES,
    )
}
_DUMMIES = tuple(f"Dummy{number:04d}" for number in range(1, 8))


class Repair(NamedTuple):
    """One fault of a file and what was made of it."""

    section: str
    fault: str
    action: str

    def __str__(self) -> str:
        return f"[{self.section}] {self.fault}: {self.action}"


@dataclass(frozen=True, slots=True)
class LoadedDictionary:
    """An object dictionary and the repairs without which it could not be read."""

    dictionary: ObjectDictionary
    repairs: tuple[Repair, ...]


def load_dictionary(path: Path, node_id: int | None = None) -> LoadedDictionary:
    """Read an EDS or DCF file; ``node_id`` takes the place of $NODEID.

    Raises BadInput if the file cannot be read, or holds no object.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise BadInput(str(path), "", error.strerror, "a readable EDS or DCF file") from error
    return parse_dictionary(data, str(path), node_id)


def parse_dictionary(data: bytes, source: str, node_id: int | None = None) -> LoadedDictionary:
    """As :func:`load_dictionary`, of the bytes of a file."""
    repairs: list[Repair] = []
    sections = _read_sections(_decode(data, repairs), repairs)
    if not any(_OBJECT.match(name) for name in sections):
        raise BadInput(source, "", "no object section", "an EDS or DCF file (CiA 306-1)")
    for mend in _MENDERS:
        repairs += list(mend(sections))
    ordered = sorted(sections, key=_section_order)
    text = "".join(
        f"[{name}]\n" + "".join(f"{option}={value}\n" for option, value in sections[name].items())
        for name in ordered
    )
    try:
        dictionary = import_eds(io.StringIO(text), node_id)  # type: ignore[no-untyped-call]
    except (ConfigError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise BadInput(
            source, "", f"{type(error).__name__}: {error}", "an EDS or DCF file (CiA 306-1)"
        ) from error
    return LoadedDictionary(dictionary, tuple(repairs))


def _decode(data: bytes, repairs: list[Repair]) -> str:
    """CiA 306-1 asks for ASCII; vendors write the code page of their desk."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        fault = f"byte {data[error.start]:02X}h at offset {error.start} is no UTF-8"
    try:
        text = data.decode("cp1252")
        repairs.append(Repair("file", fault, "read as Windows code page 1252"))
    except UnicodeDecodeError:
        text = data.decode("latin-1")
        repairs.append(Repair("file", fault, "read as Latin-1"))
    return text


def _read_sections(text: str, repairs: list[Repair]) -> Sections:
    """Sections with their options; of two alike the first counts."""
    sections: Sections = {}
    current: dict[str, str] | None = None
    name = "file"
    for number, raw in enumerate(text.splitlines(), start=1):
        line = raw.strip().strip("\0\x1a")
        if not line or line[0] in ";#":
            continue
        header = _SECTION.match(line.split(";")[0].strip())
        if header:
            name = _canonical_section(header.group(1).strip())
            if name in sections:
                repairs.append(Repair(name, "the section occurs twice", "taken as one"))
            current = sections.setdefault(name, {})
            continue
        option, equals, value = line.partition("=")
        if not equals or current is None:
            repairs.append(Repair(name, f"line {number} is no option: {line[:40]!r}", "left out"))
            continue
        _keep_option(current, name, option.strip(), _without_comment(value), repairs)
    return sections


def _keep_option(
    options: dict[str, str], section: str, option: str, value: str, repairs: list[Repair]
) -> None:
    option = _OPTIONS.get(option.lower(), option)
    if option not in options:
        options[option] = value
    elif options[option] != value:
        fault = f"{option} occurs twice, as {options[option]!r} and {value!r}"
        repairs.append(Repair(section, fault, "the first counts"))


def _without_comment(value: str) -> str:
    return re.split(r"(?:^|\s);", value, maxsplit=1)[0].strip()


def _canonical_section(name: str) -> str:
    """``1A00sub2`` whatever the case and padding it is written with."""
    match = _OBJECT.match(name)
    if match is None:
        return name
    index, sub = match.groups()
    return index.upper() if sub is None else f"{index.upper()}sub{int(sub, 16):X}"


def _section_order(name: str) -> tuple[int, int, int]:
    """Objects after everything else, each before its sub-objects: the importer looks parents up."""
    match = _OBJECT.match(name)
    if match is None:
        named = re.match(r"^([0-9A-F]{4})\w+$", name, re.IGNORECASE)
        return (2, int(named.group(1), 16), 0) if named else (0, 0, 0)
    index, sub = match.groups()
    return 1, int(index, 16), -1 if sub is None else int(sub, 16)


# ---- rules: each mends one class of faults in place and tells what it did ---------------------------------


def _mend_numbers(sections: Sections) -> Iterator[Repair]:
    """Structural numbers: empty, hexadecimal without 0x, with a trailing h, padded decimals."""
    for name in _objects(sections):
        options = sections[name]
        for option in _NUMBERS:
            if option in options:
                yield from _mend_number(options, name, option)


def _mend_values(sections: Sections) -> Iterator[Repair]:
    """Default, parameter and limit values of numeric objects; $NODEID in all its spellings."""
    for name in _objects(sections):
        options = sections[name]
        if options.get("DataType") in _TEXT_TYPES:
            continue
        for option in _VALUES:
            value = options.get(option)
            if value is None:
                continue
            if _NODE_ID.search(value):
                yield from _mend_node_id(options, name, option)
            elif _float_type(options):
                continue
            else:
                yield from _mend_number(options, name, option)


def _mend_number(options: dict[str, str], section: str, option: str) -> Iterator[Repair]:
    value = options[option]
    number = _number(value)
    if number is None:
        del options[option]
        fault = f"{option} is empty" if not value else f"{option} is {value!r}, no number"
        # An empty limit or default says nothing and is common: leaving it out loses nothing.
        if value or option not in _VALUES:
            yield Repair(section, fault, "left out")
    elif option in ("ObjectType", "DataType"):
        options[option] = f"0x{number:X}" if option == "ObjectType" else f"0x{number:04X}"
    elif not _plain(value):
        options[option] = str(number)
        yield Repair(section, f"{option} is {value!r}", f"read as {number}")


def _mend_node_id(options: dict[str, str], section: str, option: str) -> Iterator[Repair]:
    value = options[option]
    rest = _NODE_ID.sub("", value).replace("+", "").strip()
    base = _number(rest) if rest else 0
    if base is None:
        del options[option]
        yield Repair(section, f"{option} is {value!r}", "left out")
        return
    options[option] = f"$NODEID+0x{base:X}"
    if not re.fullmatch(
        r"(\$NODEID\+0x[0-9A-Fa-f]+|0x[0-9A-Fa-f]+\+\$NODEID|\$NODEID)", value.replace(" ", "")
    ):
        yield Repair(section, f"{option} is {value!r}", f"read as {options[option]}")


def _mend_compact(sections: Sections) -> Iterable[Repair]:
    """CompactSubObj=0 says that the object is not compact; the importer would take it for compact."""
    for name in _objects(sections):
        if _number(sections[name].get("CompactSubObj", "0")) == 0:
            sections[name].pop("CompactSubObj", None)
    return ()


def _mend_parents(sections: Sections) -> Iterator[Repair]:
    """A sub-object needs a parent, and the parent of sub-objects is no variable."""
    for name in _objects(sections):
        index, _, sub = name.partition("sub")
        if not sub:
            continue
        if index not in sections:
            sections[index] = {"ParameterName": f"Object {index}h", "ObjectType": _RECORD}
            yield Repair(index, "its sub-objects are there, but not the object", "taken for a record")
        elif sections[index].get("ObjectType", _VARIABLE) in _VARIABLE_TYPES:
            sections[index]["ObjectType"] = _RECORD
            yield Repair(index, "a variable with sub-objects", "taken for a record")


def _mend_missing(sections: Sections) -> Iterator[Repair]:
    """Names, types and access rights that are not there."""
    for name in _objects(sections):
        options = sections[name]
        if not options.get("ParameterName"):
            options["ParameterName"] = f"Object {name}"
            yield Repair(name, "ParameterName is missing", f"named {options['ParameterName']!r}")
        variable = options.get("ObjectType", _VARIABLE) in _VARIABLE_TYPES
        if not variable and "CompactSubObj" not in options:
            continue
        if "DataType" not in options:
            options["DataType"] = _DOMAIN_TYPE
            yield Repair(name, "DataType is missing", "taken for a DOMAIN")
        if not options.get("AccessType"):
            options["AccessType"] = "rw"
            yield Repair(name, "AccessType is missing", "taken for rw")


def _mend_tables(sections: Sections) -> Iterator[Repair]:
    """Sections beside the objects: what the importer would stumble over is left out."""
    sections.pop("Comments", None)  # no data, and its line count is often wrong
    usage = next((name for name in sections if name.lower() == "dummyusage"), None)
    if usage is not None:
        given = {option.lower(): value for option, value in sections[usage].items()}
        sections[usage] = {dummy: str(_number(given.get(dummy.lower(), "0")) or 0) for dummy in _DUMMIES}
    if "DeviceInfo" not in sections:
        sections["DeviceInfo"] = {}
        yield Repair("DeviceInfo", "the section is missing", "taken for empty")
    for name in ("DeviceInfo", "DeviceComissioning"):
        yield from _mend_information(sections, name)


def _mend_information(sections: Sections, name: str) -> Iterator[Repair]:
    numeric = re.compile(
        r"^(BaudRate_\d+|\w+Number|SimpleBootUp\w+|Granularity|\w+Supported|NrOf\w+|Baudrate|NodeID)$"
    )
    options = sections.get(name, {})
    for option in [option for option in options if numeric.match(option)]:
        value = options[option]
        number = _number(value)
        if number is None:
            del options[option]
            yield Repair(name, f"{option} is {value!r}, no number", "left out")
        else:
            options[option] = str(number)


_MENDERS: tuple[Callable[[Sections], Iterable[Repair]], ...] = (
    _mend_tables,
    _mend_numbers,
    _mend_compact,
    _mend_parents,
    _mend_missing,
    _mend_values,
)


def _objects(sections: Sections) -> list[str]:
    return [name for name in sections if _OBJECT.match(name)]


def _float_type(options: dict[str, str]) -> bool:
    return options.get("DataType") in ("0x0008", "0x0011")


def _plain(value: str) -> bool:
    """canopen's importer reads it as it is."""
    try:
        int(value, 0)
    except ValueError:
        return False
    return True


def _number(value: str) -> int | None:
    """An integer in any of the spellings that occur; None if it is none."""
    text = value.strip().strip('"').replace(" ", "").replace("_", "")
    if re.fullmatch(r"[0-9A-Fa-f]*[0-9][0-9A-Fa-f]*[hH]", text):
        return int(text[:-1], 16)
    if re.fullmatch(r"[+-]?\d+", text):
        return int(text)
    if re.fullmatch(r"[+-]?0[xX][0-9A-Fa-f]+", text):
        return int(text, 16)
    return int(text, 16) if re.fullmatch(r"[0-9A-Fa-f]+", text) else None
