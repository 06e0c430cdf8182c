"""What in a dictionary contradicts itself, beyond the form: the values stay as they are, and are told."""

from collections.abc import Iterable
from typing import Any

import canopen.objectdictionary as od

from drivers.canopen.objects301 import FIRST_OBJECT, Cia301, is_mapping
from drivers.canopen.pdo import key_of, mapping_text
from drivers.canopen.pdo_capability import PdoCapability, PdoSlot

_NAMED_MAX = 4
_PDO_BITS = 64


def doubts(dictionary: od.ObjectDictionary, capability: PdoCapability) -> tuple[str, ...]:
    """Default mappings that cannot be, and objects whose sub-index 0 is not their highest sub-index."""
    all_doubts = [doubt for slot in capability.slots for doubt in _of_mapping(slot, capability)]
    counts = [doubt for index, entry in dictionary.items() if (doubt := _of_count(index, entry))]
    if counts:
        all_doubts.append(f"sub-index 0 is not the highest sub-index: {_some(counts)}")
    return tuple(all_doubts)


def _of_mapping(slot: PdoSlot, capability: PdoCapability) -> Iterable[str]:
    wrong = []
    for word in slot.mapping:
        key, bits, named = key_of(word), word & 0xFF, mapping_text([word])
        if key[0] < FIRST_OBJECT:
            if key[0] not in capability.dummies:
                wrong.append(f"{named} is no placeholder that it offers")
            continue
        entry = capability.objects.get(key)
        if entry is None:
            wrong.append(f"{named} is no object of its own with a length")
        elif entry.bits != bits:
            wrong.append(f"{named} has {entry.bits} bits")
    if wrong:
        yield f"the mapping of {slot.name} in the file cannot be: {_some(wrong)}"
    total = sum(word & 0xFF for word in slot.mapping)
    if total > _PDO_BITS:
        yield f"the mapping of {slot.name} in the file has {total} bits, and a PDO holds {_PDO_BITS}"


def _of_count(index: int, entry: Any) -> str:
    # sub-index 0 of these counts the entries in use (CiA 301 7.5.2.3, 7.5.2.36, 7.5.2.38)
    in_use = index == Cia301.ERROR_HISTORY or is_mapping(index)
    if isinstance(entry, od.ODVariable) or in_use:
        return ""
    first = entry.subindices.get(0)
    if first is None or first.access_type not in ("ro", "const") or not isinstance(first.default, int):
        return ""
    highest = max(entry.subindices)
    return "" if first.default == highest else f"{index:04X}h says {first.default} and has {highest}"


def _some(named: list[str]) -> str:
    more = len(named) - _NAMED_MAX
    return "; ".join(named[:_NAMED_MAX]) + (f"; and {more} more" if more > 0 else "")
