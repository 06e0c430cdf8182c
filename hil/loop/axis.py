"""One axis of the loop: from its drive's readings to its next command, and the record of both."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from servobench.drivers.core.native import Stopwatch
from servobench.drivers.errors import LimitExceeded
from servobench.drivers.exchange import Drive, Reading
from servobench.drivers.record import replaced
from servobench.drivers.timebase import NEVER, NS_PER_US, Duration, Instant
from servobench.hil.loop.attribution import HELD_FOR, HELD_MAX
from servobench.hil.loop.beats import Beats
from servobench.hil.loop.clock_map import STAMP_RESOLUTION, Lessons
from servobench.hil.loop.command_meter import CommandMeter
from servobench.hil.loop.cycle_record import CycleRecord
from servobench.hil.loop.delay import Decision, Decisions, DelayMeter, Fate, Tick
from servobench.hil.loop.order_attribution import OrderAttribution
from servobench.hil.loop.protocol import Compensator, Context, Controller, LoadMachine
from servobench.hil.loop.readback_tie import ProvedChanges, ReadbackTie, Telling
from servobench.hil.loop.safety import SafetyGuard
from servobench.hil.loop.samples import CommandFate, Dropout, DropoutCause, Sending, without_sync
from servobench.hil.loop.scenario import Quantity, ReferenceProfile
from servobench.hil.loop.stamp_attribution import REVOKED, StampAttribution
from servobench.hil.loop.syncs import SyncLog, SyncMark
from servobench.hil.loop.way_back import WayBack

_SHOWN_BY_OTHERS: Final = (DropoutCause.LOST, DropoutCause.STALE)
"""Causes that the places of other readings show."""


@dataclass(frozen=True, slots=True)
class AxisParts:
    """Parts of an axis."""

    name: str
    drive: Drive
    controller: Controller
    compensator: Compensator
    guard: SafetyGuard
    """It makes the demands of the controller commands: of a torque, a speed or a position."""
    reference: ReferenceProfile
    """A position is counted from where the shaft is when the run begins."""
    load: ReferenceProfile
    """Torques that oppose positive speed."""
    load_machine: LoadMachine | None
    syncs: SyncLog
    """SYNCs of the axis's segment."""
    transit: Duration
    """The shortest time that a reading's frame takes on the wire."""
    deadline: Duration
    """Oldest usable age of a reading on arrival."""
    horizon: int
    """Cycles after which a reading or a command is lost."""
    tell: Callable[[str], None]
    """Takes what is to be said of the drive's clock."""
    status_timer: Duration = Duration(0)  # noqa: RUF009 - an int
    """The drive repeats its statusword so often, whatever the SYNCs do; 0: it comes with the readings."""
    stamp_resolution: Duration = STAMP_RESOLUTION
    """By how much the drive's stamp advances at a time."""
    stamped_at_arrival: bool = False
    """It is latched when a SYNC comes, before the drive samples."""
    acts_at_syncs: bool = False
    """The drive takes a command at the first SYNC after it came."""
    acts_later: Duration = Duration(0)  # noqa: RUF009 - an int
    """A command takes so much longer on this axis's segment than the loop reckons."""


class Axis:
    """State of one axis from cycle to cycle."""

    def __init__(
        self, number: int, parts: AxisParts, period: Duration, record: Callable[[CycleRecord], None]
    ) -> None:
        syncs = parts.syncs
        self.parts = parts
        self.meter = DelayMeter(parts.deadline, parts.horizon)
        self.commands = CommandMeter(parts.horizon, syncs, parts.acts_at_syncs)
        self.readbacks = ReadbackTie(syncs, period, parts.horizon)
        self._changes = ProvedChanges(REVOKED)
        self._number, self._period = number, period
        self._attribute()
        self._by_stamps = not self.by_stamp.stamps.too_coarse
        self._held_max = max(REVOKED, min(HELD_MAX, HELD_FOR // period))
        self._record = record
        self._asks_speeds = parts.reference.quantity is Quantity.SPEED
        self._asks_positions = parts.reference.quantity is Quantity.POSITION
        self._drive, self._controller, self._compensator = parts.drive, parts.controller, parts.compensator
        self._context = Context(period, parts.reference)
        self._way_back = WayBack(parts.reference, period, *parts.guard.path_limits)
        self._lap = Stopwatch().lap  # what compensator and controller take is real in any case
        self.uncertain = 0  # rows marked so
        self.lessons = Lessons(syncs)
        self._decisions, self._settled = Decisions(), Decisions()  # open: the readings' fates; the commands'
        self._load_nm, self._begun = 0.0, 0
        self._kept: list[Reading] = []  # readings that came and are not taken in yet, in their order

    def _attribute(self) -> None:
        """Nothing is known yet of the drive's clock and delays."""
        parts = self.parts
        seen = parts.syncs, self._period, parts.transit, parts.tell
        self.by_stamp = StampAttribution(*seen, parts.stamp_resolution, parts.stamped_at_arrival)
        self.by_order = OrderAttribution(*seen, Beats(self._period, parts.status_timer))
        self.by_order.copies.stamps = self.by_stamp.stamps

    @property
    def wants_probe(self) -> bool:
        """True if the next SYNC should go out a quarter of a period late: its reading shows whose it is."""
        return self.by_order.wants_probe or self.by_stamp.doubt.wants_probe

    def probed(self) -> None:
        """The last SYNC has gone out late."""
        self.by_stamp.doubt.probed()
        if self.by_order.wants_probe:
            self.by_order.probed(self.parts.syncs.marks[-1])

    def calibrate(self, mark: SyncMark) -> bool:
        """Take what has come since the SYNC of ``mark``, and learn from it if it can only answer that one;
        whether a reading came. To be called once for each SYNC."""
        readings = self._drive.take_readings()
        self._drive.take_readbacks()
        self._drive.take_demand_changes()
        self.readbacks.pass_over(len(readings))
        lesson = self.lessons.take(readings, mark)
        if lesson is not None:
            self._learn(lesson, mark)
        return bool(readings)

    def _learn(self, reading: Reading, mark: SyncMark) -> None:
        assert mark.on_bus_at is not None
        if self._by_stamps and self.lessons.stamp_stands_still:
            self._leave_stamps("stands still")
        if self._by_stamps and reading.device_time_ns is not None:
            self.by_stamp.learn(reading, mark)
            if self.by_stamp.stamps.too_coarse:
                self._leave_stamps()
        if not self._by_stamps or reading.device_time_ns is None:
            self.by_order.learn(reading, mark)
        self.meter.learn(Duration(reading.received_at - mark.on_bus_at))

    def _leave_stamps(self, why: str = "") -> None:
        self._by_stamps = self.by_stamp.clock.ready = False
        why = why or f"advances by {self.by_stamp.stamps.resolution // NS_PER_US} us"
        self.parts.tell(f"its stamp {why}: its readings are placed by their order")

    def learn_anew(self) -> None:
        """Learn again from what came while calibrating: the instants of its SYNCs are others now."""
        self._attribute()
        for reading, mark in self.lessons.pairs:
            self._learn(reading, mark)

    def discard(self) -> None:
        """Let go of what has come: it answers SYNCs from before."""
        kept, self._kept = [*self._kept, *self._drive.take_readings()], []
        self.readbacks.pass_over(len(kept))
        if kept:
            self.by_order.skip(kept[-1])
        self._drive.take_readbacks()
        self._drive.take_demand_changes()

    def reset(self) -> None:
        """The first cycle is about to begin."""
        if self._asks_positions or self.parts.guard.takes_positions:
            held_rad = self._drive.held_position_rad()
            self.parts.guard.start_from(held_rad)
            self.parts.reference.count_from(held_rad)
        self._compensator.reset()
        self._controller.reset()

    def begin(self, tick: Tick) -> None:
        """A SYNC has gone out, or was heard."""
        self._begun = tick.sequence
        decision = self._asked(tick)
        decision.mark = self.parts.syncs.last_of(tick.sequence)
        self._decisions.append(decision)
        self.meter.sync_sent(tick.sequence, tick.due_at, self.parts.syncs.heard_ns)

    def miss(self, tick: Tick) -> str | None:
        """A planned cycle goes without SYNC; why the run must stop after it, or None."""
        self._begun = tick.sequence
        self._decisions.append(self._asked(tick))
        self.meter.missed(tick.sequence, tick.due_at)
        self._context.dropouts += 1
        reason = self.parts.guard.miss_cycle()
        return None if reason is None else f"{self.parts.name}: {reason}"

    def collect(self, before: Instant = NEVER) -> None:
        """Take in what had arrived ``before``, but for readings whose SYNC's echo may be on its way yet, and
        for those that may answer a SYNC whose cycle is to begin."""
        kept, syncs = self._kept, self.parts.syncs
        came = self._drive.take_readings() if self._drive.has_readings() else kept
        if not (came or kept):
            return
        before = min(before, syncs.end_of_first_after(self._begun))
        at = came[0].received_at if len(came) == 1 and not kept else NEVER
        if at < before and not syncs.awaits_echo(at):  # nearly always: it needs no way through the list
            self._take(came[0])
            return
        if came is not kept:
            kept.extend(came)
        while kept and kept[0].received_at < before and not syncs.awaits_echo(kept[0].received_at):
            self._take(kept.pop(0))

    def _collect_demands(self, *, at_end: bool) -> None:
        """Take in what the drive told of its torque demand."""
        tellings = self.readbacks.take(self._drive.take_readbacks(), at_end=at_end)
        self.commands.patient = self.readbacks.doubtful
        for change in self._changes.take(self._drive.take_demand_changes(), spread=self.by_stamp.spread):
            while tellings and tellings[0].received_at < change.received_at:
                self._take_telling(tellings.pop(0))
            at, error_ns = self.by_stamp.changed_at(change.device_time_ns)
            if at - error_ns <= change.received_at:
                self.commands.changed(change.demand_raw, at, error_ns)
        for telling in tellings:
            self._take_telling(telling)

    def has_expected(self, sequence: int, decide_after: Duration) -> bool:
        """Return whether nothing more is to be expected before the decision of this cycle: a reading that
        usually takes longer than until then is awaited in a later cycle."""
        overdue = self.meter.typical_delay - decide_after
        behind = -(-overdue // self._period) if overdue > 0 else 0
        return self.meter.newest >= sequence - behind

    def decide(self, tick: Tick, now: Instant, apply_at: Instant) -> None:
        """Compute, limit and send the command of this cycle."""
        parts, context, guard = self.parts, self._context, self.parts.guard
        apply_at = Instant(apply_at + parts.acts_later)
        decision = self._decisions.newest()
        self._apply_load(parts.load.value(tick.time_s))
        decision.load_torque_nm = self._load_nm
        fresh = len(context.samples) > 0
        context.begin(tick.sequence, tick.due_at, tick.time_s, decision.reference_rad_s, now, apply_at)
        if decision.reference_rad is not None:
            context.reference_rad = decision.reference_rad
        if decision.reference_nm is not None:
            context.reference_nm = decision.reference_nm
        context.follows = decision.follows = follows = self._drive.follows()
        if not follows or self._way_back.active:
            self._way_back.lead(context, tick.time_s)
        self._lap()
        context.estimate = estimate = self._compensator.estimate(context)
        demand = guard.demand(self._controller.output(context))
        took = self._lap()
        command = guard.command(tick.sequence, demand, apply_at, Instant(apply_at + self._period))
        self._check(guard.check_cycle(fresh, demand, estimate))
        self._drive.check()
        sent = self._drive.write(command)
        if sent is not None:
            self.commands.sent(sent)
            context.sent = command
        acting = command if follows else guard.in_place_of(command, context.newest)
        self._lap()
        if sent is not None:
            self._compensator.sent(acting)
        self._controller.update(context, acting)
        decision.channels = self._controller.telemetry()
        decision.compute_ns = took + self._lap()
        context.samples.clear()
        decision.estimate = estimate
        decision.command = command
        decision.sent = sent

    def settle(self, now: int) -> None:
        """Record the cycles of which everything is known in cycle ``now``."""
        self._collect_demands(at_end=False)
        self._settle(now)

    def _settle(self, now: int) -> None:
        for fate in self.meter.settle(self.parts.syncs.heard_ns):
            self._hold(fate)
        settled = self._settled
        while (decision := settled.first) is not None:
            if now - decision.tick.sequence <= self._hold_cycles():
                return
            sending = None
            if decision.sent is not None:
                sending = self.commands.outcome(decision.tick.sequence, now)
                if sending is None:
                    return
            settled.take_first()
            self._finish(decision, sending)

    def settle_all(self, now: int) -> None:
        """End of the run: record what is left, with what is known; ``now``: beyond any horizon."""
        while self._kept:
            self._take(self._kept.pop(0))
        self._collect_demands(at_end=True)
        for fate in self.meter.settle_all(self.parts.syncs.heard_ns):
            if self._decisions.first is not None:
                self._hold(fate)
        self._settle(now)

    def _asked(self, tick: Tick) -> Decision:
        """A new cycle, and what is asked for in it."""
        reference = self.parts.reference
        asked = reference.value(tick.time_s)
        if self._asks_speeds:
            return Decision(tick, asked, self._load_nm)
        decision = Decision(tick, math.nan, self._load_nm)
        if self._asks_positions:
            decision.reference_rad_s, decision.reference_rad = reference.rate(tick.time_s), asked
        else:
            decision.reference_nm = asked
        return decision

    def _take(self, reading: Reading) -> None:
        by_stamp = self._by_stamps and reading.device_time_ns is not None
        question = self.by_stamp.question if by_stamp else self.by_order.question
        was_open, twice = question.open, self.by_stamp.health.duplicates + self.by_order.health.duplicates
        sample = self.by_stamp.place(reading) if by_stamp else self.by_order.place(reading)
        if by_stamp and sample is None and self.by_stamp.stamps.too_coarse:
            self._leave_stamps()
            for known, mark in [*self.lessons.pairs, *self.by_stamp.recent]:
                self.by_order.learn(known, mark)
            self._take(reading)
            return
        again = self.by_stamp.health.duplicates + self.by_order.health.duplicates > twice
        if by_stamp and (sample is not None or question.open) and not again:
            self._changes.reading(reading, certain=sample is not None and sample.certain)
        self.readbacks.reading(sample, reading.received_at, again or self.by_stamp.may_overtake)
        if question.cleared:
            question.cleared = False
            self.meter.forget_doubts()
        if question.open:
            newest = self.meter.newest
            if not was_open or question.left_open:
                self.meter.keep_doubts()
            self.meter.doubt(newest if question.since is None else question.since, max(newest, self._begun))
        if sample is None or not self.meter.arrived(sample):
            return
        self._check(self.parts.guard.check_speed(reading.velocity_rad_s))
        self._context.samples.append(sample)
        self._compensator.receive(sample)

    def _take_telling(self, telling: Telling) -> None:
        out_of_order = self.commands.out_of_order
        self.commands.told(telling.demand_raw, telling.since, telling.until, telling.sync)
        if self.commands.out_of_order > out_of_order:
            self.readbacks.doubt()

    def _hold_cycles(self) -> int:
        """How long a row waits, in cycles, for what may still become known of its reading."""
        if self.by_stamp.question.open or self.by_order.question.open:
            return self._held_max
        return REVOKED if self.by_stamp.spread else self.by_order.shown_later

    def _hold(self, fate: Fate) -> None:
        decision = self._decisions.take_first()
        decision.fate = fate
        self._settled.append(decision)

    def _finish(self, decision: Decision, sending: Sending | None) -> None:
        tick, fate, mark = decision.tick, decision.fate, decision.mark
        assert fate is not None
        if sending is not None and not decision.follows:
            sending = replaced(sending, fate=CommandFate.NOT_FOLLOWED, acts_after=None, acts_by=None)
        clock = self.by_stamp.clock
        observation = self.by_stamp.question.applied(fate.observation, fate.received_at)
        observation = self.by_order.question.applied(observation, fate.received_at)
        by_others = isinstance(observation, Dropout) and observation.cause in _SHOWN_BY_OTHERS
        if mark is not None and mark.unsent:
            mark, observation = None, without_sync(observation)
        unsure = mark is not None and (mark.late_to_drives or not mark.sure)
        if unsure or (by_others and self.meter.doubts(tick.sequence)):
            observation = replaced(observation, certain=False)
        self.uncertain += not observation.certain
        record = CycleRecord()
        record.sequence = tick.sequence
        record.axis = self._number
        record.due_at = tick.due_at
        record.woke_at = tick.woke_at
        record.sync_handed_at = None if mark is None else mark.handed_at
        record.sync_on_bus_at = None if mark is None else mark.on_bus_at
        record.observation = observation
        record.delay = fate.delay
        record.estimate = decision.estimate
        record.reference_rad_s = decision.reference_rad_s
        record.load_torque_nm = decision.load_torque_nm
        record.command = decision.command
        record.sending = sending
        record.clock_offset_ns = clock.offset_ns if clock.ready else None
        record.clock_error_ns = clock.error_ns if clock.ready else None
        record.compute_ns = decision.compute_ns
        record.channels = decision.channels
        record.reference_rad = decision.reference_rad
        record.reference_nm = decision.reference_nm
        self._record(record)

    def _apply_load(self, torque_nm: float) -> None:
        """A shaft that bears a load over time by itself has no load machine that is told."""
        if torque_nm != self._load_nm:
            self._load_nm = torque_nm
            if self.parts.load_machine is not None:
                self.parts.load_machine.set_torque(torque_nm)

    def _check(self, reason: str | None) -> None:
        if reason is not None:
            raise LimitExceeded(f"{self.parts.name}: {reason}", remedy="the drive is being brought to rest")
