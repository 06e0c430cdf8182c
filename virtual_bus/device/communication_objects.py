"""The communication profile of a simulated device, 1000h..1FFFh, with its defaults (CiA 301, 7.5.2)."""

from drivers.canopen.cob_ids import EMERGENCY, SDO_ANSWER, SDO_REQUEST, SYNC
from drivers.canopen.data_types import DataType
from virtual_bus.device.device_options import DeviceOptions, PdoDefault
from virtual_bus.device.eds_export import export_eds
from virtual_bus.device.object_dictionary import Access, ObjectDictionary

U8, U16, U32 = DataType.UNSIGNED8, DataType.UNSIGNED16, DataType.UNSIGNED32
UNCOMPRESSED = 0
"""1022h: the EDS as it is (CiA 301, 7.5.2.24)."""
RO, RW, CONST = Access.READ_ONLY, Access.READ_WRITE, Access.CONST


def add_communication_objects(dictionary: ObjectDictionary, options: DeviceOptions) -> None:
    """Add every object of the communication profile; the parts of the device hook into them later."""
    _add_errors(dictionary, options)
    _add_sync(dictionary)
    _add_identity(dictionary, options)
    _add_error_control(dictionary, options)
    _add_storage(dictionary)
    _add_sdo_server(dictionary)
    for number, default in enumerate(options.rpdos):
        _add_rpdo(dictionary, number, default, options.mapping_entries)
    for number, default in enumerate(options.tpdos):
        _add_tpdo(dictionary, number, default, options.mapping_entries)


def _add_errors(dictionary: ObjectDictionary, options: DeviceOptions) -> None:
    dictionary.add(0x1001, "Error register", U8, RO, mappable=True)
    history = dictionary.add_array(0x1003, "Pre-defined error field")
    history.add(0, "Number of errors", U8, RW)
    for subindex in range(1, options.error_history + 1):
        history.add(subindex, f"Standard error field {subindex}", U32, RO)
    dictionary.add(0x1014, "COB-ID EMCY", U32, RW, default=EMERGENCY, node_relative=True)
    dictionary.add(0x1015, "Inhibit time EMCY", U16, RW)
    behaviour = dictionary.add_array(0x1029, "Error behaviour")
    behaviour.add(1, "Communication error", U8, RW)


def _add_sync(dictionary: ObjectDictionary) -> None:
    dictionary.add(0x1005, "COB-ID SYNC message", U32, RW, default=SYNC)
    dictionary.add(0x1006, "Communication cycle period", U32, RW)
    dictionary.add(0x1007, "Synchronous window length", U32, RW)
    dictionary.add(0x1019, "Synchronous counter overflow value", U8, RW)
    dictionary.add(0x1012, "COB-ID time stamp object", U32, RW, default=0x80000100)
    dictionary.add(0x1013, "High resolution time stamp", U32, RW, mappable=True)


def _add_identity(dictionary: ObjectDictionary, options: DeviceOptions) -> None:
    identity = options.identity
    dictionary.add(0x1000, "Device type", U32, RO, default=identity.device_type)
    for index, name, text in (
        (0x1008, "Manufacturer device name", identity.device_name),
        (0x1009, "Manufacturer hardware version", identity.hardware_version),
        (0x100A, "Manufacturer software version", identity.software_version),
    ):
        dictionary.add(index, name, DataType.VISIBLE_STRING, CONST, default=text.encode("ascii"))
    record = dictionary.add_record(0x1018, "Identity object")
    record.add(1, "Vendor-ID", U32, RO, default=identity.vendor_id)
    record.add(2, "Product code", U32, RO, default=identity.product_code)
    record.add(3, "Revision number", U32, RO, default=identity.revision_number)
    record.add(4, "Serial number", U32, RO, default=identity.serial_number)


def _add_error_control(dictionary: ObjectDictionary, options: DeviceOptions) -> None:
    dictionary.add(0x100C, "Guard time", U16, RW)
    dictionary.add(0x100D, "Life time factor", U8, RW)
    consumers = dictionary.add_array(0x1016, "Consumer heartbeat time")
    for subindex in range(1, options.heartbeat_consumers + 1):
        consumers.add(subindex, f"Consumer heartbeat time {subindex}", U32, RW)
    dictionary.add(0x1017, "Producer heartbeat time", U16, RW, default=options.heartbeat_ms)


def _add_storage(dictionary: ObjectDictionary) -> None:
    store = dictionary.add(0x1021, "Store EDS", DataType.DOMAIN, RO)
    store.provider = lambda: export_eds(dictionary).encode("latin-1", errors="replace")
    dictionary.add(0x1022, "Store format", U16, RO, default=UNCOMPRESSED)
    for index, verb in ((0x1010, "Store"), (0x1011, "Restore")):
        array = dictionary.add_array(index, f"{verb} parameters")
        for subindex, group in enumerate(("all", "communication", "application", "manufacturer"), 1):
            array.add(subindex, f"{verb} {group} parameters", U32, RW)


def _add_sdo_server(dictionary: ObjectDictionary) -> None:
    record = dictionary.add_record(0x1200, "SDO server parameter")
    record.add(1, "COB-ID client to server (rx)", U32, RO, default=SDO_REQUEST, node_relative=True)
    record.add(2, "COB-ID server to client (tx)", U32, RO, default=SDO_ANSWER, node_relative=True)


def _add_rpdo(dictionary: ObjectDictionary, number: int, default: PdoDefault, entries: int) -> None:
    record = dictionary.add_record(0x1400 + number, f"RPDO {number + 1} communication parameter")
    record.add(1, "COB-ID used by RPDO", U32, RW, default=default.cob_id, node_relative=True)
    record.add(2, "Transmission type", U8, RW, default=default.transmission_type)
    record.add(5, "Event-timer", U16, RW, default=default.event_timer_ms)
    _add_mapping(dictionary, 0x1600 + number, f"RPDO {number + 1} mapping parameter", default, entries)


def _add_tpdo(dictionary: ObjectDictionary, number: int, default: PdoDefault, entries: int) -> None:
    record = dictionary.add_record(0x1800 + number, f"TPDO {number + 1} communication parameter")
    record.add(1, "COB-ID used by TPDO", U32, RW, default=default.cob_id, node_relative=True)
    record.add(2, "Transmission type", U8, RW, default=default.transmission_type)
    record.add(3, "Inhibit time", U16, RW, default=default.inhibit_time_100us)
    record.add(5, "Event timer", U16, RW, default=default.event_timer_ms)
    record.add(6, "SYNC start value", U8, RW)
    _add_mapping(dictionary, 0x1A00 + number, f"TPDO {number + 1} mapping parameter", default, entries)


def _add_mapping(
    dictionary: ObjectDictionary, index: int, name: str, default: PdoDefault, entries: int
) -> None:
    record = dictionary.add_record(index, name)
    record.add(0, "Number of mapped application objects", U8, RW, default=len(default.mapping))
    for subindex in range(1, entries + 1):
        word = default.mapping[subindex - 1] if subindex <= len(default.mapping) else 0
        record.add(subindex, f"Application object {subindex}", U32, RW, default=word)
