"""XDD and XDC files (CiA 311, the XML form of EDS and DCF) into the sections that an EDS would have.

Expat of the standard library reads them, without building a tree. A document type declaration is refused: in
it alone entities can be defined, so that none can be expanded and no other file is opened. An object's
attributes take precedence over those of the parameter that it refers to (``uniqueIDRef``).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final
from xml.parsers import expat

from servobench.drivers.errors import printable
from servobench.drivers.sheets.eds.sections import COMMISSIONING, EdsSection, Option, Sections, section_name
from servobench.drivers.sheets.eds.text import RepairLog

ROOT: Final = "ISO15745ProfileContainer"
_DEPTH_MAX: Final = 64
"""Elements in one another; an XDD has a dozen."""
_TEXT_MAX: Final = 1000
"""Characters of a name."""
_ATTRIBUTES: Final = {
    "name": "ParameterName",
    "objectType": "ObjectType",
    "lowLimit": "LowLimit",
    "highLimit": "HighLimit",
    "defaultValue": "DefaultValue",
    "actualValue": "ParameterValue",
    "denotation": "Denotation",
    "subNumber": "SubNumber",
}
_PLAIN_TYPES: Final = {
    "BOOL": 0x01,
    "SINT": 0x02,
    "INT": 0x03,
    "DINT": 0x04,
    "USINT": 0x05,
    "UINT": 0x06,
    "UDINT": 0x07,
    "BYTE": 0x05,
    "WORD": 0x06,
    "DWORD": 0x07,
    "LWORD": 0x1B,
    "LINT": 0x15,
    "ULINT": 0x1B,
    "REAL": 0x08,
    "LREAL": 0x11,
    "STRING": 0x09,
    "WSTRING": 0x0B,
}
"""CiA 301 data types for the IEC 61131-3 types of parameters."""
_ACCESS: Final = {
    "const": "const",
    "read": "ro",
    "write": "wo",
    "readWrite": "rw",
    "readWriteInput": "rwr",
    "readWriteOutput": "rww",
}
_DIRECTED: Final = {("rw", "TPDO"): "rwr", ("rw", "RPDO"): "rww"}
"""An EDS codes the direction of a mapping in the access type (CiA 306-1)."""
_BOOLEANS: Final = {"true": "1", "false": "0"}
_NAMED: Final = {"vendorName": "VendorName", "vendorID": "VendorNumber", "productName": "ProductName"} | {
    "productID": "ProductNumber",
    "orderNumber": "OrderCode",
}
_FEATURES: Final = {"granularity": "Granularity", "nrOfRxPDO": "NrOfRXPDO", "nrOfTxPDO": "NrOfTXPDO"} | {
    "layerSettingServiceSlave": "LSS_Supported",
    "bootUpSlave": "SimpleBootUpSlave",
}
_NODE: Final = {"nodeID": "NodeID", "nodeName": "NodeName", "networkNumber": "NetNumber"} | {
    "networkName": "NetworkName"
}
_FILE: Final = {"fileName": "FileName", "fileVersion": "FileVersion", "fileCreationDate": "CreationDate"} | {
    "fileCreationTime": "CreationTime",
    "fileModificationDate": "ModificationDate",
    "fileModificationTime": "ModificationTime",
}


class NoXmlSheet(Exception):
    """An XML text that is no XDD: the place, and what was found there."""

    def __init__(self, line: int, what: str) -> None:
        super().__init__(what)
        self.line = line


@dataclass(slots=True)
class _Parameter:
    """A parameter of the device profile."""

    access: str = ""
    data_type: int | None = None
    values: dict[str, str] = field(default_factory=dict)
    """DefaultValue, ParameterValue, LowLimit, HighLimit."""


@dataclass(slots=True)
class _Object:
    """An object or sub-object with its attributes."""

    index: int
    sub: int | None
    line: int
    attributes: Mapping[str, str]


def read_xml_sections(data: bytes, log: RepairLog) -> Sections:
    """Read the sections. Raises NoXmlSheet, and NoDataSheet of the log."""
    reader = _Reader(log)
    parser = expat.ParserCreate()
    parser.buffer_text = True
    parser.XmlDeclHandler = reader.declaration
    parser.StartDoctypeDeclHandler = reader.doctype
    parser.StartElementHandler = reader.start
    parser.EndElementHandler = reader.end
    parser.CharacterDataHandler = reader.text
    reader.line_of = lambda: parser.CurrentLineNumber
    try:
        parser.Parse(data, True)
    except expat.ExpatError as error:
        raise NoXmlSheet(error.lineno, expat.ErrorString(error.code)) from None
    return reader.sections()


def _is_known(encoding: str) -> bool:
    """Return True if Expat reads it, or Python for it with one octet per character. Python's other codecs
    would fail there."""
    if encoding.upper() in ("UTF-8", "UTF-16"):
        return True
    try:
        return len(bytes(range(256)).decode(encoding, "replace")) == 256
    except (LookupError, UnicodeError):
        return False


class _Reader:
    """Receives the events of Expat."""

    def __init__(self, log: RepairLog) -> None:
        self._log = log
        self._path: list[str] = []
        self._text = ""
        self._index = 0
        self._parameters: dict[str, _Parameter] = {}
        self._parameter: _Parameter | None = None
        self._objects: list[_Object] = []
        self._information: dict[str, dict[str, Option]] = {}
        self.line_of: Any = None

    def declaration(self, _version: str, encoding: str | None, _standalone: int) -> None:
        if encoding is not None and not _is_known(encoding):
            raise NoXmlSheet(self.line_of(), f"an encoding {encoding[:60]!r}")

    def doctype(self, *_declared: Any) -> None:
        raise NoXmlSheet(self.line_of(), "a document type declaration")

    def start(self, name: str, attributes: dict[str, str]) -> None:
        local = name.rpartition(":")[2]
        if not self._path and local != ROOT:
            raise NoXmlSheet(self.line_of(), f"a root element {local[:60]!r}")
        self._path.append(local)
        self._text = ""
        if len(self._path) > _DEPTH_MAX:
            raise NoXmlSheet(self.line_of(), f"more than {_DEPTH_MAX} elements in one another")
        if local == "parameter":
            access = _ACCESS.get(attributes.get("access", "read"), "")
            self._parameter = self._parameters[attributes.get("uniqueID", "")] = _Parameter(access)
        elif self._parameter is not None:
            self._of_parameter(self._parameter, local, attributes)
        elif local in ("CANopenObject", "CANopenSubObject"):
            self._object(local, attributes)
        else:
            self._informed(local, attributes)

    def end(self, _name: str) -> None:
        local = self._path.pop()
        if local == "parameter":
            self._parameter = None
        elif local in _NAMED and "DeviceIdentity" in self._path and self._text.strip():
            self._inform("DeviceInfo", _NAMED[local], self._text)
        self._text = ""

    def text(self, text: str) -> None:
        self._text += text[: _TEXT_MAX - len(self._text)]

    def _of_parameter(self, parameter: _Parameter, local: str, attributes: dict[str, str]) -> None:
        if local in _PLAIN_TYPES and self._path[-2] == "parameter":
            parameter.data_type = _PLAIN_TYPES[local]
        elif local in ("defaultValue", "actualValue") and "value" in attributes:
            parameter.values[_ATTRIBUTES[local]] = attributes["value"]
        elif local in ("minValue", "maxValue") and "value" in attributes:
            parameter.values["LowLimit" if local == "minValue" else "HighLimit"] = attributes["value"]

    def _object(self, local: str, attributes: dict[str, str]) -> None:
        of_sub = local == "CANopenSubObject"
        index = _hexadecimal(
            attributes.get("subIndex" if of_sub else "index", ""), 0xFF if of_sub else 0xFFFF
        )
        line = self.line_of()
        if index is None:
            what = "a sub-object without a sub-index" if of_sub else "an object without an index"
            self._log.add("file", what, "left out", line)
            self._index = self._index if of_sub else 0
            return
        if not of_sub:
            self._index = index
        if self._index:
            self._objects.append(_Object(self._index, index if of_sub else None, line, attributes))

    def _informed(self, local: str, attributes: dict[str, str]) -> None:
        """Take in the attributes of other elements."""
        if local == "ProfileBody":
            self._take("FileInfo", _FILE, attributes)
        elif local == "CANopenGeneralFeatures":
            self._take("DeviceInfo", _FEATURES, attributes)
        elif local == "supportedBaudRate":
            self._inform("DeviceInfo", f"BaudRate_{_kbit_s(attributes.get('value', ''))}", "1")
        elif local == "dummy":
            name, _, value = attributes.get("entry", "").partition("=")
            self._inform("DummyUsage", name, value)
        elif local == "deviceCommissioning":
            self._take(COMMISSIONING, _NODE, attributes)
            if "actualBaudRate" in attributes:
                self._inform(COMMISSIONING, "Baudrate", _kbit_s(attributes["actualBaudRate"]))

    def _take(self, section: str, names: Mapping[str, str], attributes: Mapping[str, str]) -> None:
        for name, option in names.items():
            if name in attributes:
                self._inform(section, option, _BOOLEANS.get(attributes[name], attributes[name]))

    def _inform(self, section: str, name: str, value: str) -> None:
        option = Option(printable(name), printable(value.strip()), self.line_of())
        self._information.setdefault(section, {}).setdefault(name.lower(), option)

    def sections(self) -> Sections:
        """Return all sections found."""
        sections: Sections = {}
        for name, options in self._information.items():
            line = min(option.line for option in options.values())
            sections[name] = EdsSection(name, line, self._log)
            sections[name].options.update(options)
        for each in self._objects:
            name = section_name(each.index, each.sub)
            if name in sections:
                sections[name].mend(
                    f"the object occurs twice, first in line {sections[name].line}",
                    "the first counts",
                    each.line,
                )
                continue
            sections[name] = EdsSection(name, each.line, self._log)
            for option, value in self._options(each).items():
                sections[name].options[option.lower()] = Option(option, printable(value.strip()), each.line)
        return sections

    def _options(self, each: _Object) -> dict[str, str]:
        attributes = each.attributes
        parameter = self._parameters.get(attributes.get("uniqueIDRef", ""), _Parameter())
        options = dict(parameter.values)
        options |= {option: attributes[name] for name, option in _ATTRIBUTES.items() if name in attributes}
        if "dataType" in attributes:
            options["DataType"] = f"0x{attributes['dataType'].removeprefix('0x')}"
        elif parameter.data_type is not None:
            options["DataType"] = f"0x{parameter.data_type:04X}"
        if "objFlags" in attributes:
            options["ObjFlags"] = f"0x{attributes['objFlags'].removeprefix('0x')}"
        access, mapping = attributes.get("accessType", parameter.access), attributes.get("PDOmapping", "no")
        if access:
            options["AccessType"] = _DIRECTED.get((access, mapping), access)
        options["PDOMapping"] = "0" if mapping == "no" else "1"
        return options


def _hexadecimal(text: str, most: int) -> int | None:
    """Parse an index or sub-index, which CiA 311 writes in hexadecimal digits alone."""
    digits = text.strip().lower().removeprefix("0x")
    if not 1 <= len(digits) <= 4 or not all(digit in "0123456789abcdef" for digit in digits):
        return None
    value = int(digits, 16)
    return value if value <= most else None


def _kbit_s(text: str) -> str:
    """Return the number in ``250 Kbps`` and ``1 Mbps``."""
    number, _, unit = text.strip().partition(" ")
    return (
        f"{number}000"
        if unit.lower().startswith("m") and number.isdecimal() and len(number) < 3
        else number[:9]
    )
