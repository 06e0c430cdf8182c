"""PDOs that have no sections of their own: CompactPDO in [DeviceInfo] (CiA 306-1 clause 4.5.3)."""

from drivers.canopen.cob_ids import NOT_VALID
from drivers.canopen.data_types import DataType
from drivers.canopen.objects301 import MAPPING_OFFSET, RPDO_COMMUNICATION, TPDO_COMMUNICATION
from drivers.sheets.eds import types
from drivers.sheets.eds.entries import Entry
from drivers.sheets.eds.information import DeviceInformation
from drivers.sheets.eds.numbers import Formula
from drivers.sheets.eds.objects import EdsObject
from drivers.sheets.eds.values import Value

_PREDEFINED = 4
_PDOS_MAX = 512
_MAPPED_MAX = 64

_SUBS = {
    1: ("COB-ID", DataType.UNSIGNED32),
    2: ("Transmission type", DataType.UNSIGNED8),
    3: ("Inhibit time", DataType.UNSIGNED16),
    4: ("Reserved", DataType.UNSIGNED8),
    5: ("Event timer", DataType.UNSIGNED16),
    6: ("SYNC start value", DataType.UNSIGNED8),
}


def add_compact_pdos(objects: dict[int, EdsObject], device: DeviceInformation) -> None:
    """Define the PDOs that ``device`` has beyond those of the file."""
    if not device.compact_pdo:
        return
    for base, first_id, count, name in (
        (RPDO_COMMUNICATION, 0x200, device.receive_pdos, "RPDO"),
        (TPDO_COMMUNICATION, 0x180, device.transmit_pdos, "TPDO"),
    ):
        for number in range(min(count or 0, _PDOS_MAX)):
            title = f"{name}{number + 1}"
            made = _communication(base + number, first_id + 0x100 * number, device.compact_pdo, title)
            objects.setdefault(made.index, made)
            mapping = _mapping(base + MAPPING_OFFSET + number, device.granularity or 8, title)
            objects.setdefault(mapping.index, mapping)


def _communication(index: int, cob_id: int, mask: int, title: str) -> EdsObject:
    made = EdsObject(index, f"{title} communication parameter", types.RECORD)
    subs = [sub for sub in _SUBS if mask >> (sub - 1) & 1]
    made.entries[0] = _entry(index, 0, "Highest sub-index", DataType.UNSIGNED8, "ro", max(subs, default=0))
    for sub in subs:
        name, data_type = _SUBS[sub]
        made.entries[sub] = _entry(index, sub, name, data_type, "rw", 255 if sub == 2 else 0)
    if 1 in made.entries:
        predefined = index & 0x1FF < _PREDEFINED
        made.entries[1].default = Value(None, Formula(1, cob_id)) if predefined else Value(NOT_VALID)
    return made


def _mapping(index: int, granularity: int, title: str) -> EdsObject:
    made = EdsObject(index, f"{title} mapping parameter", types.RECORD)
    made.entries[0] = _entry(index, 0, "Number of mapped objects", DataType.UNSIGNED8, "rw", 0)
    for sub in range(1, _MAPPED_MAX // max(1, min(granularity, _MAPPED_MAX)) + 1):
        made.entries[sub] = _entry(index, sub, f"Mapped object {sub}", DataType.UNSIGNED32, "rw", 0)
    return made


def _entry(index: int, sub: int, name: str, data_type: int, access: str, value: int) -> Entry:
    entry = Entry(index, sub, name, data_type, access)
    entry.default = Value(value)
    return entry
