"""Facts about a run besides its rows, gathered from its first step until the last drive rests; and the basis
of its timing: clocks, placed readings, SYNCs, and contradictions.

Detects a host that stands still within a run: its process stopped, or the whole machine suspended.

The ticks of that time are missed, whichever it was. A suspended machine's own clock stands still too, so that
no tick looks late: only the drives notice that they were left alone.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import Any, Final, NamedTuple

from servobench.drivers.canopen.error_codes import NO_ERROR
from servobench.drivers.canopen.nmt import Emergency, condensed
from servobench.drivers.cia402.profile import State
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.cia402.supervision import Release
from servobench.drivers.errors import BenchError, DriveInFault
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, NS_PER_US, Duration, Instant, suspended
from servobench.hil.configuration.config import Foreign
from servobench.hil.execution.world import World
from servobench.hil.loop.attribution import Health
from servobench.hil.loop.axis import Axis
from servobench.hil.loop.loop import PROGRESS_EVERY, LoopOutcome
from servobench.hil.loop.syncs import SyncLog
from servobench.hil.machine.refusals import explained
from servobench.hil.recording.logger_process import RecordingFailed
from servobench.hil.verdict.verdict import DriveEnd, RunOutcome, VerdictKind, outcome_of_status
from servobench.virtual_bus.bus.judge import Direction
from servobench.virtual_bus.faults.fault_plan import FaultPlan
from servobench.virtual_bus.faults.frame_fault import COB_IDS, FrameFault
from servobench.virtual_bus.faults.kinds.drive_fault import FAILURES, DriveFault
from servobench.virtual_bus.faults.kinds.duplicate import Duplicate
from servobench.virtual_bus.hosting.injection import Faults

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
        if stamped.stamp_error_ns_max > period // 2 and not axis.by_stamp.stamps.coarse:
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


TOLD_WITHIN: Final = Duration(100 * NS_PER_MS)
"""From a noticed drive fault to its EMCY: the drive sends it at once, and a full bus or a fault that holds
frames delays it by tens of ms."""


class Conclusion:
    """Facts about one run. By default it was ended by a defect of the program."""

    def __init__(self, names: Sequence[str], faults: Faults | None, cycles_planned: int) -> None:
        """``names``: of the axes. ``faults``: those injected on purpose."""
        self._ends = {name: DriveEnd(name) for name in names}
        self._named = list(named_emergencies(faults))
        self._emergencies: list[str] = []
        """One for each code of a drive."""
        self._outcome = RunOutcome(cycles_planned=cycles_planned)
        self._explained = False

    @property
    def outcome(self) -> RunOutcome:
        """All facts gathered."""
        outcome = self._outcome
        if not self._explained:
            outcome = _cut_short(outcome, "it ended by a defect of this program", VerdictKind.DEFECT)
        return replace(outcome, drives=tuple(self._ends.values()), emergencies=tuple(self._emergencies))

    def ended(
        self, ended: LoopOutcome, interrupted_by: str, period: Duration, horizon: Duration, **notes: Any
    ) -> None:
        """Note a regular end of the loop; ``horizon``: how long readings are waited for; ``notes``: fields of
        :class:`RunOutcome`.

        A host that comes back later than readings are waited for has not seen the end of its run.
        """
        self._outcome = replace(self._outcome, **notes)
        late = ended.ended_at - ended.last_due_at - period
        if ended.interrupted:
            self._outcome = _cut_short(self._outcome, interrupted_by, VerdictKind.INTERRUPTED)
        elif late > horizon:
            reason = (
                f"the host was away at the end, and came back {late / NS_PER_MS:.0f} ms after the last cycle"
            )
            self._outcome = _cut_short(self._outcome, reason, VerdictKind.CUT_SHORT)

    @contextmanager
    def explaining(self, close: Callable[[], object]) -> Iterator[None]:
        """Note an error that ends the run inside, and close the recording, before it passes on."""
        try:
            yield
        except BaseException as error:
            known = error if isinstance(error, BenchError) else explained(error)
            if known is not None:
                self.failed(known)
            with suppress(RecordingFailed):  # what ended the run is to be told
                close()
            raise

    def failed(self, error: BenchError) -> None:
        """Note that an error ended the run."""
        self._explained = True
        self._outcome = _cut_short(self._outcome, str(error), outcome_of_status(error.exit_status))

    def came_to_its_end(self) -> None:
        """Note that nothing was raised until the last drive was released."""
        self._explained = True

    def look_at(self, drives: Sequence[ServoDrive]) -> None:
        """Check each drive after the last cycle, before any is stopped: it must be as in the loop.

        The check uses its reports, and its answer to an SDO. Raises as :meth:`ServoDrive.check`; DriveInFault
        if it left OPERATION ENABLED, NoAnswer if it does not answer.
        """
        for drive in drives:
            drive.check()
        for drive in drives:
            # Commands cease now: what watches for them must not take that for a fault of the host.
            drive.supervision.end()
        for drive in drives:
            state = drive.control.read_state()
            self._note(drive.name, after_last_cycle=_label(state))
            if state is not State.OPERATION_ENABLED:
                raise DriveInFault(
                    f"{drive.control.title} was not enabled any more after the last cycle",
                    drive.control.evidence(),
                )

    def released(self, drive: ServoDrive, release: Release) -> None:
        """Note that a drive was released."""
        if drive.identity is None:
            self._note(drive.name, evidence=release.evidence)  # nobody answered who could be asked
            return
        # A drive that was not configured was not moved by this bench, and nobody knows its unit of speed.
        at_rest = None if release.at_rest and drive.plan is None else release.at_rest
        self._note(
            drive.name,
            at_the_end=_label(release.state),
            at_rest=at_rest,
            evidence=release.evidence,
            unwatched=release.unwatched,
        )

    def told(self, drive: ServoDrive, since: Instant, zero: Instant | None) -> None:
        """Take in a drive's EMCYs ``since`` an instant, and the times when it did not follow its commands;
        ``zero``: when the run began, if it did."""
        self._note(drive.name, lapses=tuple(lapse.told(zero) for lapse in drive.follow.lapses))
        unnamed = [
            each
            for each in drive.network.emergencies
            if each.node_id == drive.node_id and each.at >= since and not self._explained_by_plan(each, zero)
        ]
        for series in condensed(unnamed):
            first, last_s = series.first, (series.last.at - (zero or 0)) / NS_PER_S
            text = f"{drive.name}: {first.told(*drive.control.make)}"
            if zero is not None:
                text += f" at {(first.at - zero) / NS_PER_S:.3f} s"
            if series.times > 1:
                text += f", {series.times} times" + (f" until {last_s:.3f} s" if zero is not None else "")
            self._emergencies.append(text)

    def watched(self, drive: ServoDrive, mode_watch: str) -> None:
        """Note how a drive that does not follow is noticed, in words."""
        self._note(drive.name, mode_watch=mode_watch)

    def disturbed(self, disturbances: tuple[str, ...]) -> None:
        """Note the frames of other nodes, in words."""
        self._outcome = replace(self._outcome, disturbances=disturbances)

    def _explained_by_plan(self, emergency: Emergency, zero: Instant | None) -> bool:
        """Return True for no error, or one named by the plan."""
        if emergency.code == NO_ERROR:
            return True
        if zero is None:
            return False
        elapsed = Duration(emergency.at - zero)
        return any(named.explains(emergency, elapsed) for named in self._named)

    def _note(self, name: str, **notes: Any) -> None:
        self._ends[name] = replace(self._ends[name], **notes)


class NamedEmergency(NamedTuple):
    """An EMCY caused by a drive fault of a plan."""

    nodes: tuple[int, ...]
    """Nodes; empty: any."""
    code: int
    from_ns: Duration
    """Since the run began."""
    until_ns: Duration | None

    def explains(self, emergency: Emergency, elapsed: Duration) -> bool:
        """Return True if it is this one, ``elapsed`` after the run began."""
        inside = self.from_ns <= elapsed and (self.until_ns is None or elapsed < self.until_ns)
        mine = not self.nodes or emergency.node_id in self.nodes
        return inside and mine and emergency.code == self.code


def named_emergencies(faults: Faults | None) -> Iterator[NamedEmergency]:
    """Yield the EMCYs caused by the drive faults of a plan or of a recorded run, with their times."""
    if faults is None:
        return
    if isinstance(faults, FaultPlan):
        for fault in faults.node_faults:
            if isinstance(fault, DriveFault):
                yield _named(fault)
        return
    for entry in faults.entries:
        if entry.kind == DriveFault.kind:
            first = Duration(entry.at_ns + entry.b)
            last = Duration(first + TOLD_WITHIN)
            yield NamedEmergency((entry.link,), FAILURES[entry.a].code, first, last)


def made_twice(faults: Faults | None) -> set[Foreign]:
    """Return the foreign frame kinds that duplicates of a plan, or of a recorded run, resemble: a drive that
    hears a SYNC or a request twice answers twice."""
    if faults is None:
        return set()
    if isinstance(faults, FaultPlan):
        struck = [fault for fault in faults.faults if fault.kind == Duplicate.kind]
        ids = {can_id for can_id in COB_IDS["all"] for fault in struck if _selects(fault, can_id)}
    else:
        ids = {entry.can_id for entry in faults.entries if entry.kind == Duplicate.kind}
    looks: dict[Foreign, tuple[str, ...]] = {"tpdo": ("pdo", "sync"), "sdo_answer": ("sdo",)}
    return {kind for kind, names in looks.items() if any(ids & {*COB_IDS[name]} for name in names)}


def _selects(fault: FrameFault, can_id: int) -> bool:
    return any(fault.selects(direction, can_id) for direction in Direction)


def _named(fault: DriveFault) -> NamedEmergency:
    first, last = fault.from_ns, fault.until_ns
    if fault.at_ns is not None:
        first = last = fault.at_ns
    later = fault.detected_after_ns + TOLD_WITHIN
    until = None if last is None else Duration(last + later)
    return NamedEmergency(fault.nodes, fault.failure.code, Duration(first + fault.detected_after_ns), until)


def _cut_short(outcome: RunOutcome, reason: str, cause: VerdictKind) -> RunOutcome:
    return replace(outcome, completed=False, reason=reason, cause=cause)


def _label(state: State | None) -> str:
    return "unknown" if state is None else state.value


STOOD_STILL: Final = Duration(100 * NS_PER_MS)
"""Longer than any delay of a process on a machine fit for a bench; drives wait for their master's heartbeat
at least as long."""
JUST_BEFORE: Final = Duration(NS_PER_S)
"""An end so soon after a standstill is caused by it: drives report its effect at once."""


class Standstill:
    """Standstills of the host of one world, where time passes by itself."""

    def __init__(
        self,
        world: World,
        period: Duration,
        tell: Callable[[str, str], None],
        asleep: Callable[[], Duration] = suspended,
    ) -> None:
        """``period``: of the cycles, between which ``attend`` is called. ``tell``: takes text and level of an
        event. ``asleep``: returns how long the machine has been suspended so far."""
        self._clock, self._real_time, self._tell = world.clock, world.real_time, tell
        self._every = max(PROGRESS_EVERY, period)
        self._attended_at: Instant | None = None
        self._asleep = asleep
        self._suspended = asleep()
        self._told_at, self._told = Instant(0), ""

    def attend(self) -> None:
        """Report how long nothing ran since the last call; from the first one on."""
        if not self._real_time:
            return
        now, asleep = self._clock.now(), self._asleep()
        since = self._attended_at or Instant(now - self._every)
        still, slept = now - since - self._every, asleep - self._suspended
        self._attended_at, self._suspended = now, asleep
        if max(still, slept) > STOOD_STILL:
            self._told_at = now
            self._told = f"this host stood still for {still / NS_PER_S:.2f} s"
            if slept > STOOD_STILL:
                self._told = f"this machine was suspended for {slept / NS_PER_S:.2f} s"
            self._tell(f"{self._told}: nothing was sent meanwhile", "WARN")

    def cure(self) -> str:
        """Say how to prevent a standstill, if one has just occurred; else empty."""
        self.attend()
        if not self._told or self._clock.now() - self._told_at > JUST_BEFORE:
            return ""
        cure = "prevent it from being suspended or stopped, and keep its processor free for the bench"
        return f"{self._told}: {cure}"
