"""Faults of nodes as TOML, the other half of :mod:`virtual_bus.faults.fault_plan_toml`.

    [[silence]]      duration_s                                      when
    [[bus_off]]      recover_after_s (never, if left out)            when
    [[drive_fault]]  fault = "over_current", "over_temperature",     when
                     "following_error", "encoder_loss" or "under_voltage";
                     of encoder_loss: detected_after_ms = 2, duration_s = 0.1
    [[clock_step]]   step_us, or step_min_us and step_max_us         when
    [[clock_drift]]  drift_ppm; from_s, until_s
    [[slow_drive]]   sdo_delay_us, tpdo_delay_us, boot_s, or a _min and _max of each
    [[host_stall]]   late_us, or late_min_us and late_max_us         when

``when``: at_s, or every_s or probability_per_s with from_s and until_s. Every table but the host's may hold
nodes.
"""

from collections.abc import Callable
from typing import Any

from drivers.timebase import NS_PER_MS, NS_PER_S, NS_PER_US
from virtual_bus.faults.node_fault_plan import (
    BusOff,
    ClockDrift,
    ClockStep,
    DriveFailure,
    DriveFault,
    EventFault,
    HostStall,
    NodeFault,
    Occasion,
    Range,
    Silence,
    SlowDrive,
)
from virtual_bus.faults.toml_values import (
    Table,
    fixed_or_range,
    nanoseconds,
    nodes,
    number,
    one_of,
    range_keys,
    time_ns,
    time_s,
)

_WINDOW = ("from_s", "until_s")
_WHEN = ("at_s", "every_s", "probability_per_s", *_WINDOW)
_FAILURES = {failure.label: failure for failure in DriveFailure}
_SLOW = (("sdo", "sdo_delay", "us"), ("tpdo", "tpdo_delay", "us"), ("boot", "boot", "s"))


def _occasion(table: Table) -> Occasion:
    until = nanoseconds(time_s(table, "until_s")) if "until_s" in table else None
    from_ns = nanoseconds(time_s(table, "from_s", 0.0))
    probability = number(table, "probability_per_s", 0.0)
    at_ns = nanoseconds(time_s(table, "at_s")) if "at_s" in table else None
    every_ns = nanoseconds(time_s(table, "every_s")) if "every_s" in table else None
    return Occasion(
        at_ns=at_ns, every_ns=every_ns, probability_per_s=probability, from_ns=from_ns, until_ns=until
    )


def _silence(table: Table) -> NodeFault:
    lasts = nanoseconds(time_s(table, "duration_s"))
    return Silence(nodes=nodes(table), occasion=_occasion(table), lasts_ns=lasts)


def _bus_off(table: Table) -> NodeFault:
    recover = nanoseconds(time_s(table, "recover_after_s")) if "recover_after_s" in table else None
    return BusOff(nodes=nodes(table), occasion=_occasion(table), recover_after_ns=recover)


def _drive_fault(table: Table) -> NodeFault:
    failure = one_of(table, "fault", _FAILURES)
    lost = failure is DriveFailure.ENCODER_LOSS
    return DriveFault(
        nodes=nodes(table),
        occasion=_occasion(table),
        failure=failure,
        detected_after_ns=time_ns(table, "detected_after_ms", 2.0 if lost else 0.0),
        lasts_ns=nanoseconds(time_s(table, "duration_s", 0.1 if lost else 0.0)),
    )


def _clock_step(table: Table) -> NodeFault:
    least, most = fixed_or_range(table, "step", "us", "step")
    return ClockStep(nodes=nodes(table), occasion=_occasion(table), min_ns=least, max_ns=most)


def _clock_drift(table: Table) -> NodeFault:
    return ClockDrift(
        nodes=nodes(table),
        from_ns=nanoseconds(time_s(table, "from_s", 0.0)),
        until_ns=nanoseconds(time_s(table, "until_s")) if "until_s" in table else None,
        drift_ppb=round(number(table, "drift_ppm") * 1000),
    )


def _slow_drive(table: Table) -> NodeFault:
    parts = {
        name: Range(*fixed_or_range(table, stem, unit, "time"))
        for name, stem, unit in _SLOW
        if any(key in table for key in range_keys(stem, unit))
    }
    return SlowDrive(nodes=nodes(table), **parts)


def host_stall(table: Table) -> HostStall:
    """The stall of a table."""
    least, most = fixed_or_range(table, "late", "us", "time")
    return HostStall(occasion=_occasion(table), min_ns=least, max_ns=most)


HOST_STALL_KEYS = (*range_keys("late", "us"), *_WHEN)
"""What its table may hold."""

NODE_KINDS: dict[str, tuple[tuple[str, ...], Callable[[Table], NodeFault]]] = {
    "silence": (("duration_s", *_WHEN), _silence),
    "bus_off": (("recover_after_s", *_WHEN), _bus_off),
    "drive_fault": (("fault", "detected_after_ms", "duration_s", *_WHEN), _drive_fault),
    "clock_step": ((*range_keys("step", "us"), *_WHEN), _clock_step),
    "clock_drift": (("drift_ppm", *_WINDOW), _clock_drift),
    "slow_drive": (tuple(key for _, stem, unit in _SLOW for key in range_keys(stem, unit)), _slow_drive),
}
"""Table -> the keys that it may hold beside ``nodes``, and what makes a fault of it."""


def node_fault_mapping(fault: NodeFault) -> dict[str, Any]:
    """``fault`` as its table."""
    table: dict[str, Any] = {"nodes": list(fault.nodes)} if fault.nodes else {}
    if isinstance(fault, SlowDrive):
        return {**table, **_slow_mapping(fault)}
    if isinstance(fault, ClockDrift):
        table |= {"drift_ppm": fault.drift_ppb / 1000, "from_s": fault.from_ns / NS_PER_S}
        return table | ({} if fault.until_ns is None else {"until_s": fault.until_ns / NS_PER_S})
    return {**table, **_occasion_mapping(fault.occasion), **_event_mapping(fault)}


def host_stall_mapping(stall: HostStall) -> dict[str, Any]:
    """``stall`` as its table."""
    late = {"late_min_us": stall.min_ns / NS_PER_US, "late_max_us": stall.max_ns / NS_PER_US}
    return {**_occasion_mapping(stall.occasion), **late}


def _slow_mapping(fault: SlowDrive) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for part, (_, stem, unit) in zip((fault.sdo, fault.tpdo, fault.boot), _SLOW, strict=True):
        if part.max_ns > 0:
            scale = NS_PER_S if unit == "s" else NS_PER_US
            found |= {f"{stem}_min_{unit}": part.min_ns / scale, f"{stem}_max_{unit}": part.max_ns / scale}
    return found


def _occasion_mapping(occasion: Occasion) -> dict[str, Any]:
    if occasion.at_ns is not None:
        return {"at_s": occasion.at_ns / NS_PER_S}
    found = {"from_s": occasion.from_ns / NS_PER_S}
    if occasion.every_ns is not None:
        found["every_s"] = occasion.every_ns / NS_PER_S
    else:
        found["probability_per_s"] = occasion.probability_per_s
    return found if occasion.until_ns is None else {**found, "until_s": occasion.until_ns / NS_PER_S}


def _event_mapping(fault: EventFault) -> dict[str, Any]:
    if isinstance(fault, Silence):
        return {"duration_s": fault.lasts_ns / NS_PER_S}
    if isinstance(fault, BusOff):
        after = fault.recover_after_ns
        return {} if after is None else {"recover_after_s": after / NS_PER_S}
    if isinstance(fault, ClockStep):
        return {"step_min_us": fault.min_ns / NS_PER_US, "step_max_us": fault.max_ns / NS_PER_US}
    table: dict[str, Any] = {"fault": fault.failure.label}
    if fault.failure is DriveFailure.ENCODER_LOSS:
        table["detected_after_ms"] = fault.detected_after_ns / NS_PER_MS
        table["duration_s"] = fault.lasts_ns / NS_PER_S
    return table
