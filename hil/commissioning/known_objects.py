"""Reads a drive's whole dictionary, with its data sheet or without one."""

from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any, Final

from canopen.objectdictionary import ObjectDictionary, ODVariable

from servobench.drivers.canopen.data_types import DataType
from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.objects301 import FIRST_OBJECT
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.errors import TransferAborted

Dump = dict[tuple[int, int], bytes]

_COMMUNICATION: Final = (
    *range(0x1000, 0x101A),
    0x1029,
    0x1200,
    *(first + number for first in (0x1400, 0x1600, 0x1800, 0x1A00) for number in range(8)),
)
_RECORDS: Final = (
    0x1003,
    0x1010,
    0x1011,
    0x1014,
    0x1016,
    0x1018,
    0x1029,
    0x1200,
    *range(0x1400, 0x1B00),
    0x607D,
    0x608F,
    *range(0x6090, 0x6098),
    0x6099,
    0x60C2,
    0x60E3,
)
_PROFILE: Final = (*(int(entry) for entry in Object), 0x60FE, 0x6403, 0x6404)
_WRITE_ONLY: Final = "wo"


def dump(
    network: CanopenNetwork, node: int, dictionary: ObjectDictionary | None, idle: Callable[[], None]
) -> Dump:
    """Read the bytes of every readable object; ``idle`` is called in between and may raise.

    Without a data sheet: the objects of CiA 301 and CiA 402 that drives have.
    """
    held: Dump = {}
    listed = ((each.index, each.subindex) for each in _readable(dictionary)) if dictionary else None
    for number, (index, sub) in enumerate(listed or _usual(network, node)):
        with suppress(TransferAborted):
            held[index, sub] = network.upload(node, index, sub)
        if number % 16 == 0:
            idle()
    return held


def _readable(dictionary: ObjectDictionary) -> Iterator[ODVariable]:
    for variable in variables(dictionary):
        if variable.access_type != _WRITE_ONLY and variable.data_type != DataType.DOMAIN:
            yield variable


def variables(dictionary: ObjectDictionary) -> Iterator[ODVariable]:
    """Yield every variable of a data sheet, in order of index and sub-index."""
    for index, entry in sorted(dictionary.items()):
        if index >= FIRST_OBJECT:
            members: dict[int, Any] = {0: entry} if isinstance(entry, ODVariable) else entry.subindices
            yield from (member for _sub, member in sorted(members.items()))


def _usual(network: CanopenNetwork, node: int) -> Iterator[tuple[int, int]]:
    for index in sorted({*_COMMUNICATION, *_PROFILE}):
        yield index, 0
        if index not in _RECORDS:
            continue
        try:
            count = network.upload(node, index, 0)
        except TransferAborted:
            continue
        for sub in range(1, min(count[0] if count else 0, 64) + 1):
            yield index, sub


def differing(held_objects: Dump, dictionary: ObjectDictionary) -> list[str]:
    """List settings that differ from the data sheet's defaults, in words."""
    lines = []
    for variable in variables(dictionary):
        held = held_objects.get((variable.index, variable.subindex))
        default = variable.default
        if held is None or not isinstance(default, int) or variable.access_type in ("ro", "const"):
            continue
        if not variable.writable or len(held) > 8 or not held:
            continue
        mask = (1 << 8 * len(held)) - 1
        if int.from_bytes(held, "little") != default & mask:
            value = int.from_bytes(held, "little", signed=default < 0)
            lines.append(
                f"{variable.index:04X}h:{variable.subindex:02X} {variable.name}: {value}, default {default}"
            )
    return lines


def missing(held: Dump, dictionary: ObjectDictionary) -> list[str]:
    """List objects of the data sheet that could not be read from the drive."""
    return [
        f"{variable.index:04X}h:{variable.subindex:02X} {variable.name}"
        for variable in _readable(dictionary)
        if (variable.index, variable.subindex) not in held
    ]
