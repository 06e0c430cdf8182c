"""Where a vendor's objects mean something else than CiA 402 says, each with its source.

One TOML file a family of drives: ``vendor`` (1018h:1), optionally ``products`` (1018h:2) and ``device_name``
(the beginning of 1008h), and ``[[entry]]`` tables, each with its ``source``. What the user says goes first.
"""

import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any

from drivers.errors import BadInput

_FILE_KEYS = {"vendor", "products", "device_name", "entry"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Quirk:
    """One entry; None for what it leaves to the drive's objects."""

    source: str
    rated_torque_nm: float | None = None
    """N m of one unit of 6076h."""
    increments_index: int | None = None
    """Object that holds the encoder's increments per motor turn, for want of 608Fh."""
    increments_sub: int = 0
    position_increments: float | None = None
    """Encoder increments of one raw position unit."""
    velocity_increments_s: float | None = None
    """Encoder increments per second of one raw velocity unit, for want of 60A9h."""
    velocity_rpm: float | None = None
    """Revolutions per minute of one raw velocity unit, for want of 60A9h."""
    note: str = ""
    """What the user has to know."""


@dataclass(frozen=True, slots=True)
class QuirkFile:
    """What is known of one family of drives."""

    name: str
    vendor: int
    products: frozenset[int]
    device_name: str
    entries: tuple[Quirk, ...]

    def fits(self, vendor: int, product: int, device_name: str) -> bool:
        """The drive is one of the family; a drive that does not tell its name may be."""
        if vendor != self.vendor or (self.products and product not in self.products):
            return False
        named = device_name.upper().startswith(self.device_name.upper())
        return not self.device_name or not device_name or named


@cache
def known_quirks() -> tuple[QuirkFile, ...]:
    """All files of this folder, by name."""
    found = sorted(files(__name__).iterdir(), key=lambda path: path.name)
    return tuple(
        read_quirks(path.read_text(encoding="utf-8"), path.name)
        for path in found
        if path.name.endswith(".toml")
    )


def read_quirks(text: str, name: str) -> QuirkFile:
    """A file's content. Raises BadInput for a key that is not known, and for an entry without a source."""
    tables = tomllib.loads(text)
    if unknown := sorted(set(tables) - _FILE_KEYS):
        raise BadInput(name, unknown[0], tables[unknown[0]], f"one of {', '.join(sorted(_FILE_KEYS))}")
    if not isinstance(tables.get("vendor"), int):
        raise BadInput(name, "vendor", tables.get("vendor"), "the vendor-ID of 1018h:1")
    entries = tuple(_entry(entry, name, number) for number, entry in enumerate(tables.get("entry", ())))
    products = frozenset(tables.get("products", ()))
    return QuirkFile(name, tables["vendor"], products, tables.get("device_name", ""), entries)


def _entry(table: Mapping[str, Any], name: str, number: int) -> Quirk:
    known = set(Quirk.__dataclass_fields__)
    for key in table:
        if key not in known:
            raise BadInput(name, f"entry.{number}.{key}", table[key], f"one of {', '.join(sorted(known))}")
    if not str(table.get("source", "")).strip():
        raise BadInput(name, f"entry.{number}.source", table.get("source"), "where the fact stands")
    return Quirk(**{**table, "source": " ".join(table["source"].split())})


def quirks_for(
    vendor: int, product: int, device_name: str, known: Iterable[QuirkFile] | None = None
) -> tuple[tuple[str, Quirk], ...]:
    """File and entry of everything that is known of a drive."""
    every = known_quirks() if known is None else known
    return tuple(
        (file.name, entry)
        for file in every
        if file.fits(vendor, product, device_name)
        for entry in file.entries
    )
