"""The guided sequence: each step announces itself, is confirmed, done, checked, repeated or skipped."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar

from servobench.drivers.errors import BadInput, BusDown, PeerFault
from servobench.hil.commissioning.dialog import Choice
from servobench.hil.commissioning.findings import (
    ReadingsLost,
    StepFailed,
    StepOutcome,
    StepRecord,
    StepVerdict,
)
from servobench.hil.commissioning.session import Session
from servobench.hil.machine.stopping import Interrupted


class Step(ABC):
    """One step. The attributes describe it; the methods are called in their order here."""

    name: ClassVar[str]
    title: ClassVar[str]
    limit: ClassVar[str] = ""
    """The failure condition, to follow "it fails if"."""
    needs: ClassVar[tuple[str, ...]] = ()
    """Names of steps that must be done before."""
    writes: ClassVar[bool] = False
    """True if it changes objects of a drive at rest."""
    moves: ClassVar[bool] = False
    """True if the shaft may turn; it then writes, too."""
    essential: ClassVar[bool] = False
    """True if later steps are not safe without it: it cannot be skipped."""
    repeatable: ClassVar[bool] = True
    """True if an attempt that failed by a disturbance is repeated, though nobody can be asked."""

    def left_out(self, session: Session) -> str | None:  # noqa: ARG002 - most steps can always be done
        """Return why this drive cannot do it, or None."""
        return None

    @abstractmethod
    def plan(self, session: Session, /) -> str:
        """Describe the action, before it is confirmed."""

    @abstractmethod
    def run(self, session: Session, outcome: StepOutcome) -> None:
        """Do it, check it, and put the result into ``outcome``.

        Raises StepFailed, or another PeerFault of bus or drive.
        """


class Abandoned(PeerFault):
    """Commissioning ended before its end; everything was put back."""

    exit_status = 1


def run_sequence(session: Session, steps: Sequence[Step], records: list[StepRecord]) -> None:
    """Run ``steps``; each adds a record to ``records``, even the one that ends the sequence.

    Raises Abandoned if an essential step failed or the user quits, Interrupted by a stop signal or key,
    BusDown if the bus goes away.
    """
    done: set[str] = set()
    shown: set[str] = set()
    """Steps of a dry run that were only described."""
    for number, step in enumerate(steps, start=1):
        session.check_stop()
        record = StepRecord(step.name, step.title, "", StepVerdict.NOT_DONE, step.limit)
        records.append(record)
        session.log.step(step.name)
        reason = _why_not(session, step, done)
        if reason is not None:
            record.verdict, record.reason = StepVerdict.LEFT_OUT, reason
            session.dialog.tell(f"{number:2}. {step.title}: left out, {reason}")
            session.log.event("INFO", f"{step.title}: left out, {reason}")
            continue
        record.plan = step.plan(session)
        session.dialog.tell(f"{number:2}. {step.title}\n    {record.plan}")
        if session.request.dry_run and (step.writes or step.moves or not shown.isdisjoint(step.needs)):
            record.reason = "dry run"
            done.add(step.name)  # what rests on it is told of too
            shown.add(step.name)
            continue
        _carry_out(session, step, record)
        if record.verdict is StepVerdict.DONE:
            done.add(step.name)


def _why_not(session: Session, step: Step, done: set[str]) -> str | None:
    missing = [name for name in step.needs if name not in done]
    if missing:
        return f"it rests on {', '.join(missing)}"
    return step.left_out(session)


def _carry_out(session: Session, step: Step, record: StepRecord) -> None:
    otherwise = (Choice.QUIT,) if step.essential else (Choice.SKIP, Choice.QUIT)
    choice = Choice.GO
    if step.moves or not session.request.brief:
        choice = session.dialog.choose("    do it?", (Choice.GO, *otherwise), session.idle)
    while True:
        if choice is Choice.QUIT:
            raise Abandoned("ended on request", f"at the step '{step.title}'")
        if choice is Choice.SKIP:
            record.verdict = StepVerdict.SKIPPED
            record.reason = (
                session.dialog.line("    why?", session.idle) or record.reason or "no reason given"
            )
            session.log.event("WARN", f"{step.title}: skipped, {record.reason}")
            return
        failure = _attempt(session, step, record)
        if failure is None:
            _show(session, record.outcome)
            return
        record.verdict, record.reason = StepVerdict.FAILED, str(failure)
        session.dialog.tell(f"    failed: {failure}")
        if not session.dialog.attended:
            if step.repeatable and record.attempts < _attempts_unattended(failure):
                session.dialog.tell("    repeated, as nobody can be asked")
                record.attempts += 1
                continue
            if step.essential:
                raise Abandoned(f"the step '{step.title}' failed", str(failure)) from failure
            return
        choice = session.dialog.choose("    what now?", (Choice.REPEAT, *otherwise), session.idle)
        record.attempts += 1


def _attempts_unattended(failure: PeerFault) -> int:
    """Return how often a step that ended with ``failure`` is attempted when unattended."""
    if isinstance(failure, ReadingsLost):
        return 3  # seconds of a busy machine or bus, in steps of seconds
    # A drive's fault may be passing; what a step has judged stands.
    return 1 if isinstance(failure, StepFailed) else 2


def _attempt(session: Session, step: Step, record: StepRecord) -> PeerFault | None:
    """Do the step once; return the failure, if any."""
    outcome = StepOutcome()
    failure: PeerFault | None = None
    try:
        session.begin_attempt()
        step.run(session, outcome)
    except (BusDown, Interrupted, BadInput, OSError):
        record.verdict, record.reason = StepVerdict.FAILED, "cut short"
        raise
    except PeerFault as error:
        failure = error
    failure = session.end_attempt(failure)
    if failure is None:
        record.verdict, record.reason, record.outcome = StepVerdict.DONE, "", outcome
        session.log.event("INFO", f"{step.title}: done")
    else:
        session.log.event("ERROR", f"{step.title}: failed: {failure}")
    for fault in outcome.faults:
        session.log.event("WARN", f"{step.title}: found: {fault}")
    session.write_log()
    return failure


def _show(session: Session, outcome: StepOutcome) -> None:
    for line in outcome.lines:
        session.dialog.tell(f"    {line}")
    for fault in outcome.faults:
        session.dialog.tell(f"    FOUND: {fault}")
