"""Concise DCF: what object 1F22h of a CANopen manager holds for each node (CiA 302-3), as a file.

    count     UNSIGNED32   entries that follow
    entry     index UNSIGNED16, sub-index UNSIGNED8, size UNSIGNED32, and as many bytes of data

All are little endian. A manager writes the entries in their order; an object may come more than once, a PDO
switched off first. Nothing tells the device, or a type of data.
"""

from collections.abc import Iterable
from pathlib import Path
from struct import Struct, error, unpack_from
from typing import Final, NamedTuple

from servobench.drivers.bounded_file import read_bytes
from servobench.drivers.errors import BadInput

SUFFIX: Final = ".bin"
_WHAT: Final = "concise DCF (CiA 302-3, object 1F22h)"
_COUNT: Final = Struct("<I")
_ENTRY: Final = Struct("<HBI")


class ConciseEntry(NamedTuple):
    """One write."""

    place: tuple[int, int]
    """Index and sub-index."""
    data: bytes


def is_concise(path: Path) -> bool:
    """Return True for a file that its name says to be a concise DCF."""
    return path.suffix.lower() == SUFFIX


def concise_bytes(entries: Iterable[ConciseEntry]) -> bytes:
    """Return the bytes of the entries."""
    parts = [_ENTRY.pack(*place, len(data)) + data for place, data in entries]
    return _COUNT.pack(len(parts)) + b"".join(parts)


def read_concise(path: Path) -> list[ConciseEntry]:
    """Read the entries of a file. Raises BadInput for another kind of file, or one that is cut short."""
    data, entries, place = read_bytes(path, _WHAT), list[ConciseEntry](), _COUNT.size
    try:
        (count,) = _COUNT.unpack_from(data)
        for _ in range(count):
            index, sub, size = _ENTRY.unpack_from(data, place)
            (value,) = unpack_from(f"<{size}s", data, place + _ENTRY.size)
            place += _ENTRY.size + size
            entries.append(ConciseEntry((index, sub), value))
    except error:
        found = f"{len(data)} bytes with an entry beyond their end"
        raise BadInput(str(path), f"entry {len(entries) + 1}", found, f"a {_WHAT}") from None
    if place != len(data):
        found = f"{len(data) - place} bytes behind the last of {count} entries"
        raise BadInput(str(path), "", found, f"a {_WHAT}")
    return entries
