"""The metrics of a run: a figure that runs are judged, counted or compared by is one entry here.

An entry of :class:`VerdictLimits` has a limit in ``[verdict]``, ``OTHERS`` have none. The keys of the bench
file and their bounds, the checks of a run, titles, reference pages, the columns of a campaign, and the
figures and tolerances of ``hil compare`` follow from them. Beyond the entry, a limit has a case in
tests/pictures/cases.py that breaks it.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Final, NamedTuple, Protocol

from servobench.hil.verdict.figures import (
    DropoutCounts,
    Percentiles,
    PositionError,
    SpeedError,
    StepResponse,
)


class RunFigures(Protocol):
    """Figures of a run, whether it goes on (:class:`servobench.hil.verdict.figures.Figures`) or has ended
    (:class:`servobench.hil.verdict.summary.Summary`)."""

    @property
    def cycles(self) -> int: ...
    @property
    def dropouts(self) -> DropoutCounts: ...
    @property
    def speed_error(self) -> SpeedError: ...
    @property
    def position_error(self) -> PositionError: ...
    @property
    def step_response(self) -> StepResponse: ...
    @property
    def torque_rms_nm(self) -> float | None: ...
    @property
    def reading_delay_us(self) -> Percentiles: ...
    @property
    def action_delay_us(self) -> Percentiles: ...
    @property
    def lateness_us(self) -> Percentiles: ...
    @property
    def compute_us(self) -> Percentiles: ...
    @property
    def reading_losses_in_a_row(self) -> int: ...
    @property
    def command_losses_in_a_row(self) -> int | None: ...
    @property
    def certificates(self) -> Mapping[str, Any]: ...


class Beside(NamedTuple):
    """Facts about a run beside its figures."""

    rows: int
    """Records over all axes."""
    bus_load_percent: float | None = None
    """None: not known yet, or not measured."""

    def share(self, cycles: int) -> float | None:
        """Return the share of so many cycles, percent; None: there are none at all."""
        return 100.0 * cycles / self.rows if self.rows else None


Value = Callable[[RunFigures, Beside], float | None]
"""None: not measured."""


@dataclass(frozen=True, slots=True)
class Metric:
    """A figure of a run as one number: the smaller the better, but for a count of cycles."""

    title: str
    """For a reader."""
    unit: str
    """Empty: a count."""
    value: Value
    meaning: str = ""
    """Meaning of its limit, for the reference pages."""
    bounds: Mapping[str, Any] = field(default_factory=dict)
    """Bounds of the limit itself (``ge``, ``gt``, ``le``)."""
    counted: bool = False
    """True for a column of the table of a campaign."""
    compared: str = ""
    """Its name in ``hil compare``; empty: not compared."""

    @property
    def heading(self) -> str:
        """The title, with the unit."""
        return f"{self.title} [{self.unit}]" if self.unit else self.title


def _limit(
    title: str,
    unit: str,
    meaning: str,
    value: Value,
    counted: bool = False,
    compared: str = "",
    **bounds: float,
) -> Any:
    metric = Metric(title, unit, value, meaning, bounds or {"ge": 0}, counted, compared)
    return field(default=None, metadata={"metric": metric})


def _gain(run: RunFigures, which: str) -> float | None:
    """Return the gain of the axis nearest to its certificate."""
    pairs = [each["gain_rad_s_nm"] for each in run.certificates.values()]
    known = [pair for pair in pairs if pair["certified"] is not None and pair["seen"] is not None]
    return max(known, key=lambda pair: pair["seen"] / pair["certified"])[which] if known else None


@dataclass(frozen=True, slots=True)
class VerdictLimits:
    """Upper limits for a run; None: not set."""

    speed_error_peak_percent_max: float | None = _limit(
        "speed error, peak",
        "%",
        "Peak speed error, of the greatest reference.",
        lambda run, _: run.speed_error.peak_percent,
        counted=True,
        compared="speed_error_peak_percent",
    )
    after_load_percent_max: float | None = _limit(
        "speed error after load step",
        "%",
        "Peak speed error after a load step, of the reference.",
        lambda run, _: run.speed_error.after_load_percent,
        counted=True,
        compared="after_load_percent",
    )
    speed_error_rms_rad_s_max: float | None = _limit(
        "speed error, RMS",
        "rad/s",
        "RMS of the speed error.",
        lambda run, _: run.speed_error.rms_rad_s,
        counted=True,
        compared="speed_error_rms_rad_s",
    )
    dropouts_percent_max: float | None = _limit(
        "dropouts",
        "%",
        "Cycles without a usable reading: lost, late, stale or missed.",
        lambda run, beside: beside.share(run.dropouts.total),
        counted=True,
        compared="dropouts_percent",
        ge=0,
        le=100,
    )
    delay_p99_us_max: float | None = _limit(
        "delay of readings, p99",
        "us",
        "Delay of readings, 99 %.",
        lambda run, _: run.reading_delay_us.p99,
        counted=True,
        compared="reading_delay_p99_us",
        gt=0,
    )
    bus_load_percent_max: float | None = _limit(
        "bus load",
        "%",
        "Share of the time in which the bus was busy.",
        lambda _, beside: beside.bus_load_percent,
        counted=True,
        gt=0,
        le=100,
    )
    missed_percent_max: float | None = _limit(
        "cycles without SYNC",
        "%",
        "Cycles without SYNC because the host came too late.",
        lambda run, beside: beside.share(run.dropouts.missed),
        ge=0,
        le=100,
    )
    lateness_us_max: float | None = _limit(
        "lateness, largest",
        "us",
        "Greatest lateness of the host's wake-up for a cycle.",
        lambda run, _: run.lateness_us.max,
    )
    compute_us_max: float | None = _limit(
        "computing time, largest",
        "us",
        "Greatest computing time of compensator and controller in a cycle; judged in real time alone.",
        lambda run, _: run.compute_us.max,
        gt=0,
    )
    torque_rms_nm_max: float | None = _limit(
        "torque about its mean, rms",
        "N m",
        "Rms of the commanded torque about its mean while reference and load stay: a limit cycle exceeds it.",
        lambda run, _: run.torque_rms_nm,
        counted=True,
        compared="torque_rms_nm",
        gt=0,
    )
    settling_time_ms_max: float | None = _limit(
        "settling after a step",
        "ms",
        "Time after a reference step until the speed stays within the band.",
        lambda run, _: run.step_response.settling_time_ms,
        compared="settling_time_ms",
    )
    overshoot_percent_max: float | None = _limit(
        "overshoot of a step",
        "%",
        "Overshoot of a reference step.",
        lambda run, _: run.step_response.overshoot_percent,
        compared="overshoot_percent",
    )
    recovery_time_ms_max: float | None = _limit(
        "recovery after a load step",
        "ms",
        "Time after a load step until the speed stays within the band of the reference.",
        lambda run, _: run.step_response.recovery_time_ms,
        compared="recovery_time_ms",
    )
    losses_in_a_row_max: float | None = _limit(
        "readings lost in a row",
        "",
        "Consecutive cycles of an axis without a usable reading.",
        lambda run, beside: run.reading_losses_in_a_row if beside.rows else None,
        compared="reading_losses_in_a_row",
    )
    position_error_peak_rad_max: float | None = _limit(
        "position error, peak",
        "rad",
        "Peak error of a position reference, at the instant of each reading.",
        lambda run, _: run.position_error.peak_rad,
    )
    position_error_rms_rad_max: float | None = _limit(
        "position error, RMS",
        "rad",
        "RMS of the error of a position reference.",
        lambda run, _: run.position_error.rms_rad,
    )
    following_error_peak_rad_max: float | None = _limit(
        "following error, peak",
        "rad",
        "Peak following error of a drive in csp: its distance from the path between its position set-points.",
        lambda run, _: run.position_error.following_peak_rad,
    )


def _metric(name: str, metadata: Mapping[str, Any]) -> Metric:
    if "metric" not in metadata:
        raise TypeError(
            f"VerdictLimits.{name}: no figure; write {name}: float | None = _limit(title, unit, ...)"
        )
    metric: Metric = metadata["metric"]
    return metric


LIMITED: Final = {each.name: _metric(each.name, each.metadata) for each in fields(VerdictLimits)}
"""Metrics by the names of their limits."""
OTHERS: Final[dict[str, Metric]] = {
    "speed_error_peak_rad_s": Metric(
        "speed error, peak", "rad/s", lambda run, _: run.speed_error.peak_rad_s, counted=True
    ),
    "delay_max_us": Metric(
        "delay of readings, largest", "us", lambda run, _: run.reading_delay_us.max, counted=True
    ),
    "load_gain_rad_s_nm": Metric(
        "gain from load torque to speed error, seen; of a certified controller",
        "rad/s per N m",
        lambda run, _: _gain(run, "seen"),
        counted=True,
    ),
    "load_gain_least_rad_s_nm": Metric(
        "the same, less what noise may make of it",
        "rad/s per N m",
        lambda run, _: _gain(run, "seen_at_least"),
        counted=True,
    ),
    "load_gain_certified_rad_s_nm": Metric(
        "the same, as its certificate has it",
        "rad/s per N m",
        lambda run, _: _gain(run, "certified"),
        counted=True,
    ),
    "command_losses_in_a_row": Metric(
        "commands lost in a row",
        "",
        lambda run, _: run.command_losses_in_a_row,
        compared="command_losses_in_a_row",
    ),
    "action_delay_p99_us": Metric(
        "delay to actuation, p99",
        "us",
        lambda run, _: run.action_delay_us.p99,
        compared="action_delay_p99_us",
    ),
    "lateness_p99_us": Metric(
        "lateness, p99", "us", lambda run, _: run.lateness_us.p99, compared="lateness_p99_us"
    ),
    "cycles": Metric("control cycles", "", lambda run, _: float(run.cycles), counted=True),
}
"""Metrics without a limit, by name."""
METRICS: Final[Mapping[str, Metric]] = {
    name.removesuffix("_max"): metric for name, metric in LIMITED.items()
} | OTHERS
"""All of them: a limit's name is its metric's with ``_max``."""
_DEMANDED: Final = {
    "certified_action_delay_us": "certified: delay to actuation [us]",
    "certified_losses_together": "certified: lost in a row, together",
    "certified_commands_at_a_limit": "certified: commands at a limit",
    "certified_gain_rad_s_nm": "certified: gain [rad/s per N m]",
}


def limited_values(run: RunFigures, beside: Beside) -> dict[str, float | None]:
    """Return what each limit is held against, by the limit's name."""
    return {name: metric.value(run, beside) for name, metric in LIMITED.items()}


def compared_values(run: RunFigures, beside: Beside) -> dict[str, float | None]:
    """Return the figures by which runs are compared, by their names there."""
    values = {each.compared: each.value(run, beside) for each in METRICS.values() if each.compared}
    return {name: None if value is None else float(value) for name, value in values.items()}


def metric_title(key: str) -> str:
    """Return a limit's key in a reader's words, with its unit."""
    return LIMITED[key].heading if key in LIMITED else _DEMANDED[key]
