"""Fault plans as TOML: arrays of tables, one array for each kind of fault.

    [[loss]]            probability
    [[burst]]           p_good_to_bad, p_bad_to_good, loss_bad = 1, loss_good = 0
    [[periodic_loss]]   lost
    [[blackout]]        duration_s or until_s, or count
    [[delay]]           delay_us, or delay_min_us and delay_max_us; reorder = false
    [[measured_delay]]  edges_us and counts, or file; reorder = false
    [[reorder]]         probability; held_us, or held_min_us and held_max_us
    [[duplicate]]       probability, later_us = 0
    [[corruption]]      probability, effect = "error_frame", "lost" or "data"

Every table may also hold direction ("host_to_drive", "drive_to_host"; "both" if left out), frames
(["pdo"] if left out), nodes, from_s, until_s and side ("host", "drive"). What they mean:
:mod:`virtual_bus.faults.fault_plan`. What befalls nodes:
:mod:`virtual_bus.faults.node_fault_toml`.
"""

import difflib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from drivers.errors import MISSING, BadInput
from drivers.key_advice import unknown_key
from drivers.timebase import NS_PER_S, NS_PER_US, Duration
from virtual_bus.faults.delay_histogram import read_histogram
from virtual_bus.faults.fault_plan import (
    Blackout,
    BurstLoss,
    Corruption,
    Direction,
    Duplication,
    Effect,
    Fault,
    FaultPlan,
    FrameClass,
    IndependentLoss,
    MeasuredDelay,
    PeriodicLoss,
    Reordering,
    Selection,
    Side,
    UniformDelay,
)
from virtual_bus.faults.node_fault_plan import HostStall, NodeFault
from virtual_bus.faults.node_fault_toml import (
    HOST_STALL_KEYS,
    NODE_KINDS,
    host_stall,
    host_stall_mapping,
    node_fault_mapping,
)
from virtual_bus.faults.plan_checks import require
from virtual_bus.faults.toml_values import (
    Table,
    fixed_or_range,
    integer,
    is_integer,
    is_number,
    nanoseconds,
    nodes,
    number,
    one_of,
    range_keys,
    short,
    time_ns,
    time_s,
    truth,
)

_COMMON = ("direction", "frames", "nodes", "from_s", "until_s", "side")
_SIDES: dict[str, Side] = {"host": "host", "drive": "drive"}
_DIRECTIONS = {"both": tuple(Direction), **{way.label: (way,) for way in Direction}}
_EFFECTS = {effect.value: effect for effect in Effect}


def load_fault_plan(mapping: Mapping[str, Any], source: str, prefix: str = "") -> FaultPlan:
    """The plan in ``mapping``, read from the file ``source`` (there under the table ``prefix``).

    Raises :class:`BadInput`, the first of what :func:`read_fault_plan` finds.
    """
    plan, errors = read_fault_plan(mapping, source, prefix)
    if errors:
        raise errors[0]
    return plan


def read_fault_plan(
    mapping: Mapping[str, Any], source: str, prefix: str = ""
) -> tuple[FaultPlan, list[BadInput]]:
    """As :func:`load_fault_plan`, but with all errors; the plan then holds the faults that could be read."""
    found = _PlanSoFar([], [], [], [])
    known = (*_KINDS, *NODE_KINDS, HostStall.kind)
    for kind, tables in mapping.items():
        path = f"{prefix}.{kind}" if prefix else kind
        if kind not in known:
            found.errors.append(unknown_key(source, path, short(tables), known))
        elif not isinstance(tables, list) or not all(isinstance(table, Mapping) for table in tables):
            expected = f"an array of tables, each headed [[{path}]]"
            found.errors.append(BadInput(source, path, short(tables), expected))
        else:
            for index, table in enumerate(tables):
                _read_fault(kind, table, source, f"{path}[{index}]", found)
    return FaultPlan(tuple(found.faults), tuple(found.node_faults), tuple(found.host_stalls)), found.errors


def fault_plan_mapping(plan: FaultPlan) -> dict[str, list[dict[str, Any]]]:
    """``plan`` as :func:`load_fault_plan` takes it, to be written beside a run."""
    mapping: dict[str, list[dict[str, Any]]] = {}
    for fault in plan.faults:
        table = {**_selection_mapping(fault.selection), **_own_mapping(fault)}
        mapping.setdefault(fault.kind, []).append(table)
    for node_fault in plan.node_faults:
        mapping.setdefault(node_fault.kind, []).append(node_fault_mapping(node_fault))
    for stall in plan.host_stalls:
        mapping.setdefault(stall.kind, []).append(host_stall_mapping(stall))
    return mapping


class _PlanSoFar(NamedTuple):
    """What has been read so far."""

    faults: list[Fault]
    node_faults: list[NodeFault]
    host_stalls: list[HostStall]
    errors: list[BadInput]


def _read_fault(kind: str, table: Table, source: str, path: str, found: _PlanSoFar) -> None:
    keys: tuple[str, ...] = HOST_STALL_KEYS
    if kind in _KINDS:
        keys = (*_KINDS[kind][0], *_COMMON)
    elif kind in NODE_KINDS:
        keys = (*NODE_KINDS[kind][0], "nodes")
    unknown = [
        unknown_key(source, f"{path}.{key}", short(value), keys)
        for key, value in table.items()
        if key not in keys
    ]
    if unknown:
        found.errors.extend(unknown)
        return
    try:
        if kind in _KINDS:
            found.faults.append(_KINDS[kind][1](_with_histogram(table, source) if "file" in table else table))
        elif kind in NODE_KINDS:
            found.node_faults.append(NODE_KINDS[kind][1](table))
        else:
            found.host_stalls.append(host_stall(table))
    except BadInput as error:
        key = f"{path}.{error.key}" if error.key else path
        found.errors.append(BadInput(source, key, short(error.value), error.expected, error.remedy))


def _with_histogram(table: Table, source: str) -> Table:
    """``file`` is named from the plan's folder."""
    for key in ("edges_us", "counts"):
        require(key not in table, key, table.get(key), "nothing beside file")
    name = table["file"]
    require(isinstance(name, str), "file", name, "the path of a histogram in quotes")
    edges, counts = read_histogram(Path(source).parent / name)
    return {**table, "edges_us": edges, "counts": counts}


def _loss(table: Table) -> Fault:
    return IndependentLoss(selection=_selection(table), probability=number(table, "probability"))


def _burst(table: Table) -> Fault:
    return BurstLoss(
        selection=_selection(table),
        p_good_to_bad=number(table, "p_good_to_bad"),
        p_bad_to_good=number(table, "p_bad_to_good"),
        loss_bad=number(table, "loss_bad", 1.0),
        loss_good=number(table, "loss_good", 0.0),
    )


def _periodic_loss(table: Table) -> Fault:
    return PeriodicLoss(selection=_selection(table), lost=integer(table, "lost"))


def _blackout(table: Table) -> Fault:
    clash = "duration_s" in table and "until_s" in table
    require(not clash, "until_s", table.get("until_s"), "nothing beside duration_s")
    if "duration_s" in table:
        length = time_s(table, "duration_s")
        require(length > 0, "duration_s", table["duration_s"], "a time > 0")
        table = {**table, "until_s": time_s(table, "from_s", 0.0) + length}
    return Blackout(selection=_selection(table), count=integer(table, "count") if "count" in table else None)


def _delay(table: Table) -> Fault:
    least, most = fixed_or_range(table, "delay", "us", "delay")
    reorder = truth(table, "reorder")
    return UniformDelay(selection=_selection(table), min_ns=least, max_ns=most, reorder=reorder)


def _measured_delay(table: Table) -> Fault:
    edges, counts = table.get("edges_us", MISSING), table.get("counts", MISSING)
    lists = "a list of times, or file instead"
    require(isinstance(edges, list), "edges_us", edges, lists)
    require(isinstance(counts, list) and all(map(is_integer, counts)), "counts", counts, "whole numbers")
    for edge in edges:
        require(is_number(edge), "edges_us", edge, "numbers")
    return MeasuredDelay(
        selection=_selection(table),
        edges_ns=tuple(Duration(round(edge * NS_PER_US)) for edge in edges),
        counts=tuple(counts),
        reorder=truth(table, "reorder"),
    )


def _reorder(table: Table) -> Fault:
    least, most = fixed_or_range(table, "held", "us", "time")
    probability = number(table, "probability")
    return Reordering(selection=_selection(table), probability=probability, min_ns=least, max_ns=most)


def _duplicate(table: Table) -> Fault:
    later = time_ns(table, "later_us", 0.0)
    return Duplication(selection=_selection(table), probability=number(table, "probability"), later_ns=later)


def _corruption(table: Table) -> Fault:
    effect = one_of(table, "effect", _EFFECTS, Effect.ERROR_FRAME.value)
    return Corruption(selection=_selection(table), probability=number(table, "probability"), effect=effect)


_KINDS: dict[str, tuple[tuple[str, ...], Callable[[Table], Fault]]] = {
    "loss": (("probability",), _loss),
    "burst": (("p_good_to_bad", "p_bad_to_good", "loss_bad", "loss_good"), _burst),
    "periodic_loss": (("lost",), _periodic_loss),
    "blackout": (("duration_s", "count"), _blackout),
    "delay": ((*range_keys("delay", "us"), "reorder"), _delay),
    "measured_delay": (("edges_us", "counts", "file", "reorder"), _measured_delay),
    "reorder": (("probability", *range_keys("held", "us")), _reorder),
    "duplicate": (("probability", "later_us"), _duplicate),
    "corruption": (("probability", "effect"), _corruption),
}
"""Table -> the keys that are its own, and what makes a fault of it."""


def _selection(table: Table) -> Selection:
    return Selection(
        directions=one_of(table, "direction", _DIRECTIONS, "both"),
        frames=_frames(table.get("frames", [FrameClass.PDO.value])),
        nodes=nodes(table),
        from_ns=nanoseconds(time_s(table, "from_s", 0.0)),
        until_ns=nanoseconds(time_s(table, "until_s")) if "until_s" in table else None,
        side=one_of(table, "side", _SIDES) if "side" in table else None,
    )


def _frames(given: Any) -> tuple[FrameClass | int, ...]:
    classes = {item.value: item for item in FrameClass}
    require(isinstance(given, list), "frames", given, 'a list, such as ["pdo", "sync"] or [0x181]')
    found: list[FrameClass | int] = []
    for item in given:
        if isinstance(item, str) and item not in classes:
            near = difflib.get_close_matches(item, classes, n=1)
            expected = f'"{near[0]}", the nearest' if near else "a class of frames"
            raise BadInput(
                "", "frames", item, expected, f"classes: {', '.join(classes)}; or a COB-ID as a number"
            )
        require(isinstance(item, str) or is_integer(item), "frames", item, "a class of frames or a COB-ID")
        found.append(classes[item] if isinstance(item, str) else item)
    return tuple(found)


def _selection_mapping(selection: Selection) -> dict[str, Any]:
    names = {ways: name for name, ways in _DIRECTIONS.items()}
    table: dict[str, Any] = {
        "direction": names[tuple(sorted(set(selection.directions)))],
        "frames": [item if isinstance(item, int) else item.value for item in selection.frames],
        "from_s": selection.from_ns / NS_PER_S,
    }
    if selection.nodes:
        table["nodes"] = list(selection.nodes)
    if selection.until_ns is not None:
        table["until_s"] = selection.until_ns / NS_PER_S
    if selection.side is not None:
        table["side"] = selection.side
    return table


def _own_mapping(fault: Fault) -> dict[str, Any]:
    if isinstance(fault, UniformDelay):
        least, most = fault.min_ns / NS_PER_US, fault.max_ns / NS_PER_US
        return {"delay_min_us": least, "delay_max_us": most, "reorder": fault.reorder}
    if isinstance(fault, MeasuredDelay):
        edges = [edge / NS_PER_US for edge in fault.edges_ns]
        return {"edges_us": edges, "counts": list(fault.counts), "reorder": fault.reorder}
    if isinstance(fault, Blackout):
        return {} if fault.count is None else {"count": fault.count}
    if isinstance(fault, Reordering):
        least, most = fault.min_ns / NS_PER_US, fault.max_ns / NS_PER_US
        return {"probability": fault.probability, "held_min_us": least, "held_max_us": most}
    if isinstance(fault, Duplication):
        return {"probability": fault.probability, "later_us": fault.later_ns / NS_PER_US}
    if isinstance(fault, Corruption):
        return {"probability": fault.probability, "effect": fault.effect.value}
    return {key: getattr(fault, key) for key in _KINDS[fault.kind][0]}
