"""The objects of a drive without a data sheet, found by asking for every index.

An object is there if its sub-index 0 or 1 can be read, or is refused for another reason than that it is not
there. Nothing tells a type or an access: the standards' own where they define one, else a type guessed by the
size, and writable unless the standards say otherwise. The name says so.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Final

from canopen.objectdictionary import ObjectDictionary, ODRecord, ODVariable

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.objects301 import BITS, MANUFACTURER, Cia301, DataType, is_mapping
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.errors import NoAnswer, TransferAborted
from servobench.drivers.sheets.dictionary import is_kept
from servobench.drivers.sheets.eds.types import standard_type
from servobench.hil.inspecting.units import Place

EVERY_INDEX: Final = (range(0x1000, 0x2000), MANUFACTURER, range(0x6000, 0x6800))
"""Communication, the maker's, and the profile of one axis (CiA 301 clause 7.4.1, CiA 402-2)."""
FILES: Final = frozenset({Cia301.STORE_EDS, *range(0x1F20, 0x1F24), *range(0x1F50, 0x1F5A)})
"""Files and programs (CiA 302-3): no parameters; they may take minutes, and 1F51h stops a device."""
_READ_ONLY: Final = frozenset(
    {0x1000, 0x1001, 0x1002, 0x1003, 0x1008, 0x1009, 0x100A, 0x1018, 0x1200, 0x603F, 0x6041, 0x6043, 0x6044}
    | {0x6061, 0x6062, 0x6063, 0x6064, 0x6069, 0x606B, 0x606C, 0x6074, 0x6077, 0x6078, 0x6079, 0x60B9}
    | {*range(0x60BA, 0x60BE), *range(0x60D1, 0x60D9), 0x60E3, 0x60E4, 0x60E5, 0x60F4, 0x60FA, 0x60FC}
    | {0x60FD, 0x6502}
)
"""By CiA 301 and CiA 402-2."""
_NO_ANSWER: Final = 0
_WRITE_ONLY: Final = frozenset({0x0601_0000, 0x0601_0001})
_THERE: Final = _WRITE_ONLY | {_NO_ANSWER, 0x0800_0020, 0x0800_0021, 0x0800_0022, 0x0800_0024}
"""Abort codes for an object that exists and cannot be read now (CiA 301 table 22)."""
_NO_SUB: Final = 0x0609_0011
_BY_SIZE: Final = {
    1: DataType.UNSIGNED8, 2: DataType.UNSIGNED16, 4: DataType.UNSIGNED32, 8: DataType.UNSIGNED64
}  # fmt: skip
_TITLES: Final[dict[int, str]] = {int(each): each.title for table in (Cia301, Object) for each in table}
_SUBS_MAX: Final = 254


@dataclass(slots=True)
class Scanned:
    """Objects that were found."""

    dictionary: ObjectDictionary
    values: dict[Place, bytes] = field(default_factory=dict)
    """What each held when it was found."""
    unread: dict[Place, str] = field(default_factory=dict)
    """Those that are there and cannot be read, or were not answered for."""
    guessed: int = 0
    """Types that were guessed by size."""


def scan_objects(
    network: CanopenNetwork, node: int, indices: Sequence[range], tell: Callable[[str], None]
) -> Scanned:
    """Ask a node for every index of ``indices``. Raises NoAnswer if it answers no more at all."""
    count = sum(len(each) for each in indices)
    tell(f"no data sheet: asking node {node} for {count} indices")
    dictionary = ObjectDictionary()  # type: ignore[no-untyped-call]
    dictionary.node_id = node
    found = Scanned(dictionary)
    for index in (index for each in indices for index in each if index not in FILES):
        _ask(network, node, index, found)
    tell(
        f"{len(found.values)} objects found; types of {found.guessed} guessed by their size, and nobody told "
        "which can be written"
    )
    return found


def _ask(network: CanopenNetwork, node: int, index: int, found: Scanned) -> None:
    members = {0: _answer(network, node, index, 0)}
    if not _is_there(members[0]) and members[0] != _NO_SUB:
        return
    second = _answer(network, node, index, 1)
    is_record = _is_there(second)
    if is_record:
        members[1] = second
        head = members[0]  # of some objects not how many there are, but how many count, as in a mapping
        last = head[0] if isinstance(head, bytes) and len(head) == 1 else 0
        for sub in range(2, _SUBS_MAX + 1):
            members[sub] = _answer(network, node, index, sub)
            if members[sub] == _NO_SUB and sub > last:
                break
    record = ODRecord(_title(index), index) if is_record else None
    for sub, answer in members.items():
        if isinstance(answer, bytes):
            variable = _described(found, index, sub, answer, is_record)
            found.values[index, sub] = answer
            (found.dictionary.add_object if record is None else record.add_member)(variable)
        elif _is_there(answer) and answer not in _WRITE_ONLY:
            found.unread[index, sub] = f"abort code {answer:08X}h" if answer else "not answered"
    if record is not None and record.subindices:
        found.dictionary.add_object(record)


def _answer(network: CanopenNetwork, node: int, index: int, sub: int) -> bytes | int:
    """Return the value, or the abort code, 0 without an answer. Raises NoAnswer from a node that is gone."""
    try:
        return network.upload(node, index, sub)
    except TransferAborted as error:
        return error.code
    except NoAnswer:
        network.upload(node, Cia301.DEVICE_TYPE)
        return _NO_ANSWER


def _is_there(answer: bytes | int) -> bool:
    return isinstance(answer, bytes) or answer in _THERE


def _described(found: Scanned, index: int, sub: int, value: bytes, in_record: bool) -> ODVariable:
    known = standard_type(index, sub if in_record else None)
    is_count = in_record and sub == 0
    if known is None and is_count and len(value) == 1:
        known = DataType.UNSIGNED8
    guessed = known is None or len(value) * 8 != -(-BITS.get(known, len(value) * 8) // 8) * 8
    name = _title(index) if not in_record else f"sub {sub}"
    data_type: int = known or 0
    if guessed:
        data_type = _by_size(value)
        found.guessed += 1
        name += f" ({DataType(data_type).name} by its size{_own(found.dictionary, index, value)})"
    variable = ODVariable(name, index, sub)
    variable.data_type = data_type
    is_fixed = index in _READ_ONLY or (is_count and not (is_mapping(index) or index in MANUFACTURER))
    variable.access_type = "ro" if is_fixed else "rw"
    return variable


def _by_size(value: bytes) -> DataType:
    if len(value) in _BY_SIZE:
        return _BY_SIZE[len(value)]
    is_text = b"\0" not in value and is_kept(value, DataType.VISIBLE_STRING)
    return DataType.VISIBLE_STRING if value and is_text else DataType.OCTET_STRING


def _own(dictionary: ObjectDictionary, index: int, value: bytes) -> str:
    """Return a word on what may be a device's own, so that no other device is given it."""
    is_id = index in MANUFACTURER and int.from_bytes(value, "little") == dictionary.node_id
    return ", perhaps its node-ID" if is_id else ""


def _title(index: int) -> str:
    return _TITLES.get(index, f"{index:04X}h")
