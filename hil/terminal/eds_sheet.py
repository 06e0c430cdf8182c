"""The data sheet for ``hil eds``: the drive's units, the PDO plan of a mode, and all as JSON."""

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, NamedTuple

from servobench.drivers.canopen.objects301 import MANUFACTURER
from servobench.drivers.canopen.pdo import PdoMap, mapping_text
from servobench.drivers.canopen.pdo_budget import Budget, budget_of, content_of
from servobench.drivers.canopen.pdo_capability import PdoSlot
from servobench.drivers.cia402.judgement import ModeFitness
from servobench.drivers.cia402.pdo_planner import PlanImpossible, PlanResult, plan_pdos
from servobench.drivers.cia402.pdo_plans import PlanWish
from servobench.drivers.cia402.profile import BENCH_MODES, Mode
from servobench.drivers.cia402.quirky_units import apply_quirks
from servobench.drivers.cia402.scaling import FACTOR_OBJECTS, ScaleOverride, Scaling, scaling_from
from servobench.drivers.errors import PeerFault
from servobench.drivers.sheets.dictionary import LoadedDictionary, held
from servobench.drivers.sheets.eds.sections import section_name
from servobench.drivers.sheets.fitness import FileIdentity, Fitness, told_by_sheet
from servobench.drivers.timebase import NS_PER_US, Duration
from servobench.drivers.vendors.families import quirks_for

MODES = BENCH_MODES | {
    "pt": Mode.PROFILE_TORQUE,
    "pv": Mode.PROFILE_VELOCITY,
    "pp": Mode.PROFILE_POSITION,
}


def run_key(fitness: ModeFitness) -> str | None:
    """Return the ``mode`` of a bench file by which `hil run` commands it; None if it cannot."""
    keys = (key for key, mode in BENCH_MODES.items() if mode is fitness.mode)
    return next(keys, None) if fitness.plan is not None else None


class Planned(NamedTuple):
    """A mode's plan, or the reason why there is none."""

    mode: str
    result: PlanResult | None
    budget: Budget | None
    reason: str = ""


def plan_for(
    loaded: LoadedDictionary, fitness: Fitness, node_id: int, mode: str | None, period_us: int, bitrate: int
) -> Planned | None:
    """Plan a mode, or the best one that the drive has; None if it has none at all."""
    chosen = MODES[mode] if mode is not None else fitness.best.mode if fitness.best is not None else None
    if chosen is None:
        return None
    try:
        told = told_by_sheet(loaded)
        result = plan_pdos(told.capability, node_id, PlanWish(chosen, stamp=told.stamp))
    except PlanImpossible as error:
        return Planned(chosen.title, None, None, error.evidence or error.summary)
    budget = budget_of([result.plan], Duration(period_us * NS_PER_US), bitrate)
    return Planned(chosen.title, result, budget)


_UNITS = (
    ("position", "position_rad", "rad"),
    ("velocity", "velocity_rad_s", "rad/s"),
    ("acceleration", "acceleration_rad_s2", "rad/s^2"),
    ("torque", "torque_nm", "N m"),
)
"""Quantity, field of the scaling, unit."""
_MOTION = frozenset({"position", "velocity", "acceleration"})


class UnitLine(NamedTuple):
    """One factor; ``value`` None if the file does not define it."""

    name: str
    value: float | None
    unit: str
    source: str


def unit_lines(loaded: LoadedDictionary, fitness: Fitness) -> tuple[tuple[UnitLine, ...], tuple[str, ...]]:
    """Return each raw unit in SI, by the defaults or parameter values of the file; and known facts about the
    make."""
    dictionary, identity = loaded.dictionary, fitness.identity

    def read(index: int, sub: int) -> int | None:
        value = held(dictionary, index, sub)
        return value if isinstance(value, int) else None

    name = identity.device_name or identity.product_name
    quirks = quirks_for(identity.vendor or 0, identity.product or 0, name)
    known = apply_quirks(quirks, {key: read(*key) for key in FACTOR_OBJECTS}, ScaleOverride(), read)
    scaling, missing = _as_far_as_told(known.values, known.override)
    lines = []
    for quantity, field, unit in _UNITS:
        if scaling is None or quantity in missing:
            lines.append(UnitLine(quantity, None, unit, "not told"))
            continue
        sources = {**scaling.sources, **known.sources}
        lines.append(UnitLine(quantity, getattr(scaling, field), unit, sources.get(quantity, "not told")))
    return tuple(lines), known.notes


def _as_far_as_told(
    values: dict[tuple[int, int], int | None], override: ScaleOverride
) -> tuple[Scaling | None, frozenset[str]]:
    """Return the scaling, and the factors replaced by stand-ins because the file does not define them."""
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


def sheet(file: Path, loaded: LoadedDictionary, fitness: Fitness, planned: Planned | None) -> dict[str, Any]:
    """Return the data for ``hil eds --json``."""
    figures: dict[str, Any] = {
        "file": str(file),
        "serves": fitness.serves,
        "obstacles": list(fitness.obstacles),
        "remarks": list(fitness.remarks),
        "kind": loaded.kind,
        "node_id": loaded.dictionary.node_id,
        "identity": _identity(fitness.identity),
        "profile": fitness.profile,
        "axes": fitness.axes,
        "modes": [mode.title for mode in fitness.modes],
        "modes_told_by": fitness.modes_told_by,
        "conditions": list(fitness.conditions),
        "usable_modes": [
            {
                "mode": each.mode.title,
                "pdo_plan": each.plan is not None,
                "commission": each.plan is not None and fitness.serves,
                "run": run_key(each) if fitness.serves else None,
                "reason": each.reason,
            }
            for each in fitness.usable
        ],
        "pdos": [_pdo(pdo) for pdo in fitness.pdos],
        "missing": [
            {"index": f"{lack.index:04X}h", "name": lack.name, "consequence": lack.consequence}
            for lack in fitness.lacks
        ],
        "units": [line._asdict() for line in unit_lines(loaded, fitness)[0]],
        "repairs": [repair._asdict() for repair in loaded.repairs],
        "objects": _counts(loaded),
        "file_information": asdict(loaded.file),
        "device_information": asdict(loaded.device),
        "commissioning": None if loaded.commissioning is None else asdict(loaded.commissioning),
        "denotations": {
            section_name(entry.index, entry.sub): entry.denotation
            for described in loaded.objects.values()
            for entry in described.entries.values()
            if entry.denotation
        },
    }
    if planned is not None:
        figures["plan"] = _plan(planned)
    return figures


def _identity(identity: FileIdentity) -> dict[str, Any]:
    numbers = {
        name: None if value is None else f"0x{value:08X}"
        for name, value in (
            ("vendor_id", identity.vendor),
            ("product_code", identity.product),
            ("revision", identity.revision),
            ("device_type", identity.device_type),
        )
    }
    texts = ("vendor_name", "product_name", "order_code", "device_name")
    return {**{name: getattr(identity, name) for name in texts}, **numbers}


def _pdo(pdo: PdoSlot) -> dict[str, Any]:
    return {
        "name": pdo.name,
        "cob_id": None if pdo.identifier is None else f"0x{pdo.identifier:03X}",
        "valid": pdo.valid,
        "transmission_type": pdo.transmission_type,
        "inhibit_time_us": None if pdo.inhibit_time is None else pdo.inhibit_time * 100,
        "event_timer_ms": pdo.event_timer,
        "mapping": mapping_text(pdo.mapping).split(),
        "mapping_writable": pdo.mapping_writable,
        "entries_max": pdo.entries_max,
    }


def _counts(loaded: LoadedDictionary) -> dict[str, int]:
    indices = list(loaded.objects)
    return {
        "total": len(indices),
        "communication": sum(index < 0x2000 for index in indices),
        "manufacturer": sum(index in MANUFACTURER for index in indices),
        "profile": sum(index >= 0x6000 for index in indices),
        "entries": sum(len(described.entries) for described in loaded.objects.values()),
    }


def _plan(planned: Planned) -> dict[str, Any]:
    if planned.result is None or planned.budget is None:
        return {"mode": planned.mode, "possible": False, "reason": planned.reason}
    plan = planned.result.plan
    return {
        "mode": planned.mode,
        "possible": True,
        "notes": list(planned.result.notes),
        "pdos": [_mapped(pdo) for pdo in plan],
        "budget": _budget(planned.budget),
    }


def _mapped(pdo: PdoMap) -> dict[str, Any]:
    return {
        "name": pdo.name,
        "cob_id": f"0x{pdo.cob_id:03X}",
        "transmission_type": pdo.transmission_type,
        "mapping": content_of(pdo).split(),
        "bits": pdo.bits,
    }


def _budget(budget: Budget) -> dict[str, Any]:
    return {
        "period_us": budget.period_ns / 1e3,
        "bitrate_bit_s": budget.bitrate_bit_s,
        "frames": [
            {
                "name": line.name,
                "cob_id": f"0x{line.cob_id:03X}",
                "data_bytes": line.data_bytes,
                "bits_max": line.bits_max,
                "time_us": line.time_ns / 1e3,
                "a_cycle": line.a_cycle,
            }
            for line in budget.lines
        ],
        "busy_us": budget.busy_ns / 1e3,
        "load_percent": budget.load_percent,
        "fullest_cycle_percent": budget.fullest_cycle_percent,
        "shortest_period_us": budget.shortest_period_ns / 1e3,
        "sdo_transfers_a_s": budget.sdo_transfers_a_s,
    }
