"""What a run told of its commands, held against the truth."""

from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from drivers.timebase import NS_PER_US, Duration
from tests.truth.judge import EXAMPLES_MAX, NO_TIME
from tests.truth.rows import ACTING, COMMAND_LOST, NO_INSTANT, NOT_IDENTIFIABLE, Told
from tests.truth.truth import AxisTruth, CommandTruth

INSTANT_TOLERANCE: Final = Duration(100 * NS_PER_US)
"""How far the interval in which a command is told to act may be from the truth, if nothing else is asked."""


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
    """Told lost and acted, or told acting and were lost."""
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
    for row in told:
        handed_at = int(row["command_handed_at"])
        if handed_at == NO_INSTANT:
            continue
        command = truth.commands.get(handed_at)
        if command is None:
            result.unknown += 1
            continue
        result.handed += 1
        result.lost += command.acts_at is None
        on_bus_at = int(row["command_on_bus_at"])
        fate = int(row["command_fate"])
        if (fate == COMMAND_LOST and command.acts_at is not None) or (
            fate == ACTING and command.acts_at is None
        ):
            result.wrong += 1
            _keep_example(result, row, "lost" if fate == COMMAND_LOST else "acting", command)
        if (
            fate != NOT_IDENTIFIABLE and stamp_error is not None
        ):  # of two equal frames the echo does not say whose it is
            result.echo_wrong += on_bus_at != NO_INSTANT and (
                command.on_bus_at is None or abs(on_bus_at - command.on_bus_at) > stamp_error
            )
        if fate == COMMAND_LOST:
            result.told_lost += 1
        elif fate == NOT_IDENTIFIABLE:
            result.told_passed += int(row["command_acts_after"]) != NO_INSTANT
        elif fate == ACTING:
            result.told_acting += 1
            if command.acts_at is None:
                continue
            after, by = int(row["command_acts_after"]), int(row["command_acts_by"])
            inside = after - tolerance <= command.acts_at <= by + tolerance
            result.outside += not inside
            if not inside:
                _keep_example(result, row, f"acting between {after} and {by}", command)
            result.true_delays_ns.append(command.acts_at - handed_at)
            result.told_delays_ns.append((after + by) // 2 - handed_at)
    return result


def _keep_example(result: CommandJudgement, row: Any, told: str, command: CommandTruth) -> None:
    result.examples = [
        *result.examples,
        f"axis {row['axis']}, cycle {row['sequence']}: command handed over {command.handed_at}: told {told},"
        f" by its echo {row['command_on_bus_at']}; in truth on the bus {command.on_bus_at},"
        f" acts {command.acts_at}",
    ][:EXAMPLES_MAX]
