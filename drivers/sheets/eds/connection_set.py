"""The predefined connection set (CiA 301, 7.3.5) in a file: PDOs in short form, COB-IDs of one node.

CompactPDO in [DeviceInfo] defines PDOs without their own sections (CiA 306-1 clause 4.5.3). Some files have a
node-ID in place of $NODEID: the COB-IDs of one node for all.
"""

from collections.abc import Iterator, Mapping
from typing import Final

from servobench.drivers.canopen.cob_ids import CAN_ID, EMERGENCY, NOT_VALID, RPDOS, TPDOS
from servobench.drivers.canopen.objects301 import (
    MAPPING_OFFSET,
    PDO_ENTRIES_MAX,
    PDOS_MAX,
    RPDO_COMMUNICATION,
    TPDO_COMMUNICATION,
    Cia301,
    DataType,
)
from servobench.drivers.sheets.eds import types
from servobench.drivers.sheets.eds.entries import Entry, Value
from servobench.drivers.sheets.eds.information import DeviceInformation
from servobench.drivers.sheets.eds.numbers import Formula
from servobench.drivers.sheets.eds.objects import EdsObject
from servobench.drivers.sheets.eds.sections import Sections, section_name
from servobench.drivers.sheets.eds.text import RepairLog

_PREDEFINED: Final[dict[tuple[int, int], int]] = {
    (Cia301.EMCY_COB_ID, 0): EMERGENCY,
    **{(RPDO_COMMUNICATION + number, 1): cob_id for number, cob_id in enumerate(RPDOS)},
    **{(TPDO_COMMUNICATION + number, 1): cob_id for number, cob_id in enumerate(TPDOS)},
}
"""COB-IDs of the predefined connection set without the node-ID (CiA 301, 7.3.5)."""
_WITNESSES_MIN: Final = 3
"""Identifiers that must belong to one node: two may by chance, or on purpose."""
_SUBS = {
    1: ("COB-ID", DataType.UNSIGNED32),
    2: ("Transmission type", DataType.UNSIGNED8),
    3: ("Inhibit time", DataType.UNSIGNED16),
    4: ("Reserved", DataType.UNSIGNED8),
    5: ("Event timer", DataType.UNSIGNED16),
    6: ("SYNC start value", DataType.UNSIGNED8),
}


def add_compact_pdos(objects: dict[int, EdsObject], device: DeviceInformation) -> None:
    """Define the PDOs of ``device`` beyond those of the file."""
    if not device.compact_pdo:
        return
    for base, first_id, count, name in (
        (RPDO_COMMUNICATION, 0x200, device.receive_pdos, "RPDO"),
        (TPDO_COMMUNICATION, 0x180, device.transmit_pdos, "TPDO"),
    ):
        for number in range(min(count or 0, PDOS_MAX)):
            title = f"{name}{number + 1}"
            communication = _communication(
                base + number, first_id + 0x100 * number, device.compact_pdo, title
            )
            objects.setdefault(communication.index, communication)
            mapping = _mapping(base + MAPPING_OFFSET + number, device.granularity or 8, title)
            objects.setdefault(mapping.index, mapping)


def _communication(index: int, cob_id: int, mask: int, title: str) -> EdsObject:
    parameter = EdsObject(index, f"{title} communication parameter", types.RECORD)
    subs = [sub for sub in _SUBS if mask >> (sub - 1) & 1]
    parameter.entries[0] = _entry(
        index, 0, "Highest sub-index", DataType.UNSIGNED8, "ro", max(subs, default=0)
    )
    for sub in subs:
        name, data_type = _SUBS[sub]
        parameter.entries[sub] = _entry(index, sub, name, data_type, "rw", 255 if sub == 2 else 0)
    if 1 in parameter.entries:
        predefined = index & 0x1FF < len(TPDOS)
        parameter.entries[1].default = Value(None, Formula(1, cob_id)) if predefined else Value(NOT_VALID)
    return parameter


def _mapping(index: int, granularity: int, title: str) -> EdsObject:
    parameter = EdsObject(index, f"{title} mapping parameter", types.RECORD)
    parameter.entries[0] = _entry(index, 0, "Number of mapped objects", DataType.UNSIGNED8, "rw", 0)
    for sub in range(1, PDO_ENTRIES_MAX // max(1, min(granularity, PDO_ENTRIES_MAX)) + 1):
        parameter.entries[sub] = _entry(index, sub, f"Mapped object {sub}", DataType.UNSIGNED32, "rw", 0)
    return parameter


def _entry(index: int, sub: int, name: str, data_type: int, access: str, value: int) -> Entry:
    entry = Entry(index, sub, name, data_type, access)
    entry.default = Value(value)
    return entry


def free_of_node(objects: Mapping[int, EdsObject], sections: Sections, log: RepairLog) -> None:
    """Make the identifiers of the predefined connection set follow the node-ID, if all that are plain numbers
    belong to one node."""
    plain = list(_plain(objects))
    nodes = {(value & CAN_ID) - base for _, base, value in plain}
    if len(plain) < _WITNESSES_MIN or len(nodes) != 1:
        return
    (node,) = nodes
    if not 1 <= node <= 127:
        return
    for entry, _, value in plain:
        entry.default = Value(None, Formula(1, value - node), entry.default.text)
    first = plain[0][0]
    name = section_name(first.index, None if objects[first.index].is_variable else first.sub)
    line = sections[name].line if name in sections else 0
    log.add("file", f"{len(plain)} COB-IDs are those of node {node}", "read as $NODEID+0x...", line)


def _plain(objects: Mapping[int, EdsObject]) -> Iterator[tuple[Entry, int, int]]:
    """Yield entries that are plain numbers, with the identifier's base and the number."""
    for (index, sub), base in _PREDEFINED.items():
        entry = objects[index].entries.get(sub) if index in objects else None
        value = None if entry is None else entry.default.value
        if entry is not None and isinstance(value, int) and value & CAN_ID:
            yield entry, base, value
