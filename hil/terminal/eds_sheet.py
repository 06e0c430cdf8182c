"""What ``hil eds`` makes of a data sheet: the units of the drive, and the PDO plan of a mode."""

from dataclasses import replace
from typing import NamedTuple

from drivers.canopen.pdo_budget import Budget, budget_of
from drivers.cia402.pdo_planner import PlanImpossible, PlanResult, PlanWish, plan_pdos
from drivers.cia402.profile import Mode
from drivers.cia402.quirky_units import apply_quirks
from drivers.cia402.scaling import FACTOR_OBJECTS, ScaleOverride, Scaling, scaling_from
from drivers.errors import PeerFault
from drivers.sheets.capability import capability_of
from drivers.sheets.dictionary import LoadedDictionary, held
from drivers.sheets.fitness import Fitness
from drivers.timebase import NS_PER_US, Duration
from drivers.vendors.families import quirks_for

MODES = {
    "cst": Mode.CYCLIC_SYNCHRONOUS_TORQUE,
    "csv": Mode.CYCLIC_SYNCHRONOUS_VELOCITY,
    "csp": Mode.CYCLIC_SYNCHRONOUS_POSITION,
    "pt": Mode.PROFILE_TORQUE,
    "pv": Mode.PROFILE_VELOCITY,
    "pp": Mode.PROFILE_POSITION,
}


class Planned(NamedTuple):
    """A mode's plan, or why there is none."""

    mode: str
    result: PlanResult | None
    budget: Budget | None
    reason: str = ""


def plan_for(
    loaded: LoadedDictionary, fitness: Fitness, node_id: int, mode: str | None, period_us: int, bitrate: int
) -> Planned | None:
    """The plan for a mode, or for the best that the drive has; None if it has none at all."""
    wanted = MODES[mode] if mode is not None else fitness.best.mode if fitness.best is not None else None
    if wanted is None:
        return None
    try:
        result = plan_pdos(capability_of(loaded), node_id, PlanWish(wanted))
    except PlanImpossible as error:
        return Planned(wanted.title, None, None, error.evidence or error.summary)
    budget = budget_of([result.plan], Duration(period_us * NS_PER_US), bitrate)
    return Planned(wanted.title, result, budget)


_UNITS = (
    ("position", "position_rad", "rad"),
    ("velocity", "velocity_rad_s", "rad/s"),
    ("acceleration", "acceleration_rad_s2", "rad/s^2"),
    ("torque", "torque_nm", "N m"),
)
"""Quantity, field of the scaling, unit."""
_MOTION = frozenset({"position", "velocity", "acceleration"})


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
    told = {} if scaling is None else {name: getattr(scaling, field) for name, field, _ in _UNITS}
    sources = {} if scaling is None else {**scaling.sources, **known.sources}
    lines = []
    for quantity, _, unit in _UNITS:
        there = quantity in told and quantity not in missing
        source = sources.get(quantity, "not told") if quantity not in missing else "not told"
        lines.append(UnitLine(quantity, told[quantity] if there else None, unit, source))
    return tuple(lines), known.notes


def _as_far_as_told(
    values: dict[tuple[int, int], int | None], override: ScaleOverride
) -> tuple[Scaling | None, frozenset[str]]:
    """The scaling, and which factors of it are stand-ins for what is not told."""
    rated_nm, position_rad = override.rated_torque_nm or 1.0, override.position_rad or 1.0
    for filled, lacks in (
        (override, frozenset[str]()),
        (replace(override, rated_torque_nm=rated_nm), frozenset({"torque"})),
        (replace(override, position_rad=position_rad), _MOTION),
        (replace(override, rated_torque_nm=1.0, position_rad=1.0), _MOTION | {"torque"}),
    ):
        try:
            scaling = scaling_from(values, filled)
        except PeerFault:
            continue
        independent = {name for name in lacks if scaling.sources.get(name, "").startswith(("60A9h", "60AAh"))}
        return scaling, frozenset(lacks - independent)
    return None, _MOTION | {"torque"}
