"""Basis of a run's timing, for its summary: clocks, placed readings, SYNCs, and contradictions."""

from collections.abc import Mapping, Sequence
from typing import Any

from servobench.drivers.timebase import NS_PER_US, Duration
from servobench.hil.loop.attribution import Health
from servobench.hil.loop.axis import Axis
from servobench.hil.loop.syncs import SyncLog

Report = dict[str, Any]


def timing_report(
    axes: Sequence[Axis], syncs: Mapping[str, SyncLog], others: Mapping[str, int] | None = None
) -> Report:
    """Return the report. ``syncs``: by segment. ``others``: observations of the bus guard with counts, which
    may still grow. Times in us."""
    return {
        "sync": {
            name: {"basis": log.basis.value, "surplus": log.surplus, "crowded": log.crowded}
            for name, log in syncs.items()
        },
        "axes": {axis.parts.name: _axis_report(axis) for axis in axes},
        "others": {} if others is None else others,
    }


def distrust(axes: Sequence[Axis], period: Duration) -> tuple[str, ...]:
    """Explain why a run's timing is not trustworthy; empty if it is."""
    reasons: list[str] = []
    for axis in axes:
        stamped = axis.by_stamp.health
        doubts = _doubts(stamped) + _doubts(axis.by_order.health)
        if stamped.stamp_error_ns_max > period // 2:
            error_us = stamped.stamp_error_ns_max / NS_PER_US
            doubts.append(f"a sampling instant is known to {error_us:.0f} us only, more than half a period")
        reasons += [f"{axis.parts.name}: {doubt}" for doubt in doubts]
    return tuple(reasons)


def _doubts(health: Health) -> list[str]:
    doubts = []
    if health.below_transit:
        doubts.append(f"{health.below_transit} readings came sooner than their frame takes on the wire")
    if health.before_sync:
        doubts.append(f"{health.before_sync} readings came before their SYNC")
    if health.two_stamps:
        doubts.append(f"{health.two_stamps} SYNCs have two different stamps")
    return doubts


def _axis_report(axis: Axis) -> Report:
    clock = axis.by_stamp.clock
    stamped, ordered = axis.by_stamp.health, axis.by_order.health
    report: Report = {
        "placed": stamped.placed + ordered.placed,
        "by_order": ordered.placed,
        "uncertain": axis.uncertain,
        "duplicates": stamped.duplicates + ordered.duplicates,
        "unmatched": stamped.unmatched + ordered.unmatched + axis.meter.unmatched,
        "error_us_max": max(stamped.error_ns_max, ordered.error_ns_max) / NS_PER_US,
        "clock_steps": stamped.steps,
    }
    if clock.ready:
        report["clock"] = {
            "offset_us": clock.offset_ns / NS_PER_US,
            "error_us": clock.error_ns / NS_PER_US,
            "drift_ppm": clock.drift_ppm,
            "drift_error_ppm": clock.drift_error_ppm,
        }
    report["commands_unexplained"] = axis.commands.unexplained
    report["readbacks_unordered"] = axis.readbacks.unordered
    return report
