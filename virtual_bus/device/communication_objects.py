"""The communication profile of a simulated device, 1000h..1FFFh, with its defaults (CiA 301, 7.5.2).

The object dictionary as an electronic data sheet (CiA 306-1), for masters that want one.
"""

from collections.abc import Iterable, Sequence
from typing import Any

from servobench.drivers.canopen.cob_ids import EMERGENCY, SDO_ANSWER, SDO_REQUEST, SYNC
from servobench.drivers.canopen.objects301 import (
    MANDATORY,
    MANUFACTURER,
    MAPPING_OFFSET,
    RPDO_COMMUNICATION,
    RPDO_MAPPING,
    SDO_SERVER,
    TPDO_COMMUNICATION,
    TPDO_MAPPING,
    Cia301,
    DataType,
)
from servobench.drivers.sheets.eds.types import TEXT_TYPES
from servobench.virtual_bus.device.device_options import DeviceOptions, PdoDefault
from servobench.virtual_bus.device.object_dictionary import (
    Access,
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


U8, U16, U32 = DataType.UNSIGNED8, DataType.UNSIGNED16, DataType.UNSIGNED32
UNCOMPRESSED = 0
"""1022h: the EDS as it is (CiA 301, 7.5.2.24)."""
_VERSION = "1"
"""Version of hardware and software."""
_ERRORS_KEPT = 8
"""Chosen here; CiA 301, 7.5.2.4, leaves 1 to 254 to the device."""
_HEARTBEAT_CONSUMERS = 4
"""Chosen here; CiA 301, 7.5.2.19, leaves 1 to 127 to the device."""
_MAPPING_ENTRIES = 8
"""The most entries of a PDO of octets."""
RO, RW, CONST = Access.READ_ONLY, Access.READ_WRITE, Access.CONST


def add_communication_objects(dictionary: ObjectDictionary, options: DeviceOptions) -> None:
    """Add every object of the communication profile; the parts of the device hook into them later."""
    _add_errors(dictionary)
    _add_sync(dictionary)
    _add_identity(dictionary, options)
    _add_error_control(dictionary, options)
    _add_storage(dictionary)
    _add_sdo_server(dictionary)
    for number, default in enumerate(options.rpdos):
        _add_pdo(dictionary, number, default, transmit=False)
    for number, default in enumerate(options.tpdos):
        _add_pdo(dictionary, number, default, transmit=True)


def _add(
    dictionary: ObjectDictionary, entry: Cia301, data_type: DataType, access: Access, **options: Any
) -> Variable:
    return dictionary.add(entry, entry.title, data_type, access, **options)


def _add_errors(dictionary: ObjectDictionary) -> None:
    _add(dictionary, Cia301.ERROR_REGISTER, U8, RO, mappable=True)
    history = dictionary.add_array(Cia301.ERROR_HISTORY, Cia301.ERROR_HISTORY.title)
    history.add(0, "Number of errors", U8, RW)
    for subindex in range(1, _ERRORS_KEPT + 1):
        history.add(subindex, f"Standard error field {subindex}", U32, RO)
    _add(dictionary, Cia301.EMCY_COB_ID, U32, RW, default=EMERGENCY, node_relative=True)
    _add(dictionary, Cia301.EMCY_INHIBIT_TIME, U16, RW)
    behaviour = dictionary.add_array(Cia301.ERROR_BEHAVIOUR, Cia301.ERROR_BEHAVIOUR.title)
    behaviour.add(1, "Communication error", U8, RW)


def _add_sync(dictionary: ObjectDictionary) -> None:
    _add(dictionary, Cia301.SYNC_COB_ID, U32, RW, default=SYNC)
    _add(dictionary, Cia301.CYCLE_PERIOD, U32, RW)
    _add(dictionary, Cia301.SYNC_WINDOW, U32, RW)
    _add(dictionary, Cia301.SYNC_COUNTER_OVERFLOW, U8, RW)
    _add(dictionary, Cia301.TIME_COB_ID, U32, RW, default=0x80000100)
    _add(dictionary, Cia301.HIGH_RESOLUTION_TIME_STAMP, U32, RW, mappable=True)


def _add_identity(dictionary: ObjectDictionary, options: DeviceOptions) -> None:
    identity = options.identity
    _add(dictionary, Cia301.DEVICE_TYPE, U32, RO, default=identity.device_type)
    for entry, text in (
        (Cia301.DEVICE_NAME, identity.device_name),
        (Cia301.HARDWARE_VERSION, _VERSION),
        (Cia301.SOFTWARE_VERSION, _VERSION),
    ):
        _add(dictionary, entry, DataType.VISIBLE_STRING, CONST, default=text.encode("ascii"))
    record = dictionary.add_record(Cia301.IDENTITY, Cia301.IDENTITY.title)
    record.add(1, "Vendor-ID", U32, RO, default=identity.vendor_id)
    record.add(2, "Product code", U32, RO, default=identity.product_code)
    record.add(3, "Revision number", U32, RO, default=identity.revision_number)
    record.add(4, "Serial number", U32, RO, default=identity.serial_number)


def _add_error_control(dictionary: ObjectDictionary, options: DeviceOptions) -> None:
    _add(dictionary, Cia301.GUARD_TIME, U16, RW)
    _add(dictionary, Cia301.LIFE_TIME_FACTOR, U8, RW)
    consumers = dictionary.add_array(Cia301.CONSUMER_HEARTBEAT_TIME, Cia301.CONSUMER_HEARTBEAT_TIME.title)
    for subindex in range(1, _HEARTBEAT_CONSUMERS + 1):
        consumers.add(subindex, f"Consumer heartbeat time {subindex}", U32, RW)
    _add(dictionary, Cia301.PRODUCER_HEARTBEAT_TIME, U16, RW, default=options.heartbeat_ms)


def _add_storage(dictionary: ObjectDictionary) -> None:
    store = _add(dictionary, Cia301.STORE_EDS, DataType.DOMAIN, RO)
    store.provider = lambda: export_eds(dictionary).encode("latin-1", errors="replace")
    _add(dictionary, Cia301.STORE_FORMAT, U16, RO, default=UNCOMPRESSED)
    for entry, verb in ((Cia301.STORE_PARAMETERS, "Store"), (Cia301.RESTORE_DEFAULTS, "Restore")):
        array = dictionary.add_array(entry, f"{verb} parameters")
        for subindex, group in enumerate(("all", "communication", "application", "manufacturer"), 1):
            array.add(subindex, f"{verb} {group} parameters", U32, RW)


def _add_sdo_server(dictionary: ObjectDictionary) -> None:
    record = dictionary.add_record(SDO_SERVER, "SDO server parameter")
    record.add(1, "COB-ID client to server (rx)", U32, RO, default=SDO_REQUEST, node_relative=True)
    record.add(2, "COB-ID server to client (tx)", U32, RO, default=SDO_ANSWER, node_relative=True)


def _add_pdo(dictionary: ObjectDictionary, number: int, default: PdoDefault, *, transmit: bool) -> None:
    name, communication = ("TPDO", TPDO_COMMUNICATION) if transmit else ("RPDO", RPDO_COMMUNICATION)
    record = dictionary.add_record(communication + number, f"{name} {number + 1} communication parameter")
    record.add(1, f"COB-ID used by {name}", U32, RW, default=default.cob_id, node_relative=True)
    record.add(2, "Transmission type", U8, RW, default=default.transmission_type)
    if transmit:
        record.add(3, "Inhibit time", U16, RW, default=default.inhibit_time_100us)
    timer = "Event timer" if transmit else "Event-timer"
    record.add(5, timer, U16, RW, default=default.event_timer_ms)
    if transmit:
        record.add(6, "SYNC start value", U8, RW)
    index = communication + MAPPING_OFFSET + number
    _add_mapping(dictionary, index, f"{name} {number + 1} mapping parameter", default)


def _add_mapping(dictionary: ObjectDictionary, index: int, name: str, default: PdoDefault) -> None:
    record = dictionary.add_record(index, name)
    record.add(0, "Number of mapped application objects", U8, RW, default=len(default.mapping))
    for subindex in range(1, _MAPPING_ENTRIES + 1):
        word = default.mapping[subindex - 1] if subindex <= len(default.mapping) else 0
        record.add(subindex, f"Application object {subindex}", U32, RW, default=word)
