"""What is told of commands holds in every history that shows the drive as it was told, by enumeration.

Time is counted in quarters of a period: SYNCs end at 0, 4, 8 ..., command n is on the bus at 4 n + 1, and it
arrives up to a period and a half later, or never. Commands arrive in their order.
"""

import random
from functools import cache
from itertools import product

import pytest

from servobench.drivers.exchange import SentCommand
from servobench.drivers.timebase import NS_PER_US, Duration, Instant
from servobench.drivers.wire.frame_port import EchoBasis
from servobench.hil.loop.command_meter import CommandMeter
from servobench.hil.loop.samples import CommandFate, Sending
from servobench.hil.loop.syncs import SyncLog

TICK = 250 * NS_PER_US
PERIOD = 4
COMMANDS = 5
SYNCS = COMMANDS + 3
HORIZON = 20
DELAYS = (None, 0, 1, 2, 4, 5, 6)
"""From the bus to the drive; None: lost. None arrives at the very end of a SYNC."""
AT_REST = 9
DRAWS = 50

Times = tuple[int | None, ...]
"""Of each command; None: never."""


@cache
def histories(acts_at_syncs: bool) -> list[tuple[tuple[int, ...], Times]]:
    """The command in force at each SYNC, -1 before the first, and when each began to act."""
    found = []
    for delays in product(DELAYS, repeat=COMMANDS):
        came = [None if d is None else PERIOD * n + 1 + d for n, d in enumerate(delays)]
        times = [at for at in came if at is not None]
        if times == sorted(set(times)):
            found.append(_history(came, acts_at_syncs))
    return found


def _history(came: list[int | None], acts_at_syncs: bool) -> tuple[tuple[int, ...], Times]:
    def newest_by(at: int) -> int:
        return max((n for n, arrival in enumerate(came) if arrival is not None and arrival <= at), default=-1)

    shown = [newest_by(PERIOD * sync) for sync in range(-1, SYNCS)]
    if not acts_at_syncs:
        return tuple(shown[1:]), tuple(came)
    began = [shown[1:].index(n) * PERIOD if n in shown[1:] else None for n in range(COMMANDS)]
    return tuple(shown[:-1]), tuple(began)  # told before it is taken


def tell(raws: list[int], shown: tuple[int, ...], seen: list[bool], acts_at_syncs: bool) -> list[Sending]:
    syncs = SyncLog(Duration(0), Duration(PERIOD * TICK), EchoBasis.BUS)
    meter = CommandMeter(HORIZON, syncs, acts_at_syncs)
    settled: list[Sending] = []
    for number in range(SYNCS + HORIZON + 1):
        if number < SYNCS:
            at = Instant(number * PERIOD * TICK)
            mark = syncs.heard(number, at)
            if seen[number]:
                in_force = shown[number]
                meter.told(AT_REST if in_force < 0 else raws[in_force], at, at, mark)
        if number < COMMANDS:
            sent = SentCommand(number, raws[number], Instant(number * PERIOD * TICK + 1))
            sent.on_bus_at = Instant((number * PERIOD + 1) * TICK)
            meter.sent(sent)
        while len(settled) < COMMANDS and (outcome := meter.outcome(len(settled), number)) is not None:
            settled.append(outcome)
    assert len(settled) == COMMANDS
    return settled


def holds(outcome: Sending, acts_at: int | None) -> bool:
    """Whether what is told is so in a history in which the command acts then."""
    if outcome.fate is CommandFate.LOST:
        return acts_at is None
    if outcome.fate is not CommandFate.ACTING:
        return True
    assert outcome.acts_after is not None
    assert outcome.acts_by is not None
    return acts_at is not None and outcome.acts_after <= acts_at * TICK <= outcome.acts_by


@pytest.mark.long
@pytest.mark.parametrize("acts_at_syncs", [False, True])
def test_what_is_told_holds_in_every_history_that_shows_the_same(acts_at_syncs: bool) -> None:
    choices = random.Random(5)
    counts = dict.fromkeys(CommandFate, 0)
    for _ in range(DRAWS):
        values = choices.choice([3, 6, 100])
        raws = [choices.randint(10, 10 + values) for _ in range(COMMANDS)]
        seen = [number == 0 or choices.random() < choices.choice([0.6, 1.0]) for number in range(SYNCS)]
        true, _acts = choices.choice(histories(acts_at_syncs))

        def shows(shown: tuple[int, ...], raws: list[int] = raws, seen: list[bool] = seen) -> list[int]:
            return [AT_REST if n < 0 else raws[n] for n, known in zip(shown, seen, strict=True) if known]

        told = tell(raws, true, seen, acts_at_syncs)
        same = [acts for shown, acts in histories(acts_at_syncs) if shows(shown) == shows(true)]
        for number, outcome in enumerate(told):
            counts[outcome.fate] += 1
            assert all(holds(outcome, acts[number]) for acts in same), (number, outcome)
    assert counts[CommandFate.ACTING] > 0.4 * DRAWS * COMMANDS, "it is not silence that holds"
    assert (counts[CommandFate.LOST] > 0) is acts_at_syncs
