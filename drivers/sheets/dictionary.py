"""EDS and DCF files (CiA 306-1), XDD and XDC (CiA 311), as object dictionaries, tolerant of vendors' faults.

:mod:`servobench.drivers.sheets.eds` reads the files. Every repair on the way is a :class:`Repair`; none is
silent.

Identifies the device of a data sheet: by 1018h, else by [DeviceInfo] (CiA 306-1).

Values of objects as a data sheet or a DCF writes them (CiA 306-1).
"""

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from struct import unpack
from typing import Any, Final, NamedTuple

import canopen.objectdictionary as od
from canopen.objectdictionary import ObjectDictionary, ODVariable

from servobench.drivers.bounded_file import read_bytes
from servobench.drivers.canopen.objects301 import (
    FIRST_OBJECT,
    REAL_BITS,
    SIGNED_BITS,
    STRUCT_CODES,
    TIME_BITS,
    UNSIGNED_BITS,
    Cia301,
    DataType,
)
from servobench.drivers.errors import BadInput
from servobench.drivers.sheets.eds.connection_set import add_compact_pdos, free_of_node
from servobench.drivers.sheets.eds.information import (
    Commissioning,
    DeviceInformation,
    FileInformation,
    check_lists,
    read_commissioning,
    read_device_information,
    read_dummies,
    read_file_information,
)
from servobench.drivers.sheets.eds.objects import EdsObject, build_objects, to_canopen
from servobench.drivers.sheets.eds.sections import Sections, object_of, read_sections
from servobench.drivers.sheets.eds.text import NoDataSheet, RepairLog, lines_of
from servobench.drivers.sheets.eds.text import Repair as Repair
from servobench.drivers.sheets.eds.xml_sections import NoXmlSheet, read_xml_sections

_WHAT = "EDS or DCF file (CiA 306-1), or XDD or XDC file (CiA 311)"
_KINDS = {(False, False): "EDS", (False, True): "DCF", (True, False): "XDD", (True, True): "XDC"}
"""Name of the format, by whether it is XML and whether it describes a commissioned node."""
_OTHER_XML = "of XML only CANopen's XDD and XDC are read; for EtherCAT, POWERLINK and others ask for an EDS"
_EXPECTED = f"an {_WHAT}"
_SIZE_MAX_BYTES = 8_000_000
"""The largest data sheets of servo drives have one or two million."""


@dataclass(frozen=True, slots=True)
class LoadedDictionary:
    """An object dictionary and the repairs made to read it."""

    dictionary: ObjectDictionary
    repairs: tuple[Repair, ...]
    file: FileInformation = field(default_factory=FileInformation)
    device: DeviceInformation = field(default_factory=DeviceInformation)
    commissioning: Commissioning | None = None
    """A DCF's data about its node; None for an EDS."""
    dummies: tuple[int, ...] = ()
    objects: Mapping[int, EdsObject] = field(default_factory=dict)
    """Objects as in the file: formulas of $NODEID, denotations, flags."""
    kind: str = "EDS"
    """EDS, DCF, XDD or XDC."""


def held_by(variable: Any) -> Any:
    """Return a variable's value by its file: a DCF's parameter value first; None if it gives none."""
    if variable is None:
        return None
    return variable.default if variable.value is None else variable.value


def held(dictionary: ObjectDictionary, index: int, sub: int = 0) -> Any:
    """Return the file's value of an object, which may be missing; see :func:`held_by`."""
    entry = dictionary.get(index)
    if isinstance(entry, ODVariable):
        return None if sub else held_by(entry)
    return None if entry is None else held_by(entry.subindices.get(sub))


def held_number(dictionary: ObjectDictionary, index: int, sub: int = 0) -> int | None:
    """Return the file's value of an object; None if it is no integer."""
    value = held(dictionary, index, sub)
    return value if isinstance(value, int) else None


def variables_in(dictionary: ObjectDictionary) -> Iterator[ODVariable]:
    """Yield every variable of a data sheet from 1000h on, in order of index and sub-index."""
    for index, entry in sorted(dictionary.items()):
        if index >= FIRST_OBJECT:
            members: dict[int, Any] = {0: entry} if isinstance(entry, ODVariable) else entry.subindices
            yield from (member for _sub, member in sorted(members.items()))


def load_dictionary(path: Path, node_id: int | None = None) -> LoadedDictionary:
    """Read a data sheet; ``node_id`` takes the place of $NODEID, that of a DCF or XDC if it is None.

    Raises BadInput if the file cannot be read, or holds no object.
    """
    return parse_dictionary(read_bytes(path, _WHAT, size_max_bytes=_SIZE_MAX_BYTES), str(path), node_id)


def parse_dictionary(data: bytes, source: str, node_id: int | None = None) -> LoadedDictionary:
    """Parse the bytes of a data sheet; see :func:`load_dictionary`."""
    _refuse_other_formats(data, source)
    log = RepairLog()
    xml = _is_xml(data)
    try:
        sections = read_xml_sections(data, log) if xml else read_sections(lines_of(data, log), log)
        if not any(object_of(name) for name in sections):
            raise BadInput(source, "", "no CANopenObject" if xml else "no object section", _EXPECTED)
        if not xml:
            check_lists(sections, log)
        loaded = _loaded(sections, node_id, log, xml)
    except NoXmlSheet as error:
        raise BadInput(source, f"line {error.line}", str(error), _EXPECTED, _OTHER_XML) from None
    except NoDataSheet as error:
        raise BadInput(source, "", str(error), _EXPECTED) from None
    if not loaded.objects:
        raise BadInput(source, "", "no object that is defined", _EXPECTED)
    return loaded


def _loaded(sections: Sections, node_id: int | None, log: RepairLog, xml: bool) -> LoadedDictionary:
    commissioning = read_commissioning(sections)
    if node_id is None and commissioning is not None:
        node_id = commissioning.node_id
    device = read_device_information(sections, log)
    dummies = read_dummies(sections)
    objects = build_objects(sections, node_id, log)
    free_of_node(objects, sections, log)
    add_compact_pdos(objects, device)
    return LoadedDictionary(
        to_canopen(objects, dummies, device, commissioning, node_id),
        log.in_order_of_lines(),
        read_file_information(sections),
        device,
        commissioning,
        dummies,
        objects,
        _KINDS[xml, commissioning is not None],
    )


def _beginning(data: bytes) -> bytes:
    """Return the first characters in lower case, without byte order marks and the zeros of UTF-16."""
    return data[:200].lstrip(b"\xef\xbb\xbf\xff\xfe\0 \t\r\n").replace(b"\0", b"").lower()


def _is_xml(data: bytes) -> bool:
    return _beginning(data).startswith(b"<")


def _refuse_other_formats(data: bytes, source: str) -> None:
    """Refuse files that are mistaken for data sheets, each with the cure."""
    if _beginning(data).startswith((b"pk\x03\x04", b"\x1f\x8b", b"rar!", b"7z\xbc\xaf")):
        raise BadInput(source, "", "an archive", _EXPECTED, "unpack it first")


_PARTS = ("vendor", "product", "revision")


class ToldIdentity(NamedTuple):
    """The numbers in a sheet for each part of an identity, 1018h's first; 0 is none. With two the sheet
    contradicts itself, and a device may have either."""

    vendor: tuple[int, ...]
    product: tuple[int, ...]
    revision: tuple[int, ...]

    def strangers(self, vendor: int, product: int, revision: int) -> list[tuple[str, int, int]]:
        """Return part, the sheet's number and the device's number wherever they differ; an unknown number on
        either side does not differ."""
        held = (vendor, product, revision)
        return [
            (part, told[0], number)
            for part, told, number in zip(_PARTS, self, held, strict=True)
            if told and number and number not in told
        ]


def told_identity(dictionary: od.ObjectDictionary) -> ToldIdentity:
    """Return the identity in the sheet of a dictionary."""
    information = dictionary.device_information
    return ToldIdentity(
        _numbers(dictionary, 1, information.vendor_number),
        _numbers(dictionary, 2, information.product_number),
        _numbers(dictionary, 3, information.revision_number),
    )


def _numbers(dictionary: od.ObjectDictionary, sub: int, informed: int | None) -> tuple[int, ...]:
    numbers = (held_number(dictionary, Cia301.IDENTITY, sub), informed)
    return tuple(dict.fromkeys(number & 0xFFFF_FFFF for number in numbers if number))


NUMBERS: Final = SIGNED_BITS | UNSIGNED_BITS | TIME_BITS
"""Types that a file writes as whole numbers, and their bits."""
_TEXTS: Final[Mapping[int, str]] = {DataType.VISIBLE_STRING: "ascii", DataType.UNICODE_STRING: "utf_16_le"}


def value_text(value: bytes, data_type: int | None) -> str:
    """Return a value in the form of a file: signed numbers in decimal, others in hexadecimal, text as it is,
    all else as bytes in hexadecimal."""
    if data_type in REAL_BITS and len(value) == REAL_BITS[DataType(data_type)] // 8:
        return repr(unpack(f"<{STRUCT_CODES[data_type]}", value)[0])
    if data_type in NUMBERS and value:
        signed = data_type in SIGNED_BITS
        number = int.from_bytes(value, "little", signed=signed)
        return str(number) if signed else f"0x{number:X}"
    text = _text_of(value, data_type)
    return value.hex().upper() if text is None else text


def is_kept(value: bytes, data_type: int | None) -> bool:
    """Return False for a text that a line of a file would change: it ends at a semicolon, is trimmed, and has
    no escapes."""
    if data_type not in _TEXTS:
        return True
    text = _text_of(value, data_type)
    return (
        text is not None
        and text.isascii()
        and text.isprintable()
        and text == text.strip()
        and ";" not in text
    )


def _text_of(value: bytes, data_type: int | None) -> str | None:
    """Return a text without the zeros that fill it up; None for another type, and for what is no text."""
    coding = _TEXTS.get(data_type or 0)
    with suppress(UnicodeDecodeError):
        return None if coding is None else value.decode(coding).rstrip("\0")
    return None
