"""Where a vendor's objects mean something else than CiA 402 says, each with its source.

One TOML file a family of drives: ``vendor`` (1018h:1), optionally ``products`` (1018h:2) and ``device_name``
(the beginning of 1008h), and ``[[entry]]`` tables, each with its ``source``. What the user says goes first.
"""

import tomllib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from typing import Any

from drivers.cia402.objects402 import Object
from drivers.cia402.scaling import RAD_PER_REVOLUTION, RAD_S_PER_RPM, ScaleOverride
from drivers.errors import BadInput

Values = dict[tuple[int, int], int | None]

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


@dataclass(frozen=True, slots=True)
class Applied:
    """What is known of a drive beside its objects."""

    values: Values
    override: ScaleOverride
    sources: Mapping[str, str]
    """By name of the factor, as in ``Scaling.sources``."""
    notes: tuple[str, ...] = ()


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


def apply_quirks(
    quirks: Iterable[tuple[str, Quirk]],
    values: Mapping[tuple[int, int], int | None],
    override: ScaleOverride,
    read: Callable[[int, int], int | None],
) -> Applied:
    """The drive's factor objects and the user's overrides, completed by what is known of it.

    ``read(index, sub)``: an object of the drive, None if it has none.
    """
    applied = Applied(dict(values), override, {})
    for name, quirk in quirks:
        applied = _apply(quirk, name, applied, read)
    return applied


def _apply(quirk: Quirk, name: str, so_far: Applied, read: Callable[[int, int], int | None]) -> Applied:
    values, override, sources = dict(so_far.values), so_far.override, dict(so_far.sources)
    notes = (*so_far.notes, quirk.note) if quirk.note else so_far.notes
    resolution = (Object.POSITION_ENCODER_RESOLUTION, 1)
    if quirk.increments_index is not None and not values.get(resolution):
        held = read(quirk.increments_index, quirk.increments_sub)
        if held:
            values[resolution], values[Object.POSITION_ENCODER_RESOLUTION, 2] = held, 1
            sources["position"] = f"{quirk.increments_index:04X}h:{quirk.increments_sub} ({name})"
    rated = values.get((Object.MOTOR_RATED_TORQUE, 0))
    if quirk.rated_torque_nm is not None and rated and override.rated_torque_nm is None:
        override = replace(override, rated_torque_nm=rated * quirk.rated_torque_nm)
        sources["torque"] = f"6076h in units of {quirk.rated_torque_nm:g} N m ({name})"
    increment = _increment_rad(values)
    if quirk.position_increments is not None and increment and override.position_rad is None:
        override = replace(override, position_rad=increment * quirk.position_increments)
        sources["position"] = f"{quirk.position_increments:g} increments ({name})"
    velocity = _velocity_rad_s(quirk, increment)
    told = values.get((Object.SI_UNIT_VELOCITY, 0))
    if velocity and not told and override.velocity_rad_s is None:
        override = replace(override, velocity_rad_s=velocity)
        sources["velocity"] = name
    return Applied(values, override, sources, notes)


def _increment_rad(values: Values) -> float | None:
    increments = values.get((Object.POSITION_ENCODER_RESOLUTION, 1))
    turns = values.get((Object.POSITION_ENCODER_RESOLUTION, 2))
    return RAD_PER_REVOLUTION * turns / increments if increments and turns else None


def _velocity_rad_s(quirk: Quirk, increment_rad: float | None) -> float | None:
    if quirk.velocity_rpm is not None:
        return quirk.velocity_rpm * RAD_S_PER_RPM
    if quirk.velocity_increments_s is None or increment_rad is None:
        return None
    return quirk.velocity_increments_s * increment_rad
