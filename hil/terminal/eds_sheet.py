"""What ``hil eds --plan`` adds to a data sheet: the PDO plan of a mode and its budget."""

from typing import NamedTuple

from drivers.canopen.pdo_budget import Budget, budget_of
from drivers.cia402.pdo_planner import PlanImpossible, PlanResult, PlanWish, plan_pdos
from drivers.cia402.profile import Mode
from drivers.sheets.capability import capability_of
from drivers.sheets.dictionary import LoadedDictionary
from drivers.sheets.fitness import Fitness
from drivers.timebase import NS_PER_US, Duration

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
