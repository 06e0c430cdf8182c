"""Fault plans as TOML: arrays of tables, one array for each kind of fault.

    [[loss]]           probability
    [[burst]]          p_good_to_bad, p_bad_to_good, loss_bad = 1, loss_good = 0
    [[periodic_loss]]  lost
    [[blackout]]       duration_s or until_s, or count
    [[delay]]          delay_us, or delay_min_us and delay_max_us; reorder = false

Every table may also hold direction ("host_to_drive", "drive_to_host"; "both" if left out), frames
(["pdo"] if left out), nodes, from_s and until_s. What they mean:
:mod:`virtual_bus.fault_injection.fault_plan`.
"""

import difflib
import math
from collections.abc import Callable, Mapping
from typing import Any

from drivers.errors import MISSING, BadInput
from drivers.timebase import NS_PER_S, NS_PER_US, Duration
from virtual_bus.fault_injection.fault_plan import (
    Blackout,
    BurstLoss,
    Direction,
    Fault,
    FaultPlan,
    FrameClass,
    IndependentLoss,
    PeriodicLoss,
    Selection,
    UniformDelay,
    require,
)
from virtual_bus.fault_injection.key_slips import unknown_key

_COMMON = ("direction", "frames", "nodes", "from_s", "until_s")
_DIRECTIONS = {"both": tuple(Direction), **{way.label: (way,) for way in Direction}}
_TIME_MAX_S = 1e8


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
    faults: list[Fault] = []
    errors: list[BadInput] = []
    for kind, tables in mapping.items():
        path = f"{prefix}.{kind}" if prefix else kind
        if kind not in _KINDS:
            errors.append(unknown_key(source, path, kind, _short(tables), _KINDS))
        elif not isinstance(tables, list) or not all(isinstance(table, Mapping) for table in tables):
            expected = f"an array of tables, each headed [[{path}]]"
            errors.append(BadInput(source, path, _short(tables), expected))
        else:
            for index, table in enumerate(tables):
                _read_fault(kind, table, source, f"{path}[{index}]", faults, errors)
    return FaultPlan(tuple(faults)), errors


def fault_plan_mapping(plan: FaultPlan) -> dict[str, list[dict[str, Any]]]:
    """``plan`` as :func:`load_fault_plan` takes it, to be written beside a run."""
    mapping: dict[str, list[dict[str, Any]]] = {}
    for fault in plan.faults:
        table = {**_selection_mapping(fault.selection), **_own_mapping(fault)}
        mapping.setdefault(fault.kind, []).append(table)
    return mapping


def _read_fault(
    kind: str,
    table: Mapping[str, Any],
    source: str,
    path: str,
    faults: list[Fault],
    errors: list[BadInput],
) -> None:
    keys, build = _KINDS[kind]
    known = (*keys, *_COMMON)
    unknown = [
        unknown_key(source, f"{path}.{key}", key, _short(value), known)
        for key, value in table.items()
        if key not in known
    ]
    if unknown:
        errors.extend(unknown)
        return
    try:
        faults.append(build(table))
    except BadInput as error:
        key = f"{path}.{error.key}" if error.key else path
        errors.append(BadInput(source, key, _short(error.value), error.expected, error.remedy))


def _loss(table: Mapping[str, Any]) -> Fault:
    return IndependentLoss(selection=_selection(table), probability=_number(table, "probability"))


def _burst(table: Mapping[str, Any]) -> Fault:
    return BurstLoss(
        selection=_selection(table),
        p_good_to_bad=_number(table, "p_good_to_bad"),
        p_bad_to_good=_number(table, "p_bad_to_good"),
        loss_bad=_number(table, "loss_bad", 1.0),
        loss_good=_number(table, "loss_good", 0.0),
    )


def _periodic_loss(table: Mapping[str, Any]) -> Fault:
    return PeriodicLoss(selection=_selection(table), lost=_integer(table, "lost"))


def _blackout(table: Mapping[str, Any]) -> Fault:
    clash = "duration_s" in table and "until_s" in table
    require(not clash, "until_s", table.get("until_s"), "nothing beside duration_s")
    if "duration_s" in table:
        length = _time_s(table, "duration_s")
        require(length > 0, "duration_s", table["duration_s"], "a time > 0")
        table = {**table, "until_s": _time_s(table, "from_s", 0.0) + length}
    return Blackout(selection=_selection(table), count=_integer(table, "count") if "count" in table else None)


def _delay(table: Mapping[str, Any]) -> Fault:
    given = [key for key in ("delay_us", "delay_min_us", "delay_max_us") if key in table]
    require(bool(given), "delay_us", MISSING, "a delay, or delay_min_us and delay_max_us")
    if "delay_us" in given:
        require(len(given) == 1, given[-1], table[given[-1]], "nothing beside delay_us")
        least = most = _delay_ns(table, "delay_us")
    else:
        least, most = _delay_ns(table, "delay_min_us"), _delay_ns(table, "delay_max_us")
    reorder = table.get("reorder", False)
    require(isinstance(reorder, bool), "reorder", reorder, "true or false")
    return UniformDelay(selection=_selection(table), min_ns=least, max_ns=most, reorder=reorder)


_KINDS: dict[str, tuple[tuple[str, ...], Callable[[Mapping[str, Any]], Fault]]] = {
    "loss": (("probability",), _loss),
    "burst": (("p_good_to_bad", "p_bad_to_good", "loss_bad", "loss_good"), _burst),
    "periodic_loss": (("lost",), _periodic_loss),
    "blackout": (("duration_s", "count"), _blackout),
    "delay": (("delay_us", "delay_min_us", "delay_max_us", "reorder"), _delay),
}
"""Table -> the keys that are its own, and what makes a fault of it."""


def _selection(table: Mapping[str, Any]) -> Selection:
    direction = table.get("direction", "both")
    known = isinstance(direction, str) and direction in _DIRECTIONS
    require(known, "direction", direction, f"one of {', '.join(_DIRECTIONS)}")
    nodes = table.get("nodes", [])
    whole = isinstance(nodes, list) and all(_is_integer(node) for node in nodes)
    require(whole, "nodes", nodes, "a list of node ids, such as [1, 2]")
    return Selection(
        directions=_DIRECTIONS[direction],
        frames=_frames(table.get("frames", [FrameClass.PDO.value])),
        nodes=tuple(nodes),
        from_ns=_nanoseconds(_time_s(table, "from_s", 0.0)),
        until_ns=_nanoseconds(_time_s(table, "until_s")) if "until_s" in table else None,
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
        require(isinstance(item, str) or _is_integer(item), "frames", item, "a class of frames or a COB-ID")
        found.append(classes[item] if isinstance(item, str) else item)
    return tuple(found)


def _number(table: Mapping[str, Any], key: str, default: float | None = None) -> float:
    value = table.get(key, MISSING if default is None else default)
    usable = isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
    require(usable, key, value, "a number")
    return float(value)


def _integer(table: Mapping[str, Any], key: str) -> int:
    value = table.get(key, MISSING)
    require(_is_integer(value), key, value, "a whole number")
    return int(value)


def _is_integer(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool)


def _time_s(table: Mapping[str, Any], key: str, default: float | None = None) -> float:
    value = _number(table, key, default)
    require(0.0 <= value <= _TIME_MAX_S, key, value, "a time in seconds, >= 0")
    return value


def _nanoseconds(seconds: float) -> Duration:
    return Duration(round(seconds * NS_PER_S))


def _delay_ns(table: Mapping[str, Any], key: str) -> Duration:
    return Duration(round(_number(table, key) * NS_PER_US))


def _short(value: Any) -> Any:
    """``value``, or a word for what would not fit into a line."""
    if isinstance(value, Mapping):
        return "a table"
    return "a list" if isinstance(value, list) and len(repr(value)) > 60 else value


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
    return table


def _own_mapping(fault: Fault) -> dict[str, Any]:
    if isinstance(fault, UniformDelay):
        least, most = fault.min_ns / NS_PER_US, fault.max_ns / NS_PER_US
        return {"delay_min_us": least, "delay_max_us": most, "reorder": fault.reorder}
    if isinstance(fault, Blackout):
        return {} if fault.count is None else {"count": fault.count}
    return {key: getattr(fault, key) for key in _KINDS[fault.kind][0]}
