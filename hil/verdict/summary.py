"""The summary of a run: its figures, its verdict, and its basis.

The figures rest on the cycle records alone (see :mod:`servobench.hil.reviewing.review`), never on the
telemetry.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any

from servobench.hil.verdict.figures import (
    NO_POSITIONS,
    NO_STEPS,
    NO_TIMES,
    DropoutCounts,
    Figures,
    Percentiles,
    PositionError,
    SpeedError,
    StepResponse,
)
from servobench.hil.verdict.metrics import Beside, VerdictLimits, limited_values
from servobench.hil.verdict.verdict import (
    Check,
    CycleCount,
    Demand,
    DriveEnd,
    Finding,
    RunOutcome,
    RunVerdict,
    VerdictKind,
    checks_of,
    judge,
    not_run,
)


@dataclass(frozen=True, slots=True)
class Summary:
    """``as_json`` is the output of ``hil run --json``, at every exit."""

    cycles: int
    dropouts: DropoutCounts
    reading_delay_us: Percentiles
    speed_error: SpeedError
    bus_load_percent: float | None
    realtime_factor: float | None
    lateness_us: Percentiles
    compute_us: Percentiles
    verdict: RunVerdict
    recording: str
    """The folder of the run; empty if nothing was kept."""
    seed: int | None
    digest: str
    drives: tuple[DriveEnd, ...] = ()
    """State of each drive after the cycles."""
    torque_rms_nm: float | None = None
    step_response: StepResponse = NO_STEPS
    action_delay_us: Percentiles = NO_TIMES
    action_delay_least_us: Percentiles = NO_TIMES
    reading_losses_in_a_row: int = 0
    command_losses_in_a_row: int | None = None
    command_losses_in_a_row_least: int | None = None
    position_error: PositionError = NO_POSITIONS
    certificates: Mapping[str, Any] = field(default_factory=dict)
    recording_faults: tuple[str, ...] = ()
    """Gaps in the recording, e.g. rows that found the ring full or a file on a full disk."""
    network_notes: tuple[str, ...] = ()
    """Aspects in which the network was worse than a controller was made for."""
    load_machine: Mapping[str, Any] | None = None
    """Identity, tally, requested and measured torque at each load step
    (:mod:`servobench.hil.load.load_machines`)."""
    timing: Mapping[str, Any] | None = None
    """Basis of the timing (:mod:`servobench.hil.execution.conclusion`)."""

    def also(self, finding: Finding) -> "Summary":
        """Return the summary with a later finding."""
        return replace(self, verdict=self.verdict.also(finding))

    def as_json(self) -> dict[str, Any]:
        """Return plain dicts, lists, numbers, strings and None; missing parts at the end are left out."""
        plain = asdict(self)
        for name in ("certificates", "recording_faults", "network_notes", "load_machine", "timing"):
            if not plain[name]:
                del plain[name]
        return plain


def summarise(
    figures: Figures,
    outcome: RunOutcome,
    limits: VerdictLimits,
    recording: str,
    seed: int,
    recording_faults: tuple[str, ...] = (),
    certified: Sequence[Demand] = (),
) -> Summary:
    """Join figures, outcome and verdict; ``certified``: demands besides the limits."""
    shared = {each.name for each in fields(Figures)} & {each.name for each in fields(Summary)}
    count = CycleCount(figures.dense, figures.rows, figures.dropouts.missed)
    values = limited_values(figures, Beside(figures.rows, outcome.bus_load_percent))
    return Summary(
        **{name: getattr(figures, name) for name in shared},
        bus_load_percent=outcome.bus_load_percent,
        realtime_factor=outcome.realtime_factor,
        verdict=judge(outcome, count, values, limits, "; ".join(recording_faults), figures.worst, certified),
        recording=recording,
        seed=seed,
        drives=outcome.drives,
        recording_faults=recording_faults,
        network_notes=outcome.network_notes,
        load_machine=outcome.load_machine,
        timing=outcome.timing,
    )


def checks_so_far(figures: Figures, limits: VerdictLimits) -> tuple[Check, ...]:
    """Hold the figures of a run that goes on against its limits; what its end alone tells is not
    measured."""
    return checks_of(limited_values(figures, Beside(figures.rows)), limits, figures.worst)


def summary_without_run(outcome: VerdictKind, reason: str) -> Summary:
    """Return the summary of a run that ended before it began: no cycle, and nothing measured."""
    return Summary(
        cycles=0,
        dropouts=DropoutCounts(0, 0, 0, 0),
        reading_delay_us=NO_TIMES,
        speed_error=SpeedError(None, None, None, None),
        bus_load_percent=None,
        realtime_factor=None,
        lateness_us=NO_TIMES,
        compute_us=NO_TIMES,
        verdict=not_run(outcome, reason),
        recording="",
        seed=None,
        digest="",
    )
