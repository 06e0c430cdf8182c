"""What a run told of its commands, held against the truth."""

from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from servobench.drivers.timebase import NS_PER_US, Duration, Instant
from tests.truth.judge import EXAMPLES_MAX, NO_TIME
from tests.truth.rows import (
    ACTING,
    COMMAND_LOST,
    NO_INSTANT,
    NOT_IDENTIFIABLE,
    NOT_MEASURED,
    NOT_SENT,
    Told,
    each_row,
)
from tests.truth.truth import AxisTruth, CommandTruth

INSTANT_TOLERANCE: Final = Duration(100 * NS_PER_US)
"""How far the interval in which a command is told to act may be from the truth, if nothing else is asked."""

_OPEN: Final = (NOT_MEASURED, NOT_IDENTIFIABLE)
_WORDS: Final = {COMMAND_LOST: "lost", ACTING: "acting", NOT_SENT: "not sent"}


@dataclass(slots=True)
class CommandJudgement:
    """Of one axis, or of several added up."""

    handed: int = 0
    lost: int = 0
    """In truth, on the way or replaced before they acted."""
    told_acting: int = 0
    told_lost: int = 0
    told_passed: int = 0
    """Told to have been passed over: lost, or followed between two SYNCs only."""
    wrong: int = 0
    """Told lost and acted, told acting and were lost, or told not sent and went out."""
    unknown: int = 0
    """Told, and the truth knows of none that was handed over then."""
    outside: int = 0
    """Told acting in an interval that the truth is not in, by more than the tolerance."""
    echo_wrong: int = 0
    """Instants of commands on the bus that are told and wrong."""
    true_delays_ns: list[int] = field(default_factory=list)
    """Hand-over to acting, of those told acting that did."""
    told_delays_ns: list[int] = field(default_factory=list)
    """The same as told: to the middle of the interval."""
    examples: list[str] = field(default_factory=list)
    """Of what is wrong, told in words."""

    def add(self, other: "CommandJudgement") -> None:
        """Take ``other`` in."""
        self.true_delays_ns += other.true_delays_ns
        self.told_delays_ns += other.told_delays_ns
        self.examples = (self.examples + other.examples)[:EXAMPLES_MAX]
        for name in (
            "handed",
            "lost",
            "told_acting",
            "told_lost",
            "told_passed",
            "wrong",
            "unknown",
            "outside",
            "echo_wrong",
        ):
            setattr(self, name, getattr(self, name) + getattr(other, name))

    @property
    def true_loss_percent(self) -> float:
        """Of all that were handed over."""
        return 100.0 * self.lost / max(1, self.handed)

    @property
    def told_loss_percent(self) -> tuple[float, float]:
        """The least and the most, of those told one way or the other; NaN if none was."""
        told = self.told_acting + self.told_lost + self.told_passed
        if not told:
            return float("nan"), float("nan")
        return 100.0 * self.told_lost / told, 100.0 * (self.told_lost + self.told_passed) / told

    def delay_us(self, percentile: float) -> tuple[float, float]:
        """As told, and in truth."""
        if not self.true_delays_ns:
            return float("nan"), float("nan")
        told, true = (
            float(np.percentile(delays, percentile)) / NS_PER_US
            for delays in (self.told_delays_ns, self.true_delays_ns)
        )
        return told, true


def judge_commands(
    told: Told,
    truth: AxisTruth,
    tolerance: Duration = INSTANT_TOLERANCE,
    stamp_error: Duration | None = NO_TIME,
) -> CommandJudgement:
    """Every command of one axis. ``tolerance``: how far the truth may be outside of an interval;
    ``stamp_error``: see :class:`.judge.Timing`."""
    result = CommandJudgement()
    newest = int(told["command_handed_at"].max()) if told.size else NO_INSTANT
    at_once = {at: iter(commands) for at, commands in truth.at_once.items()}
    for row in each_row(told):
        handed_at, fate = int(row["command_handed_at"]), int(row["command_fate"])
        if handed_at == NO_INSTANT:
            continue
        command = next(at_once.get(handed_at, iter(())), truth.commands.get(handed_at))
        if command is not None:
            _judge(result, row, command, tolerance, stamp_error)
        elif fate != NOT_SENT:
            # The last one may wait for room when the run ends, and give way to what stops the drive.
            result.unknown += handed_at < newest or fate not in _OPEN
    return result


def _judge(
    result: CommandJudgement,
    row: Any,
    command: CommandTruth,
    tolerance: Duration,
    stamp_error: Duration | None,
) -> None:
    """A command that went out."""
    fate, on_bus_at = int(row["command_fate"]), int(row["command_on_bus_at"])
    result.handed += 1
    result.lost += command.acts_at is None
    wrongly = {COMMAND_LOST: command.acts_at is not None, ACTING: command.acts_at is None, NOT_SENT: True}
    if wrongly.get(fate):
        result.wrong += 1
        _keep_example(result, row, _WORDS[fate], command)
    # Of two equal frames the echo does not say whose it is.
    if fate != NOT_IDENTIFIABLE and stamp_error is not None and on_bus_at != NO_INSTANT:
        result.echo_wrong += command.on_bus_at is None or abs(on_bus_at - command.on_bus_at) > stamp_error
    if fate == COMMAND_LOST:
        result.told_lost += 1
    elif fate == NOT_IDENTIFIABLE:
        result.told_passed += int(row["command_acts_after"]) != NO_INSTANT
    elif fate == ACTING:
        result.told_acting += 1
        if command.acts_at is not None:
            _judge_interval(result, row, command, command.acts_at, tolerance)


def _judge_interval(
    result: CommandJudgement, row: Any, command: CommandTruth, acts_at: Instant, tolerance: Duration
) -> None:
    """Of a command that is told acting, and did at ``acts_at``."""
    after, by = int(row["command_acts_after"]), int(row["command_acts_by"])
    if not after - tolerance <= acts_at <= by + tolerance:
        result.outside += 1
        _keep_example(result, row, f"acting between {after} and {by}", command)
    result.true_delays_ns.append(acts_at - command.handed_at)
    result.told_delays_ns.append((after + by) // 2 - command.handed_at)


def _keep_example(result: CommandJudgement, row: Any, told: str, command: CommandTruth) -> None:
    result.examples = [
        *result.examples,
        f"axis {row['axis']}, cycle {row['sequence']}: command handed over {command.handed_at}: told {told},"
        f" by its echo {row['command_on_bus_at']}; in truth on the bus {command.on_bus_at},"
        f" acts {command.acts_at}",
    ][:EXAMPLES_MAX]
