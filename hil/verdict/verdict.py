"""The verdict on a run: the one definition of a valid run, and its exit status.

docs/verdict.md explains it to a reader. The figures for the limits come from the cycle records
(:mod:`servobench.hil.reviewing.review`); other facts are handed over when the run ends (:class:`RunOutcome`).
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from enum import IntEnum, StrEnum
from typing import Any, NamedTuple

from servobench.hil.verdict.figures import WorstPlace
from servobench.hil.verdict.metrics import VerdictLimits


class ExitStatus(IntEnum):
    """Exit statuses of ``hil``."""

    PASSED = 0
    FAILED = 1
    """A limit was exceeded."""
    BAD_INPUT = 2
    """A file or an option cannot be used; nothing was moved."""
    PEER_FAULT = 3
    """The bus or a drive failed, or a safety limit stopped the run."""
    NOT_TRUSTWORTHY = 4
    """The run's timing contradicts itself, or others disturbed it."""
    NOT_RECORDED = 5
    """The recording is incomplete."""
    INCOMPLETE = 6
    """Not all planned cycles were run, or not all limits were measured."""
    COUNTER_EXAMPLE = 7
    """A run within the premises of a certificate violated it."""
    DEFECT = 70
    """An error of this program (EX_SOFTWARE of sysexits.h): never a verdict."""
    INTERRUPTED = 130
    """Ctrl-C, SIGTERM, SIGHUP or the caller: findings until then are no verdict (128 + SIGINT)."""


class VerdictKind(StrEnum):
    """Outcome of a run. If several apply, the first of this list is reported."""

    exit_status: ExitStatus
    """Exit status of a process."""

    def __new__(cls, text: str, status: ExitStatus) -> "VerdictKind":
        kind = str.__new__(cls, text)
        kind._value_, kind.exit_status = text, status
        return kind

    DEFECT = "defect of the program", ExitStatus.DEFECT
    PEER_FAULT = "bus, drive or safety", ExitStatus.PEER_FAULT
    INTERRUPTED = "interrupted", ExitStatus.INTERRUPTED
    BAD_INPUT = "bad input", ExitStatus.BAD_INPUT
    NOT_TRUSTWORTHY = "not trustworthy", ExitStatus.NOT_TRUSTWORTHY
    NOT_RECORDED = "not recorded", ExitStatus.NOT_RECORDED
    CUT_SHORT = "cut short", ExitStatus.INCOMPLETE
    NOT_MEASURED = "not measured", ExitStatus.INCOMPLETE
    NOT_PASSED = "not passed", ExitStatus.FAILED
    DISTURBED = "disturbed", ExitStatus.NOT_TRUSTWORTHY
    """Kind of a finding. A run without other findings has one of the next two outcomes."""
    PASSED_DISTURBED = "passed, disturbed", ExitStatus.NOT_TRUSTWORTHY
    COMPLETED_DISTURBED = "completed, disturbed", ExitStatus.NOT_TRUSTWORTHY
    """Without limits."""
    NOTHING_ASKED = "completed, nothing was asked", ExitStatus.PASSED
    PASSED = "passed", ExitStatus.PASSED


_GRAVITY = list(VerdictKind)


def outcome_of_status(status: int) -> VerdictKind:
    """Return the outcome for an error that leaves with ``status``; a defect for a status that no error
    has."""
    for outcome in (
        VerdictKind.PEER_FAULT,
        VerdictKind.INTERRUPTED,
        VerdictKind.BAD_INPUT,
        VerdictKind.NOT_RECORDED,
        VerdictKind.CUT_SHORT,
    ):
        if outcome.exit_status == status:
            return outcome
    return VerdictKind.DEFECT


class Demand(NamedTuple):
    """A limit that no limits file names."""

    metric: str
    axis: str
    value: float | None
    """None: not measured."""
    limit: float


@dataclass(frozen=True, slots=True)
class DriveEnd:
    """State of one drive after the cycles, by its answers."""

    name: str
    after_last_cycle: str | None = None
    """Its state by SDO after the last cycle, before it was stopped; None: not read."""
    at_the_end: str | None = None
    """Its state when it was released."""
    at_rest: bool | None = None
    """True if its shaft was at rest then (606Ch); None: not read."""
    evidence: str = ""
    """Problems while it was stopped."""
    unwatched: str = ""
    """Difference, if its 1016h held another value at the end than was written."""
    mode_watch: str = ""
    """How it was monitored for following its commands; empty if it was not enabled."""
    lapses: tuple[str, ...] = ()
    """Times when it did not follow them, each in words."""


@dataclass(frozen=True, slots=True)
class RunOutcome:
    """Facts beyond the records; handed over when the run ends. Plain values, for another process."""

    bus_load_percent: float | None = None
    """None: not measured."""
    realtime_factor: float | None = None
    """Bench time over wall time."""
    completed: bool = True
    """The loop came to its end."""
    reason: str = ""
    """Why it did not."""
    cause: VerdictKind = VerdictKind.CUT_SHORT
    """Outcome in that case; meaningless otherwise."""
    cycles_planned: int | None = None
    """Cycles of each axis."""
    drives: tuple[DriveEnd, ...] = ()
    """One for each axis."""
    emergencies: tuple[str, ...] = ()
    """EMCYs of the drives that no drive fault of the plan names."""
    disturbances: tuple[str, ...] = ()
    """Frames of others not named by ``[guard] allow``: first frame, its time, count."""
    network_notes: tuple[str, ...] = ()
    """Aspects in which the network was worse than a controller was made for; only if the run was to
    continue."""
    load_machine: Mapping[str, Any] | None = None
    """Result of the load instrument, if there was one."""
    timing: Mapping[str, Any] | None = None
    """Basis of the timing (:mod:`servobench.hil.execution.conclusion`)."""
    distrust: tuple[str, ...] = ()
    """Reasons why the run's timing is not trustworthy."""


@dataclass(frozen=True, slots=True)
class CycleCount:
    """The planned cycles, by the recorded rows."""

    dense: int
    """Cycles with a row in each axis, in order from 1 on, none missing and none double."""
    rows: int
    """Rows over all axes."""
    missed: int
    """Cycles among them without SYNC."""


class LimitResult(StrEnum):
    """Result of a limit."""

    KEPT = "kept"
    BROKEN = "broken"
    NOT_MEASURED = "not measured"
    """There is no value, or it does not cover the whole run."""


@dataclass(frozen=True, slots=True)
class Check:
    """One limit and its value."""

    metric: str
    value: float | None
    """In a run that was cut short, for the completed part."""
    limit: float
    result: LimitResult
    axis: str = ""
    """Axis of the worst value; empty: no single axis."""
    at_ns: int | None = None
    """When it occurred, run time; None: no single instant."""


@dataclass(frozen=True, slots=True)
class Finding:
    """Something that prevents a run from passing."""

    outcome: VerdictKind
    text: str


@dataclass(frozen=True, slots=True)
class RunVerdict:
    """The gravest finding, and all others."""

    outcome: VerdictKind
    exit_status: int
    passed: bool
    """True if there were limits, and all were kept in a valid run."""
    completed: bool
    """True if each planned cycle has its row, and after the last one each drive was still enabled."""
    reason: str
    """The findings of ``outcome`` in words; empty if there are none."""
    limits: tuple[Check, ...]
    findings: tuple[Finding, ...]
    """The gravest first."""

    def also(self, finding: Finding) -> "RunVerdict":
        """Return the verdict with a later finding; such a run has not passed."""
        return _conclude(self.completed, self.limits, [*self.findings, finding])

    def of(self, outcome: VerdictKind) -> tuple[str, ...]:
        """Return the findings of one kind, in words."""
        return tuple(finding.text for finding in self.findings if finding.outcome is outcome)


def judge(
    outcome: RunOutcome,
    count: CycleCount,
    values: Mapping[str, float | None],
    limits: VerdictLimits,
    recording_lacks: str = "",
    places: Mapping[str, WorstPlace] | None = None,
    demands: Sequence[Demand] = (),
) -> RunVerdict:
    """Judge a run.

    ``values``: by the names of the limits; None, or missing, if not measured.
    ``recording_lacks``: why the recording is incomplete; empty if it is not. ``places``: origin of the
    values, by the same names, as far as known. ``demands``: further limits.
    """
    undone = _undone(outcome, count)
    completed = not undone
    checks = checks_of(values, limits, places, completed) + tuple(
        Check(metric, value, limit, _held_against(value, limit, completed), axis)
        for metric, axis, value, limit in demands
    )
    findings = [*undone, *_doubted(outcome, recording_lacks), *_broken(checks, completed)]
    if not checks and count.missed:
        text = f"{count.missed} cycles went without SYNC, and no limit says how many may"
        findings.append(Finding(VerdictKind.NOT_MEASURED, text))
    return _conclude(completed, checks, findings)


def checks_of(
    values: Mapping[str, float | None],
    limits: VerdictLimits,
    places: Mapping[str, WorstPlace] | None = None,
    completed: bool = True,
) -> tuple[Check, ...]:
    """Hold values against the limits that are set; ``values``, ``places``: as of :func:`judge`."""
    nowhere = WorstPlace()
    return tuple(
        Check(key, value, limit, _held_against(value, limit, completed), place.axis, place.at_ns)
        for key, limit in asdict(limits).items()
        if limit is not None
        for value, place in [(values.get(key), (places or {}).get(key, nowhere))]
    )


def not_run(outcome: VerdictKind, reason: str) -> RunVerdict:
    """Return the verdict of a run that ended before it began."""
    return _conclude(False, (), [Finding(outcome, reason)])


def _undone(outcome: RunOutcome, count: CycleCount) -> list[Finding]:
    """Say why not everything planned was run."""
    if not outcome.completed:
        return [Finding(outcome.cause, outcome.reason)]
    return [Finding(VerdictKind.CUT_SHORT, text) for text in _gaps(outcome, count)]


def _gaps(outcome: RunOutcome, count: CycleCount) -> Iterator[str]:
    if not outcome.drives:
        yield "no drive was looked at after the last cycle"
        return
    planned = outcome.cycles_planned
    if planned is None:
        yield "how many cycles were planned is not known"
    elif count.rows != (expected := planned * len(outcome.drives)):
        yield f"{count.rows} cycles are accounted for, of {expected} that were planned"
    elif count.dense != planned:
        yield f"rows are missing or double behind cycle {count.dense}"
    for drive in outcome.drives:
        if drive.after_last_cycle is None:
            yield f"{drive.name} was not looked at after the last cycle"


def _doubted(outcome: RunOutcome, recording_lacks: str) -> Iterator[Finding]:
    """Yield findings against a run, whatever its figures are."""
    for drive in outcome.drives:
        if drive.at_rest is False or (drive.at_rest is None and outcome.completed):
            text = f"{drive.name} is not confirmed at rest: {drive.evidence}".removesuffix(": ")
            yield Finding(VerdictKind.PEER_FAULT, text)
        if drive.unwatched:
            yield Finding(VerdictKind.PEER_FAULT, f"{drive.name}: {drive.unwatched}")
        for lapse in drive.lapses:
            yield Finding(VerdictKind.PEER_FAULT, f"{drive.name} {lapse}")
    for emergency in outcome.emergencies:
        yield Finding(VerdictKind.PEER_FAULT, emergency)
    for doubt in outcome.distrust:
        yield Finding(VerdictKind.NOT_TRUSTWORTHY, doubt)
    for disturbance in outcome.disturbances:
        yield Finding(VerdictKind.DISTURBED, disturbance)
    if recording_lacks:
        yield Finding(VerdictKind.NOT_RECORDED, recording_lacks)


def _held_against(value: float | None, limit: float, completed: bool) -> LimitResult:
    if value is None or not completed:
        return LimitResult.NOT_MEASURED
    return LimitResult.KEPT if value <= limit else LimitResult.BROKEN


def _broken(checks: Sequence[Check], completed: bool) -> Iterator[Finding]:
    for check in checks:
        if check.result is LimitResult.BROKEN:
            text = f"{check.metric} = {check.limit:g}, found {check.value:.4g}"
            yield Finding(VerdictKind.NOT_PASSED, text)
        elif check.result is LimitResult.NOT_MEASURED and completed:
            yield Finding(
                VerdictKind.NOT_MEASURED, f"{check.metric} = {check.limit:g}, and nothing was measured"
            )


def _conclude(completed: bool, checks: tuple[Check, ...], in_any_order: Sequence[Finding]) -> RunVerdict:
    findings = tuple(sorted(in_any_order, key=lambda finding: _GRAVITY.index(finding.outcome)))
    gravest = findings[0].outcome if findings else None
    outcome = gravest or (VerdictKind.PASSED if checks else VerdictKind.NOTHING_ASKED)
    if gravest is VerdictKind.DISTURBED:
        outcome = VerdictKind.PASSED_DISTURBED if checks else VerdictKind.COMPLETED_DISTURBED
    verdict = RunVerdict(
        outcome, int(outcome.exit_status), outcome is VerdictKind.PASSED, completed, "", checks, findings
    )
    return verdict if gravest is None else replace(verdict, reason="; ".join(verdict.of(gravest)))


def verdict_title(verdict: RunVerdict) -> str:
    """Return the verdict in capitals, for the first line."""
    return verdict.outcome.upper()
