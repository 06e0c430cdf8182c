"""The object dictionary as an electronic data sheet (CiA 306-1), for masters that want one."""

from collections.abc import Iterable, Sequence

from servobench.drivers.canopen.objects301 import (
    MANDATORY,
    MANUFACTURER,
    RPDO_COMMUNICATION,
    RPDO_MAPPING,
    TPDO_COMMUNICATION,
    TPDO_MAPPING,
    Cia301,
)
from servobench.drivers.sheets.eds.types import TEXT_TYPES
from servobench.virtual_bus.device.object_dictionary import (
    DictionaryObject,
    ObjectCode,
    ObjectDictionary,
    Variable,
)

SERIAL_NUMBER = (Cia301.IDENTITY, 4)
"""Each device's own; the sheet is of them all."""


def export_eds(dictionary: ObjectDictionary) -> str:
    """The EDS of a device with this dictionary; defaults that depend on the node-ID say so. What is measured
    or computed has none."""
    indices = [entry.index for entry in dictionary]
    optional = [index for index in indices if index not in MANDATORY and index not in MANUFACTURER]
    lines: list[str] = []
    lines += _section("FileInfo", _file_info(dictionary))
    lines += _section("DeviceInfo", _device_info(dictionary, indices))
    lines += _section("DummyUsage", [f"Dummy{index:04X}=1" for index in range(1, 8)])
    lines += _object_list("MandatoryObjects", [index for index in indices if index in MANDATORY])
    lines += _object_list("OptionalObjects", optional)
    lines += _object_list("ManufacturerObjects", [index for index in indices if index in MANUFACTURER])
    for entry in dictionary:
        lines += _object(entry)
    return "\n".join(lines) + "\n"


def _section(title: str, entries: Iterable[str]) -> list[str]:
    return [f"[{title}]", *entries, ""]


def _object_list(title: str, indices: Iterable[int]) -> list[str]:
    entries = [f"{number}=0x{index:04X}" for number, index in enumerate(indices, 1)]
    return _section(title, [f"SupportedObjects={len(entries)}", *entries])


def _file_info(dictionary: ObjectDictionary) -> Sequence[str]:
    return (
        "FileName=device.eds",
        "FileVersion=1",
        "FileRevision=0",
        "EDSVersion=4.0",
        f"Description={_device_name(dictionary)}",
        # Fixed, so that the same device gives the same text.
        "CreationTime=12:00AM",
        "CreationDate=01-01-2000",
        "CreatedBy=servobench",
    )


def _device_name(dictionary: ObjectDictionary) -> str:
    variable = dictionary.get(Cia301.DEVICE_NAME)
    return "device" if variable is None else bytes(variable.default).decode("latin-1")


def _identity(dictionary: ObjectDictionary, subindex: int) -> int:
    variable = dictionary.get(Cia301.IDENTITY, subindex)
    return 0 if variable is None else int(variable.default)


def _device_info(dictionary: ObjectDictionary, indices: Sequence[int]) -> Sequence[str]:
    receive = sum(RPDO_COMMUNICATION <= index < RPDO_MAPPING for index in indices)
    transmit = sum(TPDO_COMMUNICATION <= index < TPDO_MAPPING for index in indices)
    rates = (f"BaudRate_{rate}=1" for rate in (10, 20, 50, 125, 250, 500, 800, 1000))
    return (
        "VendorName=servobench",
        f"VendorNumber=0x{_identity(dictionary, 1):X}",
        f"ProductName={_device_name(dictionary)}",
        f"ProductNumber=0x{_identity(dictionary, 2):X}",
        f"RevisionNumber=0x{_identity(dictionary, 3):X}",
        f"OrderCode={_device_name(dictionary)}",
        *rates,
        "SimpleBootUpMaster=0",
        "SimpleBootUpSlave=1",
        "Granularity=1",
        "DynamicChannelsSupported=0",
        "GroupMessaging=0",
        f"NrOfRXPDO={receive}",
        f"NrOfTXPDO={transmit}",
        "LSS_Supported=1",
    )


def _object(entry: DictionaryObject) -> list[str]:
    if entry.code in (ObjectCode.VAR, ObjectCode.DOMAIN):
        return _variable(f"{entry.index:04X}", entry.members[0], entry.code)
    lines = _section(
        f"{entry.index:04X}",
        [
            f"ParameterName={entry.name}",
            f"ObjectType=0x{entry.code:X}",
            f"SubNumber={len(entry.members)}",
        ],
    )
    for subindex in sorted(entry.members):
        lines += _variable(f"{entry.index:04X}sub{subindex:X}", entry.members[subindex], ObjectCode.VAR)
    return lines


def _variable(title: str, variable: Variable, code: ObjectCode) -> list[str]:
    entries = [
        f"ParameterName={variable.name}",
        f"ObjectType=0x{code:X}",
        f"DataType=0x{variable.data_type:04X}",
        f"AccessType={variable.access.value}",
        f"PDOMapping={int(variable.mappable)}",
    ]
    own = (variable.index, variable.subindex) == SERIAL_NUMBER
    if variable.provider is None and not own:
        entries.append(f"DefaultValue={_default(variable)}")
    if variable.low is not None:
        entries.append(f"LowLimit={variable.low}")
    if variable.high is not None:
        entries.append(f"HighLimit={variable.high}")
    return _section(title, entries)


def _default(variable: Variable) -> str:
    default = variable.default
    if variable.node_relative:
        return f"$NODEID+0x{default:X}"
    if isinstance(default, bytes):
        return default.decode("latin-1") if variable.data_type in TEXT_TYPES else default.hex()
    return str(default)
