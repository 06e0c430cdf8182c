"""The limits of ``[verdict]``: a limit is one entry of :class:`VerdictLimits`.

The keys of the bench file, their bounds, the check against the figure, titles and reference pages follow from
it. Beyond the entry, a limit has a case in tests/pictures/cases.py that breaks it.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Final, Protocol

from servobench.hil.verdict.figures import Figures


class BesideTheRecords(Protocol):
    """Figures that the rows do not hold."""

    @property
    def bus_load_percent(self) -> float | None: ...


@dataclass(frozen=True, slots=True)
class Limited:
    """The figure that a limit is held against."""

    title: str
    """For a reader, with the unit."""
    meaning: str
    """The limit, for the reference pages."""
    value: Callable[[Figures, BesideTheRecords], float | None]
    """None: not measured."""
    bounds: Mapping[str, Any]
    """Bounds of the limit itself (``ge``, ``gt``, ``le``)."""


def _limit(
    title: str,
    meaning: str,
    value: Callable[[Figures, BesideTheRecords], float | None],
    **bounds: float,
) -> Any:
    return field(default=None, metadata={"limited": Limited(title, meaning, value, bounds or {"ge": 0})})


@dataclass(frozen=True, slots=True)
class VerdictLimits:
    """Upper limits for a run; None: not set."""

    speed_error_peak_percent_max: float | None = _limit(
        "speed error, peak [%]",
        "Peak speed error, of the greatest reference.",
        lambda run, _: run.speed_error.peak_percent,
    )
    after_load_percent_max: float | None = _limit(
        "speed error after load step [%]",
        "Peak speed error after a load step, of the reference.",
        lambda run, _: run.speed_error.after_load_percent,
    )
    speed_error_rms_rad_s_max: float | None = _limit(
        "speed error, RMS [rad/s]",
        "RMS of the speed error.",
        lambda run, _: run.speed_error.rms_rad_s,
    )
    dropouts_percent_max: float | None = _limit(
        "dropouts [%]",
        "Cycles without a usable reading: lost, late, stale or missed.",
        lambda run, _: run.dropouts_percent,
        ge=0,
        le=100,
    )
    delay_p99_us_max: float | None = _limit(
        "delay of readings, p99 [us]",
        "Delay of readings, 99 %.",
        lambda run, _: run.reading_delay_us.p99,
        gt=0,
    )
    bus_load_percent_max: float | None = _limit(
        "bus load [%]",
        "Share of the time in which the bus was busy.",
        lambda _, beside: beside.bus_load_percent,
        gt=0,
        le=100,
    )
    missed_percent_max: float | None = _limit(
        "cycles without SYNC [%]",
        "Cycles without SYNC because the host came too late.",
        lambda run, _: run.missed_percent,
        ge=0,
        le=100,
    )
    lateness_us_max: float | None = _limit(
        "lateness, largest [us]",
        "Greatest lateness of the host's wake-up for a cycle.",
        lambda run, _: run.lateness_us.max,
    )
    compute_us_max: float | None = _limit(
        "computing time, largest [us]",
        "Greatest computing time of compensator and controller in a cycle; judged in real time alone.",
        lambda run, _: run.compute_us.max,
        gt=0,
    )
    torque_rms_nm_max: float | None = _limit(
        "torque about its mean, rms [N m]",
        "Rms of the commanded torque about its mean while reference and load stay: a limit cycle exceeds it.",
        lambda run, _: run.torque_rms_nm,
        gt=0,
    )
    settling_time_ms_max: float | None = _limit(
        "settling after a step [ms]",
        "Time after a reference step until the speed stays within the band.",
        lambda run, _: run.step_response.settling_time_ms,
    )
    overshoot_percent_max: float | None = _limit(
        "overshoot of a step [%]",
        "Overshoot of a reference step.",
        lambda run, _: run.step_response.overshoot_percent,
    )
    recovery_time_ms_max: float | None = _limit(
        "recovery after a load step [ms]",
        "Time after a load step until the speed stays within the band of the reference.",
        lambda run, _: run.step_response.recovery_time_ms,
    )
    losses_in_a_row_max: float | None = _limit(
        "readings lost in a row",
        "Consecutive cycles of an axis without a usable reading.",
        lambda run, _: run.reading_losses_in_a_row if run.rows else None,
    )
    position_error_peak_rad_max: float | None = _limit(
        "position error, peak [rad]",
        "Peak error of a position reference, at the instant of each reading.",
        lambda run, _: run.position_error.peak_rad,
    )
    position_error_rms_rad_max: float | None = _limit(
        "position error, RMS [rad]",
        "RMS of the error of a position reference.",
        lambda run, _: run.position_error.rms_rad,
    )
    following_error_peak_rad_max: float | None = _limit(
        "following error, peak [rad]",
        "Peak following error of a drive in csp: its distance from the path between its position set-points.",
        lambda run, _: run.position_error.following_peak_rad,
    )


def _limited(name: str, metadata: Mapping[str, Any]) -> Limited:
    if "limited" not in metadata:
        raise TypeError(f"VerdictLimits.{name}: no figure; write {name}: float | None = _limit(title, ...)")
    limited: Limited = metadata["limited"]
    return limited


LIMITED: Final = {each.name: _limited(each.name, each.metadata) for each in fields(VerdictLimits)}
"""By the names of the limits."""
_DEMANDED: Final = {
    "certified_action_delay_us": "certified: delay to actuation [us]",
    "certified_losses_together": "certified: lost in a row, together",
    "certified_commands_at_a_limit": "certified: commands at a limit",
    "certified_gain_rad_s_nm": "certified: gain [rad/s per N m]",
}


def metric_title(key: str) -> str:
    """Return a limit's key in a reader's words, with its unit."""
    return LIMITED[key].title if key in LIMITED else _DEMANDED[key]
