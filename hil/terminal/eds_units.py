"""What a data sheet tells of a drive's units, factor by factor."""

from dataclasses import replace
from typing import NamedTuple

from drivers.cia402.quirky_units import apply_quirks
from drivers.cia402.scaling import FACTOR_OBJECTS, ScaleOverride, Scaling, scaling_from
from drivers.errors import PeerFault
from drivers.sheets.dictionary import LoadedDictionary
from drivers.sheets.fitness import Fitness, held
from drivers.vendors.families import quirks_for


class UnitLine(NamedTuple):
    """One factor; ``value`` None if the file does not tell it."""

    name: str
    value: float | None
    unit: str
    source: str


def unit_lines(loaded: LoadedDictionary, fitness: Fitness) -> tuple[tuple[UnitLine, ...], tuple[str, ...]]:
    """Each raw unit in SI, by the defaults or parameter values of the file; and what is known of the make."""
    dictionary, identity = loaded.dictionary, fitness.identity

    def read(index: int, sub: int) -> int | None:
        value = held(dictionary, index, sub)
        return value if isinstance(value, int) else None

    name = identity.device_name or identity.product_name
    quirks = quirks_for(identity.vendor or 0, identity.product or 0, name)
    known = apply_quirks(quirks, {key: read(*key) for key in FACTOR_OBJECTS}, ScaleOverride(), read)
    scaling, missing = _as_far_as_told(known.values, known.override)
    sources = {**scaling.sources, **known.sources} if scaling is not None else {}
    lines = tuple(
        UnitLine(quantity, None if scaling is None or quantity in missing else value, unit, source)
        for quantity, value, unit in (
            ("position", 0.0 if scaling is None else scaling.position_rad, "rad"),
            ("velocity", 0.0 if scaling is None else scaling.velocity_rad_s, "rad/s"),
            ("acceleration", 0.0 if scaling is None else scaling.acceleration_rad_s2, "rad/s^2"),
            ("torque", 0.0 if scaling is None else scaling.torque_nm, "N m"),
        )
        for source in ["not told" if quantity in missing else sources.get(quantity, "not told")]
    )
    return lines, known.notes


def _as_far_as_told(
    values: dict[tuple[int, int], int | None], override: ScaleOverride
) -> tuple[Scaling | None, frozenset[str]]:
    """The scaling, and which factors of it are stand-ins for what is not told."""
    for filled, lacks in (
        (override, frozenset[str]()),
        (replace(override, rated_torque_nm=override.rated_torque_nm or 1.0), frozenset({"torque"})),
        (
            replace(override, position_rad=override.position_rad or 1.0),
            frozenset({"position", "velocity", "acceleration"}),
        ),
        (
            replace(override, rated_torque_nm=1.0, position_rad=1.0),
            frozenset({"torque", "position", "velocity", "acceleration"}),
        ),
    ):
        try:
            scaling = scaling_from(values, filled)
        except PeerFault:
            continue
        independent = {name for name in lacks if scaling.sources.get(name, "").startswith(("60A9h", "60AAh"))}
        return scaling, frozenset(lacks - independent)
    return None, frozenset({"torque", "position", "velocity", "acceleration"})
