"""PDO capability of a drive by its dictionary."""

from collections.abc import Mapping
from typing import Any

import canopen.objectdictionary as od

from servobench.drivers.canopen.objects301 import BITS, FIRST_OBJECT, PDO_ENTRIES_MAX, REAL_BITS, STRUCT_CODES
from servobench.drivers.canopen.pdo import PdoDirection
from servobench.drivers.canopen.pdo_capability import MappedObject, PdoCapability, PdoSlot
from servobench.drivers.sheets.dictionary import LoadedDictionary, held_by

_PDOS_MAX = 64
"""PDOs of the first axis: 512 are shared by eight. The largest of six makers' data sheets has 8."""
_WRITABLE = ("rw", "wo", "rwr", "rww")
_TRANSMITTED = ("ro", "rw", "rwr", "const")
_RECEIVED = ("wo", "rw", "rww")


def capability_of(loaded: LoadedDictionary) -> PdoCapability:
    """Read the capability from a dictionary loaded for the drive's node-ID."""
    dictionary = loaded.dictionary
    objects = {}
    for index, entry in dictionary.items():
        if index < FIRST_OBJECT:
            continue
        members = {0: entry} if isinstance(entry, od.ODVariable) else entry.subindices
        for sub, variable in members.items():
            mapped = _mapped_object(index, sub, variable)
            if mapped is not None:
                objects[index, sub] = mapped
    slots = [
        slot
        for direction in PdoDirection
        for number in range(1, _PDOS_MAX + 1)
        if (slot := _slot(dictionary, direction, number)) is not None
    ]
    flags_tell = any(mapped.mappable for mapped in objects.values())
    return PdoCapability(tuple(slots), objects, loaded.dummies, flags_tell)


def _mapped_object(index: int, sub: int, variable: Any) -> MappedObject | None:
    bits = BITS.get(variable.data_type)
    if bits is None:
        return None
    code = STRUCT_CODES.get(variable.data_type, "") if variable.data_type not in REAL_BITS else ""
    access = variable.access_type
    return MappedObject(
        index,
        sub,
        bits,
        code,
        bool(variable.pdo_mappable),
        access in _TRANSMITTED,
        access in _RECEIVED,
        variable.name,
    )


def _slot(dictionary: Any, direction: PdoDirection, number: int) -> PdoSlot | None:
    communication = _members(dictionary, direction.value + number - 1)
    mapping = _members(dictionary, direction.mapping_base + number - 1)
    if not communication and not mapping:
        return None
    words = _mapping_words(mapping)
    places = [sub for sub in mapping if sub]
    writable = any(mapping[sub].access_type in _WRITABLE for sub in places)
    entries_max, entries_told = _entries(mapping, places)
    count_writable = 0 not in mapping or mapping[0].access_type in _WRITABLE
    return PdoSlot(
        direction,
        number,
        _number(communication.get(1)),
        _writable(communication, 1),
        _number(communication.get(2)),
        _writable(communication, 2),
        words,
        writable and (count_writable or len(places) == 1),
        entries_max,
        _number(communication.get(3)),
        _number(communication.get(5)),
        entries_told,
        _writable(communication, 3),
        _writable(communication, 5),
    )


def _writable(members: Mapping[int, Any], sub: int) -> bool:
    return sub in members and members[sub].access_type in _WRITABLE


def _entries(mapping: Mapping[int, Any], places: list[int]) -> tuple[int, int]:
    """Return how many entries exist, and how many sub-index 0 allows beyond them (0: no more)."""
    most = mapping[0].max if 0 in mapping else None
    there = len(places)
    if not isinstance(most, int) or most <= 0:
        return there, 0
    return min(there, most), min(most, PDO_ENTRIES_MAX) if most > there else 0


def _mapping_words(mapping: Mapping[int, Any]) -> tuple[int, ...]:
    """Return the default mapping: as many entries as sub-index 0 says, or all that are not 0."""
    words = [_number(mapping[sub]) or 0 for sub in sorted(mapping) if sub]
    count = _number(mapping.get(0))
    if count is None or count > len(words):
        return tuple(word for word in words if word)
    return tuple(words[:count])


def _members(dictionary: Any, index: int) -> dict[int, Any]:
    entry = dictionary.get(index)
    if entry is None or isinstance(entry, od.ODVariable):
        return {}
    return dict(entry.subindices)


def _number(variable: Any) -> int | None:
    held = held_by(variable)
    return held if isinstance(held, int) else None
