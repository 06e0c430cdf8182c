"""Information about a file: its origin, its device, the node that it configures, its lists."""

from dataclasses import dataclass

from servobench.drivers.canopen.objects301 import FIRST_OBJECT
from servobench.drivers.sheets.eds.numbers import integer
from servobench.drivers.sheets.eds.sections import (
    COMMISSIONING,
    EdsSection,
    Sections,
    object_of,
    section_name,
)
from servobench.drivers.sheets.eds.text import RepairLog

BIT_RATES_KBIT_S = (10, 20, 50, 125, 250, 500, 800, 1000)
"""Each an entry BaudRate_... of [DeviceInfo] (CiA 306-1)."""
LISTS = ("MandatoryObjects", "OptionalObjects", "ManufacturerObjects")
_DUMMIES = range(1, 8)
"""BOOLEAN to UNSIGNED32, by their numbers as data types."""
_COUNT = "supportedobjects"


@dataclass(frozen=True, slots=True)
class FileInformation:
    """[FileInfo], unchanged."""

    name: str = ""
    version: str = ""
    revision: str = ""
    eds_version: str = ""
    description: str = ""
    created: str = ""
    modified: str = ""


@dataclass(frozen=True, slots=True)
class DeviceInformation:
    """[DeviceInfo]; None for a value that is missing or nonsense."""

    vendor_name: str = ""
    product_name: str = ""
    order_code: str = ""
    vendor_number: int | None = None
    product_number: int | None = None
    revision_number: int | None = None
    bit_rates_kbit_s: tuple[int, ...] = ()
    receive_pdos: int | None = None
    transmit_pdos: int | None = None
    granularity: int | None = None
    """Bits: the smallest unit that can be mapped; 0 if the mapping is fixed."""
    compact_pdo: int = 0
    """Bit n: PDOs without a section of their own have sub-index n + 1 of the communication parameter."""
    lss_supported: bool | None = None
    simple_boot_up_slave: bool | None = None


@dataclass(frozen=True, slots=True)
class Commissioning:
    """[DeviceComissioning] of a DCF."""

    node_id: int | None = None
    node_name: str = ""
    bit_rate_kbit_s: int | None = None
    net_number: int | None = None
    network_name: str = ""
    serial_number: int | None = None


def read_file_information(sections: Sections) -> FileInformation:
    """Read [FileInfo]; empty if the file has none."""
    section = sections.get("FileInfo")
    if section is None:
        return FileInformation()
    text = section.text

    def moment(what: str) -> str:
        return f"{text(what + 'Date')} {text(what + 'Time')}".strip()

    return FileInformation(
        name=text("FileName"),
        version=text("FileVersion"),
        revision=text("FileRevision"),
        eds_version=text("EDSVersion"),
        description=text("Description"),
        created=moment("Creation"),
        modified=moment("Modification"),
    )


def read_device_information(sections: Sections, log: RepairLog) -> DeviceInformation:
    """Read [DeviceInfo]."""
    section = sections.get("DeviceInfo")
    if section is None:
        log.add("DeviceInfo", "the section is missing", "taken for empty")
        return DeviceInformation()
    rates = tuple(rate for rate in BIT_RATES_KBIT_S if _number(section, f"BaudRate_{rate}"))
    return DeviceInformation(
        vendor_name=section.text("VendorName"),
        product_name=section.text("ProductName"),
        order_code=section.text("OrderCode"),
        vendor_number=_number(section, "VendorNumber"),
        product_number=_number(section, "ProductNumber"),
        revision_number=_number(section, "RevisionNumber"),
        bit_rates_kbit_s=rates,
        receive_pdos=_number(section, "NrOfRXPDO"),
        transmit_pdos=_number(section, "NrOfTXPDO"),
        granularity=_number(section, "Granularity"),
        compact_pdo=_number(section, "CompactPDO") or 0,
        lss_supported=_flag(section, "LSS_Supported"),
        simple_boot_up_slave=_flag(section, "SimpleBootUpSlave"),
    )


def read_commissioning(sections: Sections) -> Commissioning | None:
    """Read [DeviceComissioning]; None for an EDS."""
    section = sections.get(COMMISSIONING)
    if section is None:
        return None
    node_id = _number(section, "NodeID")
    if node_id is not None and not 1 <= node_id <= 127:
        section.mend(f"NodeID is {node_id}, not in 1..127", "left out", section.options["nodeid"].line)
        node_id = None
    return Commissioning(
        node_id=node_id,
        node_name=section.text("NodeName"),
        bit_rate_kbit_s=_number(section, "Baudrate"),
        net_number=_number(section, "NetNumber"),
        network_name=section.text("NetworkName"),
        serial_number=_number(section, "LSS_SerialNumber"),
    )


def read_dummies(sections: Sections) -> tuple[int, ...]:
    """Return the data types that may be mapped as placeholders (CiA 301 7.4.7)."""
    section = sections.get("DummyUsage")
    if section is None:
        return ()
    return tuple(number for number in _DUMMIES if _number(section, f"Dummy{number:04d}"))


def check_lists(sections: Sections, log: RepairLog) -> None:
    """Compare the lists of objects with the objects; the defined ones count."""
    defined = {named.index for named in map(object_of, sections) if named is not None}
    defined = {index for index in defined if index >= FIRST_OBJECT}
    lists = [sections[name] for name in LISTS if name in sections]
    if not lists:
        log.add("file", "the lists of objects are missing", "every object that is defined counts")
        return
    listed: dict[int, str] = {}
    for section in lists:
        _check_list(section, defined, listed)
    for index in sorted(defined - listed.keys()):
        name = section_name(index)
        line = sections[name].line if name in sections else 0
        log.add(name, "the object is defined, but in no list", "taken for supported", line)


def _check_list(section: EdsSection, defined: set[int], listed: dict[int, str]) -> None:
    entries = 0
    for key, option in section.options.items():
        if key == _COUNT or integer(option.name) is None:
            continue
        entries += 1
        index = _listed_index(option.value, defined)
        if index is None:
            section.mend(f"entry {option.name} is {option.value!r}, no index", "left out", option.line)
            continue
        if index not in defined:
            section.mend(f"object {index:04X}h is listed, but not defined", "left out", option.line)
        elif index in listed:
            fault = f"object {index:04X}h is listed twice, first in [{listed[index]}]"
            section.mend(fault, "counted once", option.line)
        listed.setdefault(index, section.name)
    count = section.options.get(_COUNT)
    spelled = integer(count.value) if count is not None else None
    if count is None:
        section.mend("SupportedObjects is missing", f"{entries} are listed")
    elif spelled is None or spelled.value != entries:
        fault = f"SupportedObjects is {count.value or 'empty'}, {entries} are listed"
        section.mend(fault, "those that are listed count", count.line)


def _listed_index(text: str, defined: set[int]) -> int | None:
    """Parse an index; digits without 0x are hexadecimal if only then they name an object of the file."""
    spelled = integer(text)
    if spelled is None:
        return None
    if text.strip().isdecimal() and spelled.value not in defined and int(text, 16) in defined:
        return int(text, 16)
    return spelled.value


def _number(section: EdsSection, name: str) -> int | None:
    """Parse a number of a non-object section, where an empty one is no fault."""
    return section.number(name) if section.option(name) is not None else None


def _flag(section: EdsSection, name: str) -> bool | None:
    value = _number(section, name)
    return None if value is None else bool(value)
