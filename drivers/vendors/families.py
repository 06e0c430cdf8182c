"""Vendor knowledge about families of drives beyond their objects and the standard, each fact with its source.

One TOML file a family: ``vendor`` (1018h:1), optionally ``products`` (1018h:2) and ``device_name`` (how 1008h
begins). ``[codes]`` has the maker's texts for error codes or ranges of them, ``[numbers]`` what it puts into
the upper octet of 1003h, both from the file's ``source``. An ``[[entry]]`` tells where an object means
something else than CiA 402 says, with a ``source`` of its own; what the user says goes first. ``[motor]``,
``[commutation]``, ``[gains]`` and ``[stamp]``: see :mod:`servobench.drivers.vendors.motor_objects`,
:mod:`servobench.drivers.vendors.commutation_objects`, :mod:`servobench.drivers.vendors.gain_objects` and
:mod:`servobench.drivers.vendors.stamps`.
"""

import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib.resources import files
from typing import Any

from servobench.drivers.errors import BadInput
from servobench.drivers.vendors.commutation_objects import CommutationObjects, read_commutation
from servobench.drivers.vendors.gain_objects import GainObjects, read_gains
from servobench.drivers.vendors.motor_objects import (
    MotorObjects,
    one_line,
    read_motor_objects,
    refuse_unknown,
)
from servobench.drivers.vendors.stamps import STANDARD_STAMP, StampProfile, read_stamp

_FACTS = {"source", "codes", "numbers", "entry", "motor", "commutation", "gains", "stamp"}
_KEYS = {"vendor", "products", "device_name", *_FACTS}


@dataclass(frozen=True, slots=True, kw_only=True)
class Quirk:
    """One entry; None leaves the value to the drive's objects."""

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
    """A note for the user."""


@dataclass(frozen=True, slots=True, kw_only=True)
class DriveFamily:
    """Known facts about one family of drives."""

    name: str
    """Name of its file, without suffix."""
    vendor: int
    products: frozenset[int] = frozenset()
    device_name: str = ""
    source: str = ""
    """Source of the codes and numbers."""
    texts: Mapping[range, str] = field(default_factory=dict)
    numbers: Mapping[int, str] = field(default_factory=dict)
    """Texts for bits 24 to 31 of an entry of 0x1003, for makers that report the cause there."""
    quirks: tuple[Quirk, ...] = ()
    motor: MotorObjects | None = None
    """Where its drives keep their motor data; None: no source says."""
    commutation: CommutationObjects | None = None
    """Where its drives keep how encoder and rotor are joined; None: no source says."""
    gains: GainObjects | None = None
    """Where its drives keep the gains of their loops; None: no source says."""
    stamp: StampProfile | None = None
    """How its drives stamp; None: no source reports a difference from CiA 301."""

    def text(self, code: int) -> str | None:
        """Return the maker's text for an error code; None if it has none."""
        return next((text for codes, text in self.texts.items() if code in codes), None)

    def fits(self, vendor: int, product: int, device_name: str) -> bool:
        """Return True if the drive is, or without a name may be, one of the family."""
        if vendor != self.vendor or (self.products and product not in self.products):
            return False
        return not device_name or self.is_named_by(device_name)

    def is_named_by(self, device_name: str) -> bool:
        """Return True if a drive of this name belongs to this maker's family."""
        return device_name.upper().startswith(self.device_name.upper())


@cache
def known_families() -> tuple[DriveFamily, ...]:
    """Read all files of this folder, by name."""
    entries = sorted(files(__package__).iterdir(), key=lambda path: path.name)
    return tuple(
        read_family(path.read_text(encoding="utf-8"), path.name)
        for path in entries
        if path.name.endswith(".toml")
    )


def read_family(text: str, name: str) -> DriveFamily:
    """Parse a family file. Raises BadInput for an unknown key, and for a fact without a source."""
    tables = tomllib.loads(text)
    refuse_unknown(tables, _KEYS, name)
    if not isinstance(tables.get("vendor"), int):
        raise BadInput(name, "vendor", tables.get("vendor"), "the vendor-ID of 1018h:1")
    source = one_line(tables.get("source"))
    if not source and ("codes" in tables or "numbers" in tables):
        raise BadInput(name, "source", tables.get("source"), "where the codes stand")
    return DriveFamily(
        name=name,
        vendor=tables["vendor"],
        products=frozenset(tables.get("products", ())),
        device_name=str(tables.get("device_name", "")),
        source=source,
        texts={_codes(key, name): str(value) for key, value in tables.get("codes", {}).items()},
        numbers={int(key): str(value) for key, value in tables.get("numbers", {}).items()},
        quirks=tuple(_quirk(entry, name, number) for number, entry in enumerate(tables.get("entry", ()))),
        motor=read_motor_objects(tables["motor"], name) if "motor" in tables else None,
        commutation=read_commutation(tables["commutation"], name) if "commutation" in tables else None,
        gains=read_gains(tables["gains"], name) if "gains" in tables else None,
        stamp=read_stamp(tables["stamp"], name) if "stamp" in tables else None,
    )


def _codes(key: str, name: str) -> range:
    """Parse ``7380`` or ``6180-61F0``, hexadecimal."""
    first, _, last = key.partition("-")
    try:
        return range(int(first, 16), int(last or first, 16) + 1)
    except ValueError:
        raise BadInput(name, f"codes.{key}", key, "a hexadecimal code, or two with - between") from None


def _quirk(table: Mapping[str, Any], name: str, number: int) -> Quirk:
    refuse_unknown(table, set(Quirk.__dataclass_fields__), name, f"entry.{number}.")
    source = one_line(table.get("source"))
    if not source:
        raise BadInput(name, f"entry.{number}.source", table.get("source"), "where the fact stands")
    return Quirk(**{**table, "source": source})


def codes_of(vendor: int, device_name: str) -> list[DriveFamily]:
    """Return the families that a drive of this name belongs to: their codes say nothing about others."""
    return [
        family for family in known_families() if family.vendor == vendor and family.is_named_by(device_name)
    ]


def quirks_for(
    vendor: int, product: int, device_name: str, known: Iterable[DriveFamily] | None = None
) -> tuple[tuple[str, Quirk], ...]:
    """Return file and entry of every known quirk of a drive."""
    every = known_families() if known is None else known
    return tuple(
        (family.name, quirk)
        for family in every
        if family.fits(vendor, product, device_name)
        for quirk in family.quirks
    )


def motor_objects_for(vendor: int, product: int, device_name: str) -> tuple[tuple[str, MotorObjects], ...]:
    """Return file and objects of every family that a drive may belong to."""
    return tuple(
        (family.name, family.motor)
        for family in known_families()
        if family.motor is not None and family.fits(vendor, product, device_name)
    )


def commutation_for(vendor: int, product: int, device_name: str) -> CommutationObjects | None:
    """Return the objects of the first family that a drive may belong to; None if none is known."""
    fitting = (
        family.commutation
        for family in known_families()
        if family.commutation is not None and family.fits(vendor, product, device_name)
    )
    return next(fitting, None)


def gains_for(vendor: int, product: int, device_name: str) -> GainObjects | None:
    """Return the objects of the first family that a drive may belong to; None if none is known."""
    fitting = (
        family.gains
        for family in known_families()
        if family.gains is not None and family.fits(vendor, product, device_name)
    )
    return next(fitting, None)


def stamp_for(vendor: int, product: int, device_name: str) -> StampProfile:
    """Return how a drive stamps its samples; as in CiA 301 if nothing is known about its make."""
    fitting = (
        family.stamp
        for family in known_families()
        if family.stamp and family.fits(vendor, product, device_name)
    )
    return next(fitting, STANDARD_STAMP)
