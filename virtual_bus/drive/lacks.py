"""Features that a simulated drive can lack, to test a master's way around them.

"1013"          an object
"1400:5"        a sub-index of an object
"tpdo events"   transmission types 254 and 255 of TPDOs: only SYNC and remote requests send them
"""

import re
from collections.abc import Sequence
from typing import Final

from servobench.drivers.canopen.objects301 import MANDATORY, TPDO_COMMUNICATION, TPDO_MAPPING, is_mapping
from servobench.virtual_bus.device.object_dictionary import DictionaryObject, ObjectDictionary
from servobench.virtual_bus.device.pdo_engine import REMOTE_EVENT

TPDO_EVENTS: Final = "tpdo events"
PATTERN: Final = rf"^([0-9A-Fa-f]{{4}}(:[0-9]{{1,3}})?|{TPDO_EVENTS})$"
_TPDOS: Final = range(TPDO_COMMUNICATION, TPDO_MAPPING)


def take_away(dictionary: ObjectDictionary, lacks: Sequence[str]) -> None:
    """Take ``lacks`` off the bus; PDOs map nothing of it by default. The drive itself goes on as before.

    Error: ValueError, whose first argument is what cannot be lacked.
    """
    for lack in lacks:
        if lack == TPDO_EVENTS:
            _refuse_events(dictionary)
        elif re.match(PATTERN, lack) is None:
            raise ValueError(lack)
        else:
            index, _, subindex = lack.partition(":")
            _remove(dictionary, int(index, 16), int(subindex or 0), lack)
    for entry in dictionary:
        if is_mapping(entry.index):
            _map_what_is_left(dictionary, entry)


def _refuse_events(dictionary: ObjectDictionary) -> None:
    for entry in dictionary:
        kind = entry.members.get(2)
        if entry.index in _TPDOS and kind is not None:
            kind.high = REMOTE_EVENT
            kind.default = min(kind.default, 1)


def _remove(dictionary: ObjectDictionary, index: int, subindex: int, lack: str) -> None:
    if index in MANDATORY or dictionary.get(index, subindex) is None:
        raise ValueError(lack)
    members = dictionary.object(index).members
    if subindex == 0:
        dictionary.conceal(index)
        return
    del members[subindex]
    members[0].default = members[0].value = max(members)


def _map_what_is_left(dictionary: ObjectDictionary, mapping: DictionaryObject) -> None:
    members = mapping.members
    words = [members[place].default for place in range(1, members[0].default + 1)]
    left = [word for word in words if dictionary.get(word >> 16, word >> 8 & 0xFF) is not None]
    members[0].default = members[0].value = len(left)
    for place in range(1, len(members)):
        members[place].default = left[place - 1] if place <= len(left) else 0
