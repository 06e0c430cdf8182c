"""Files in which somebody has put a node-ID in the place of $NODEID: the COB-IDs of one node for all."""

from collections.abc import Iterator, Mapping
from typing import Final

from drivers.canopen.cob_ids import CAN_ID, EMERGENCY, RPDOS, TPDOS
from drivers.canopen.objects301 import RPDO_COMMUNICATION, TPDO_COMMUNICATION, Cia301
from drivers.sheets.eds.entries import Entry
from drivers.sheets.eds.numbers import Formula
from drivers.sheets.eds.objects import EdsObject
from drivers.sheets.eds.repairs import RepairLog
from drivers.sheets.eds.sections import Sections, section_name
from drivers.sheets.eds.values import Value

_PREDEFINED: Final[dict[tuple[int, int], int]] = {
    (Cia301.EMCY_COB_ID, 0): EMERGENCY,
    **{(RPDO_COMMUNICATION + number, 1): cob_id for number, cob_id in enumerate(RPDOS)},
    **{(TPDO_COMMUNICATION + number, 1): cob_id for number, cob_id in enumerate(TPDOS)},
}
"""COB-IDs of the predefined connection set without the node-ID (CiA 301, 7.3.5)."""
_WITNESSES_MIN: Final = 3
"""So many identifiers have to be those of one node: two may be by chance, or by somebody's wish."""


def free_of_node(objects: Mapping[int, EdsObject], sections: Sections, log: RepairLog) -> None:
    """Let the identifiers of the predefined connection set follow the node-ID, if all that are plain numbers
    are those of one and the same node."""
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
    """Entries that are plain numbers, with the identifier's base and the number."""
    for (index, sub), base in _PREDEFINED.items():
        entry = objects[index].entries.get(sub) if index in objects else None
        value = None if entry is None else entry.default.value
        if entry is not None and isinstance(value, int) and value & CAN_ID:
            yield entry, base, value
