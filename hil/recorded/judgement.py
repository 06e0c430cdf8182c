"""A recorded run judged anew, from its files alone: by its own limits, or by those of another file.

The figures come from the rows in ``records.arrow``. What those cannot tell, how the drives were found and
what the timing rests on, is what ``summary.json`` says. The digest holds the two together: rows that are not
those of the run are told.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from servobench.drivers.bounded_file import NamedBy
from servobench.hil.configuration.config import VerdictConfig
from servobench.hil.configuration.config_files import Section, load_file
from servobench.hil.recorded.recorded_run import RecordedRun, RunSignals
from servobench.hil.rows.run_files import RECORDS_FILE
from servobench.hil.verdict.figures import Figures
from servobench.hil.verdict.metrics import VerdictLimits
from servobench.hil.verdict.summary import Summary, summarise
from servobench.hil.verdict.verdict import Demand, RunOutcome, VerdictKind

_OF_LIMITS: Final = (VerdictKind.NOT_PASSED, VerdictKind.NOT_MEASURED)
"""Outcomes decided by limits, and so found anew."""


class Requirements(Section):
    """A file of requirements: the table ``[verdict]`` of a bench file."""

    verdict: VerdictConfig


@dataclass(frozen=True, slots=True)
class Judged:
    """Result of a review."""

    run: RecordedRun
    against: str
    """Whose limits: a file, or the bench's own."""
    summary: Summary
    """Summary by these limits, in the form ``hil run`` writes."""
    signals: RunSignals


def load_requirements(path: Path) -> VerdictConfig:
    """Raises BadInput or BadInputs."""
    return load_file(
        Requirements, path, "a file of requirements", NamedBy("--against", "", str(path))
    ).verdict


def judge_run(run: RecordedRun, against: Path | None = None) -> Judged:
    """Read the rows once, in bounded memory.

    Raises BadInput or BadInputs for ``against``.
    """
    plan = run.review
    if against is not None:
        asked = load_requirements(against)
        limits = asked.limits
        if run.metadata.get("time") != "real":
            limits = replace(limits, compute_us_max=None)
        plan = replace(plan, limits=limits, settling=asked.settling, band_percent=asked.settling_band_percent)
    run = replace(run, review=plan)
    signals = RunSignals(run.review, run.config.loop.deadline)
    for rows in run.bench_rows():
        signals.add(rows, run.first_cycle)
    summary = _judged(run, signals.review.figures(), plan.limits)
    return Judged(run, str(against) if against else "the bench's own limits", summary, signals)


def _judged(run: RecordedRun, figures: Figures, limits: VerdictLimits) -> Summary:
    recorded = run.summary
    first = recorded.verdict.findings[0] if recorded.verdict.findings else None
    completed = recorded.verdict.completed or first is None
    outcome = RunOutcome(
        bus_load_percent=recorded.bus_load_percent,
        realtime_factor=recorded.realtime_factor,
        completed=completed,
        reason="" if first is None or completed else first.text,
        cause=VerdictKind.CUT_SHORT if first is None or completed else first.outcome,
        cycles_planned=run.cycles_planned,
        drives=recorded.drives,
        network_notes=recorded.network_notes,
        load_machine=recorded.load_machine,
        timing=recorded.timing,
    )
    summary = summarise(
        figures,
        outcome,
        limits,
        str(run.folder),
        run.config.bench.seed,
        tuple([*recorded.recording_faults, *_other_rows(recorded, figures)]),
        list(_certified(figures)),
    )
    for finding in recorded.verdict.findings:
        if finding.outcome not in _OF_LIMITS and finding not in summary.verdict.findings:
            summary = summary.also(finding)
    return summary


def _other_rows(recorded: Summary, figures: Figures) -> Iterator[str]:
    """Why the rows are not those that the summary was made of."""
    if figures.cycles != recorded.cycles:
        yield f"{RECORDS_FILE} has {figures.cycles} cycles, the run had {recorded.cycles}"
    elif figures.digest != recorded.digest:
        yield f"{RECORDS_FILE} has the digest {figures.digest}, the run had {recorded.digest}"


def _certified(figures: Figures) -> Iterator[Demand]:
    """Yield what the controllers' certificates presume and allow, with the values seen.

    Where a premise was left its own line says so; the certified figure is not asked for then.
    """
    for axis, certificate in figures.certificates.items():
        for name, seen in (("action_delay_us", "seen"), ("losses_together", "seen_at_most")):
            pair: dict[str, Any] = certificate[name]
            if pair["certified"] is not None:
                yield Demand(f"certified_{name}", axis, pair[seen], pair["certified"])
        gain: dict[str, Any] = certificate["gain_rad_s_nm"]
        if gain["certified"] is None:
            continue
        yield Demand("certified_commands_at_a_limit", axis, float(certificate["commands_at_a_limit"]), 0.0)
        if not certificate["premises_left"]:
            yield Demand("certified_gain_rad_s_nm", axis, gain["seen_at_least"], gain["certified"])
