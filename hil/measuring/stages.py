"""The stages of a cycle as distributions, and the fates of frames on each path, from the rows of a run.

tick   woke    SYNC            sampled   received  in the loop   decision    command         acting
 |------|-------|--------------|---------|---------|.............|-----------|---------------|----------->
 wake-up  SYNC on    sample     reception  to user               computation  command on     command
 lateness the bus                          code                               the bus        acting

Takes the loop's own times: around the drive, and at the beginning of a decision.
"""

from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.exchange import Command, Drive, Readback, Reading, SentCommand
from servobench.drivers.timebase import Clock, Instant
from servobench.drivers.wire.frame_port import EchoBasis
from servobench.hil.control.compensation import Arrival
from servobench.hil.loop.clock_map import ClockMap
from servobench.hil.loop.cycle_record import CAUSES, COMMAND_FATES, FATE_SAMPLE, NOTHING
from servobench.hil.loop.protocol import Compensator, Context
from servobench.hil.loop.samples import CommandFate, DropoutCause, Sample, StateEstimate
from servobench.hil.measuring.loss_model import CAME, LOST, UNKNOWN, Outcomes
from servobench.hil.reviewing.histogram import TimeHistogram
from servobench.hil.reviewing.network_meter import action_delays_ns, passed_over
from servobench.hil.rows.records import Rows

BEFORE_NS: Final = 2_000
"""A demand that changed this shortly before its command was on the bus belongs to it: a stamp of 1013h is
rounded down to a microsecond, and the map of the clock errs by as much. An earlier change belongs to another
command."""


class TimedDemandChange(NamedTuple):
    """A change of torque demand reported by a drive, on the host's clock."""

    demand_raw: int
    at: Instant
    error_ns: int
    """Error of the map of the drive's clock."""


class ProbedDrive(Drive):
    """The drive of an axis, noting when the loop took readings and sent commands."""

    def __init__(self, drive: ServoDrive, clock: Clock) -> None:
        self.drive = drive
        self.map: ClockMap | None = None
        """Map of the drive's clock; None for a drive whose demand changes are not placed."""
        self.to_user_code_ns: list[int] = []
        """From the bus stamp of each reading until the loop has it."""
        self.computation_ns: list[int] = []
        """From the beginning of each decision until its command is handed over."""
        self.sent: list[SentCommand] = []
        """Every command; its echo may still come."""
        self.changes: list[TimedDemandChange] = []
        self.decision = DecisionProbe(clock)
        self._now = clock.now

    def begin(self) -> None:
        """Discard everything before the first cycle."""
        for notes in (self.to_user_code_ns, self.computation_ns, self.sent, self.changes):
            notes.clear()
        self.drive.take_demand_changes()

    def take_readings(self) -> list[Reading]:
        readings = self.drive.take_readings()
        if readings:
            now = self._now()
            self.to_user_code_ns += [now - reading.received_at for reading in readings]
        if self.map is not None and self.map.ready:
            for change in self.drive.take_demand_changes():
                at = self.map.place(change.device_time_ns)
                self.changes.append(TimedDemandChange(change.demand_raw, at, self.map.error_ns))
        return readings

    def take_readbacks(self) -> list[Readback]:
        return self.drive.take_readbacks()

    def write(self, command: Command) -> SentCommand | None:
        sent = self.drive.write(command)
        if sent is not None:
            self.sent.append(sent)
            self.computation_ns.append(sent.handed_at - self.decision.began_at)
        return sent

    def check(self) -> None:
        self.drive.check()


class DecisionProbe(Compensator):
    """A compensator: the newest sample at once; it notes when a decision began by requesting it."""

    def __init__(self, clock: Clock) -> None:
        self.began_at = Instant(0)
        self._now = clock.now
        self._arrival = Arrival()

    def receive(self, sample: Sample) -> None:
        """Take a sample; see :class:`servobench.hil.control.compensation.Arrival`."""
        self._arrival.receive(sample)

    def estimate(self, context: Context) -> StateEstimate:
        """Return the estimate; see :class:`servobench.hil.control.compensation.Arrival`."""
        self.began_at = self._now()
        return self._arrival.estimate(context)


def acting(sent: Sequence[SentCommand], changes: Sequence[TimedDemandChange]) -> dict[int, TimedDemandChange]:
    """Return by cycle when its command began to act.

    A change belongs to the newest command of its value under way then. Values repeat only after many cycles,
    see :class:`servobench.hil.measuring.subject.Excitation`; a command late by as many counts as the later
    one. A value reported twice for one command counts the first time.
    """
    by_value: dict[int, list[SentCommand]] = {}
    for command in sent:
        by_value.setdefault(command.raw, []).append(command)
    began: dict[int, TimedDemandChange] = {}
    for change in changes:
        candidates = by_value.get(change.demand_raw, [])
        place = bisect_right(candidates, change.at + BEFORE_NS + change.error_ns, key=on_its_way)
        if place:
            began.setdefault(candidates[place - 1].sequence, change)
    return began


def on_its_way(command: SentCommand) -> int:
    """Return when it was on the bus, or at least handed over."""
    return command.handed_at if command.on_bus_at is None else command.on_bus_at


NO_ECHO: Final = "no echo of own frames on this bus"
NOT_ENABLED: Final = "the drive is disabled: --enable"
NO_CLOCK: Final = "the drive puts no stamp (1013h) beside its speed"
NO_DEMAND: Final = "the drive does not tell its torque demand (6074h)"
ECHOES: Final = {
    EchoBasis.RECEIPT: "echo, stamped when this process received it",
    EchoBasis.KERNEL: "echo with the kernel's stamp",
    EchoBasis.HARDWARE: "echo with the adapter's stamp",
    EchoBasis.BUS: "echo with the end of the frame",
}
_LOST: Final = 1 + CAUSES.index(DropoutCause.LOST)
_MISSED: Final = 1 + CAUSES.index(DropoutCause.MISSED)
_ACTING: Final = COMMAND_FATES.index(CommandFate.ACTING)
_COMMAND_LOST: Final = COMMAND_FATES.index(CommandFate.LOST)

Times = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Stage:
    """One stage."""

    key: str
    title: str
    times: TimeHistogram
    """Empty: not measured."""
    basis: str
    """How it is known, or why it is not."""

    @property
    def measured(self) -> bool:
        """True if there is at least one time."""
        return self.times.total > 0


def stage(key: str, title: str, times_ns: Times | Sequence[int], basis: str) -> Stage:
    """Make a stage from all of its times."""
    histogram = TimeHistogram()
    histogram.add(np.asarray(times_ns, np.int64))
    return Stage(key, title, histogram, basis)


def host_stages(rows: Rows, echoes: EchoBasis) -> list[Stage]:
    """Return the stages of the host alone. ``rows``: of one axis."""
    woke = rows[rows["woke_at"] != NOTHING]
    on_bus = rows[(rows["sync_on_bus_at"] != NOTHING) & (echoes is not EchoBasis.NONE)]
    return [
        stage("wake_up", "wake-up lateness", woke["woke_at"] - woke["due_at"], "the host's clock"),
        stage(
            "sync_on_bus",
            "SYNC on the bus",
            on_bus["sync_on_bus_at"] - on_bus["sync_handed_at"],
            ECHOES.get(echoes, NO_ECHO),
        ),
    ]


def reading_stages(rows: Rows, to_user_code_ns: Sequence[int]) -> list[Stage]:
    """Return the stages from the SYNC on the bus until the loop has the reading, for one axis."""
    came = rows[(rows["fate"] == FATE_SAMPLE) & (rows["certain"] == 1) & (rows["sync_on_bus_at"] != NOTHING)]
    stamped = came[came["device_time_ns"] != NOTHING]
    received = rows[(rows["delay_ns"] != NOTHING) & (rows["certain"] == 1)]
    late = stamped["sampled_at"] - stamped["sync_on_bus_at"]
    basis = "what varies of it, by the drive's stamp 1013h" if late.size else NO_CLOCK
    by = "from the SYNC at the drive" if late.size else "from the SYNC on the bus"
    return [
        stage("sample", "sample", late, basis),
        stage("reception", "reception", received["delay_ns"], f"{by} to the frame's bus stamp"),
        stage("to_user_code", "reception to user code", to_user_code_ns, "the host's clock"),
    ]


def command_stages(
    rows: Rows,
    sent: Sequence[SentCommand],
    changes: Mapping[int, TimedDemandChange],
    computation_ns: Sequence[int],
    echoes: EchoBasis,
    why_not: str,
) -> list[Stage]:
    """Return the stages from the decision until the command acts, for one axis.

    ``changes``: by cycle, when its command began to act, see :func:`servobench.hil.measuring.stages.acting`;
    without any the rows bracket it by SYNCs. ``why_not``: reason if it cannot be measured.
    """
    echoed = [command for command in sent if command.on_bus_at is not None]
    on_bus = [command.on_bus_at - command.handed_at for command in echoed if command.on_bus_at is not None]
    stages = [
        stage("computation", "computation", computation_ns, "the host's clock, this loop's decision"),
        stage("command_on_bus", "command on the bus", on_bus, ECHOES.get(echoes, NO_ECHO)),
    ]
    since = "the command on the bus" if echoed else "handing the command over"
    if changes:
        there = {command.sequence: on_its_way(command) for command in sent}
        acting = [change.at - there[sequence] for sequence, change in changes.items()]
        basis = f"6074h and 1013h on change, from {since}"
        stages.append(stage("command_acting", "command acting", acting, basis))
    else:
        least, most = _brackets(rows)
        basis = f"6074h with the SYNC, from {since}" if most.size else why_not
        if most.size:
            stages.append(stage("command_acting_least", "command acting, at least", least, basis))
        stages.append(
            stage("command_acting", "command acting, at most" if most.size else "command acting", most, basis)
        )
    _, whole = action_delays_ns(rows[rows["fate"] == FATE_SAMPLE], _period_ns(rows))
    basis = "the most that it may be" if whole.size else why_not
    stages.append(stage("sample_to_acting", "sample to acting", whole, basis))
    return stages


def refined(rows: Rows, changes: Mapping[int, TimedDemandChange], sent: Sequence[SentCommand]) -> Rows:
    """Return rows with better knowledge: when a command acted, and the action of one that seemed lost.

    A command whose fate was not identifiable stays so, even if it is known to have acted: there is no such
    evidence for those that did not act, and the rate of losses would be too small.
    """
    better, passed = rows.copy(), passed_over(rows)
    place_of = {int(sequence): place for place, sequence in enumerate(better["sequence"])}
    for command in sent:
        if command.on_bus_at is not None:
            better["command_on_bus_at"][place_of[command.sequence]] = command.on_bus_at
    for sequence, change in changes.items():
        place = place_of[sequence]
        if better["command_fate"][place] in (_ACTING, _COMMAND_LOST) or passed[place]:
            better["command_fate"][place] = _ACTING
            there = max(better["command_on_bus_at"][place], better["command_handed_at"][place])
            better["command_acts_after"][place] = max(there, change.at - change.error_ns)
            better["command_acts_by"][place] = max(there, change.at + change.error_ns)
    return better


def ways(rows: Rows, echoes: EchoBasis, *, acting: bool) -> dict[str, Outcomes]:
    """Return the fates of the frames of each cycle on each path; ``rows``: refined, of one axis.

    A reading with an uncertain SYNC still counts as received: the cycle of a loss may be wrong, the number is
    not. ``acting``: True if the drive reports which command it follows.
    """
    echoed = echoes is not EchoBasis.NONE
    handed, on_bus = rows["sync_handed_at"] != NOTHING, rows["sync_on_bus_at"] != NOTHING
    sent, there = rows["command_handed_at"] != NOTHING, rows["command_on_bus_at"] != NOTHING
    reading = _outcomes(rows["fate"] != _MISSED, rows["fate"] == _LOST)
    fate = rows["command_fate"]
    lost = (fate == _COMMAND_LOST) | passed_over(rows)
    identified = (fate == _ACTING) | lost
    command = _outcomes(identified & acting, lost)
    behind, of_reading = command.copy(), reading.copy()
    if echoed:
        behind[~there] = UNKNOWN
        command[sent & ~there] = LOST
        of_reading[~on_bus] = UNKNOWN
    return {
        "sync_before_bus": _outcomes(handed & echoed, ~on_bus),
        "reading": of_reading,
        "command_before_bus": _outcomes(sent & echoed, ~there),
        "command_behind_bus": behind,
        "readings": reading,
        "commands": command if acting else _outcomes(np.zeros(rows.size, bool), identified),
    }


WAYS: Final = {
    "sync_before_bus": "SYNC, before the bus",
    "reading": "reading, or its SYNC behind the bus",
    "command_before_bus": "command, before the bus",
    "command_behind_bus": "command, behind the bus",
}
"""Distinguishable losses; ``readings`` and ``commands`` are the whole of each."""


def _outcomes(known: NDArray[np.bool_], lost: NDArray[np.bool_]) -> Outcomes:
    return np.where(known, np.where(lost, LOST, CAME), UNKNOWN).astype(np.int8)


def _brackets(rows: Rows) -> tuple[Times, Times]:
    """Return the lower and upper bound of the time from a command under way until it acted, ns."""
    acting = rows[rows["command_fate"] == _ACTING]
    there = np.maximum(acting["command_on_bus_at"], acting["command_handed_at"])
    return acting["command_acts_after"] - there, acting["command_acts_by"] - there


def _period_ns(rows: Rows) -> int:
    return int(np.diff(rows["due_at"]).min()) if rows.size > 1 else 1
