"""What became of commands, from their echoes and from the torque demand that the drive tells."""

import random

import pytest

from servobench.drivers.exchange import SentCommand
from servobench.drivers.timebase import NS_PER_MS, Duration, Instant
from servobench.drivers.wire.frame_port import EchoBasis
from servobench.hil.loop.command_meter import CommandMeter
from servobench.hil.loop.delay import UNHEARD_MAX
from servobench.hil.loop.followed_command import PASSES_WATCHED
from servobench.hil.loop.samples import CommandFate, Sending
from servobench.hil.loop.syncs import SyncLog

HORIZON = 20
PERIOD = NS_PER_MS
HANDED, ON_BUS = 250_000, 340_000
AT_REST = 20_000
"""What the drive follows before the first command."""


def sync_at(number: int) -> Instant:
    return Instant(number * PERIOD)


def command(number: int, raw: int, on_bus: bool = True) -> SentCommand:
    sent = SentCommand(number, raw, Instant(sync_at(number) + HANDED))
    if on_bus:
        sent.on_bus_at = Instant(sync_at(number) + ON_BUS)
    return sent


def meter_on(echoes: EchoBasis, heard: int = 0) -> tuple[CommandMeter, SyncLog]:
    """A meter on a bus that was heard of until SYNC ``heard``."""
    syncs = SyncLog(Duration(0), Duration(PERIOD), echoes)
    syncs.heard(heard, sync_at(heard))
    return CommandMeter(HORIZON, syncs), syncs


def play(
    raws: list[int], acting: list[int | None], *, every: int = 1, silent: range = range(0)
) -> list[Sending]:
    """``acting[n]``: from which SYNC on command n is in force; None: lost. Told every ``every`` SYNCs, but
    for those of ``silent``."""
    meter, syncs = meter_on(EchoBasis.BUS)
    settled: list[Sending] = []
    waiting = list(range(len(raws)))
    for number in range(len(raws) + HORIZON + 1):
        in_force = [n for n, since in enumerate(acting) if since is not None and since <= number]
        mark = syncs.heard(number, sync_at(number)) if number else syncs.marks[-1]
        if number % every == 0 and number not in silent:
            meter.told(raws[max(in_force)] if in_force else AT_REST, sync_at(number), sync_at(number), mark)
        if number < len(raws):
            meter.sent(command(number, raws[number]))
        while waiting:
            outcome = meter.outcome(waiting[0], number)
            if outcome is None:
                break
            settled.append(outcome)
            waiting.pop(0)
    assert not waiting
    return settled


def fates(settled: list[Sending]) -> list[CommandFate]:
    return [outcome.fate for outcome in settled]


def test_a_command_acts_between_its_echo_and_the_next_sync() -> None:
    settled = play([1, 2, 3, 4], [1, 2, 3, 4])
    assert fates(settled) == [CommandFate.ACTING] * 4
    assert settled[2].acts_after == sync_at(2) + ON_BUS
    assert settled[2].acts_by == sync_at(3)


@pytest.mark.parametrize("lost", [(), (3, 30, 58), (59,)])
def test_a_change_after_commands_that_are_all_the_same_is_placed_between_two_syncs(
    lost: tuple[int, ...],
) -> None:
    """They outlast the horizon twice; which of them acts, and whether one was lost, cannot be seen."""
    raws = [7] * 60 + [8] + [7] * 30
    settled = play(raws, [None if number in lost else number + 1 for number in range(len(raws))])
    assert fates(settled)[1:60] == [CommandFate.NOT_IDENTIFIABLE] * 59
    for number, outcome in ((0, settled[0]), (60, settled[60]), (61, settled[61])):
        assert outcome.fate is CommandFate.ACTING
        assert (outcome.acts_after, outcome.acts_by) == (sync_at(number) + ON_BUS, sync_at(number + 1))


def test_a_command_that_is_passed_over_is_told_and_its_neighbours_are_not_blamed() -> None:
    """It may have acted for a moment after SYNC 3, before the next one came."""
    settled = play([1, 2, 3, 4, 5, 6], [1, 2, None, 4, 5, 6])
    unknown = CommandFate.NOT_IDENTIFIABLE
    assert fates(settled) == [unknown if number == 2 else CommandFate.ACTING for number in range(6)]
    assert (settled[2].acts_after, settled[2].acts_by) == (sync_at(3), None)


def test_what_was_followed_before_a_silence_longer_than_the_window_may_be_any_command_of_then() -> None:
    """The second acted, and was never told; the last of those lost equals it."""
    raws = [1, 2, *range(10, 38), 2, 3, 4]
    acting = [1, 2, *[None] * 29, 32, 33]
    settled = play(raws, acting, silent=range(2, 31))
    assert fates(settled)[1:31] == [CommandFate.NOT_IDENTIFIABLE] * 30
    assert fates(settled)[31:] == [CommandFate.ACTING] * 2


def test_a_delay_beyond_the_next_sync_is_seen_as_late_not_as_lost() -> None:
    count = 2 * PASSES_WATCHED
    settled = play(list(range(1, count + 1)), [number + 2 for number in range(count)])
    assert fates(settled) == [CommandFate.ACTING] * count
    assert settled[3].acts_after == sync_at(3) + ON_BUS, "the one before it may have come twice"
    assert settled[3].acts_by == sync_at(5)
    assert settled[-1].acts_after == sync_at(count), "it was there, and none acts as soon as that"


def test_a_command_that_comes_twice_bounds_no_other() -> None:
    """The drive follows 2 for a moment, then 1 that comes again, and 2 that does: as if 2 had been late."""
    settled = play([1, 2, 3], [1, 3, None])
    assert fates(settled)[1] is CommandFate.ACTING
    assert (settled[1].acts_after, settled[1].acts_by) == (sync_at(1) + ON_BUS, sync_at(3))


def test_an_echo_that_is_stamped_late_leaves_open_which_of_two_equal_commands_acts() -> None:
    """The echo of the second is stamped behind the change that it made."""
    meter, _ = meter_on(EchoBasis.KERNEL)
    meter.sent(command(0, 5))
    later = command(1, 5)
    later.on_bus_at = Instant(sync_at(1) + 900_000)
    meter.sent(later)
    meter.changed(5, Instant(sync_at(1) + ON_BUS), Duration(3_000))
    for number in (0, 1):
        outcome = meter.outcome(number, HORIZON + 1)
        assert outcome is not None
        assert outcome.fate is CommandFate.NOT_IDENTIFIABLE


def test_equal_commands_cannot_be_told_apart() -> None:
    settled = play([1, 1, 2, 2, 3], [1, 2, 3, 4, 5])
    assert fates(settled)[1] is CommandFate.NOT_IDENTIFIABLE
    assert fates(settled)[3] is CommandFate.NOT_IDENTIFIABLE
    assert fates(settled)[4] is CommandFate.ACTING


def test_a_first_command_that_equals_what_was_in_force_cannot_be_told_either() -> None:
    told = fates(play([AT_REST, 2, 3], [1, 2, 3]))
    assert told == [CommandFate.NOT_IDENTIFIABLE, CommandFate.ACTING, CommandFate.ACTING]


def test_a_drive_that_tells_nothing_leaves_it_unmeasured() -> None:
    meter, _ = meter_on(EchoBasis.BUS)
    meter.sent(command(0, 5))
    assert meter.outcome(0, 1) is None, "its echo may still come"
    outcome = meter.outcome(0, 2)
    assert outcome is not None
    assert outcome.fate is CommandFate.NOT_MEASURED
    assert outcome.on_bus_at == ON_BUS
    assert outcome.acts_by is None


def test_told_seldom_only_the_newest_command_before_is_judged() -> None:
    settled = play(list(range(1, 41)), [number + 1 for number in range(40)], every=4)
    seen = [number for number, outcome in enumerate(settled) if outcome.fate is CommandFate.ACTING]
    assert seen == list(range(3, 40, 4))
    assert CommandFate.LOST not in fates(settled)


def test_a_demand_that_no_command_asked_for_is_counted() -> None:
    meter, _ = meter_on(EchoBasis.BUS)
    meter.told(AT_REST, sync_at(0), sync_at(0))
    meter.sent(command(0, 5))
    meter.told(3, sync_at(1), sync_at(1))
    assert meter.unexplained == 1


def test_a_command_whose_echo_has_not_come_was_not_there() -> None:
    """A bus that stood still: command 1 had been handed over before SYNC 2, and lay there beyond SYNC 3."""
    meter, _ = meter_on(EchoBasis.BUS)
    meter.told(AT_REST, sync_at(0), sync_at(0))
    meter.sent(command(0, 10))
    meter.told(10, sync_at(1), sync_at(1))
    held_up = command(1, 11, on_bus=False)
    meter.sent(held_up)
    meter.told(10, sync_at(2), sync_at(2))
    meter.told(10, sync_at(3), sync_at(3))
    meter.sent(command(3, 12))
    held_up.on_bus_at = Instant(sync_at(3) + 100_000)
    meter.told(12, sync_at(4), sync_at(4))
    assert meter.outcome(0, 4) is not None
    outcome = meter.outcome(1, 4 + HORIZON)
    assert outcome is not None
    assert outcome.fate is CommandFate.NOT_IDENTIFIABLE, "it was replaced before the drive told, and not lost"


@pytest.mark.parametrize("telling", [False, True])
def test_a_command_that_never_came_to_the_bus_is_lost_once_the_bus_was_heard_beyond(telling: bool) -> None:
    meter, syncs = meter_on(EchoBasis.BUS)
    meter.sent(command(0, 10, on_bus=False))
    if telling:
        meter.told(AT_REST, sync_at(1), sync_at(1))
    assert meter.outcome(0, HORIZON + 1) is None, "the bus may stand still"
    for number in range(1, HORIZON + 1):
        syncs.heard(number, sync_at(number))
    outcome = meter.outcome(0, HORIZON + 1)
    assert outcome is not None
    assert outcome.fate is CommandFate.LOST


def test_a_bus_that_is_not_heard_of_again_leaves_it_open_what_became_of_a_command() -> None:
    meter, _ = meter_on(EchoBasis.BUS)
    meter.sent(command(0, 10, on_bus=False))
    assert meter.outcome(0, UNHEARD_MAX - 1) is None
    outcome = meter.outcome(0, UNHEARD_MAX)
    assert outcome is not None
    assert outcome.fate is CommandFate.NOT_MEASURED


@pytest.mark.parametrize("echoes", [EchoBasis.NONE, EchoBasis.KERNEL])
def test_where_an_echo_does_not_tell_its_frame_a_hand_over_counts(echoes: EchoBasis) -> None:
    """Of two equal frames the echo of one may have been taken for the other's."""
    meter, syncs = meter_on(echoes)
    meter.sent(command(0, 10, on_bus=False))
    meter.told(AT_REST, sync_at(0), sync_at(0))
    meter.told(10, sync_at(1), sync_at(1))
    syncs.heard(HORIZON + 1, sync_at(HORIZON + 1))
    outcome = meter.outcome(0, HORIZON + 1)
    assert outcome is not None
    assert outcome.fate is CommandFate.ACTING


@pytest.mark.long
@pytest.mark.parametrize("share", [0.0, 0.1, 0.4])
def test_the_rate_of_commands_passed_over_is_that_of_losses(share: float) -> None:
    choices = random.Random(7)
    raws = [choices.randint(-1000, 1000) for _ in range(4000)]
    acting = [None if choices.random() < share else number + 1 for number in range(4000)]
    told = fates(play(raws, acting))
    passed, acted = told.count(CommandFate.NOT_IDENTIFIABLE), told.count(CommandFate.ACTING)
    true = sum(since is None for since in acting) / len(acting)
    assert CommandFate.LOST not in told, "each may have acted between two SYNCs"
    assert passed / (passed + acted) == pytest.approx(true, abs=0.01)
    wrong = [n for n, fate in enumerate(told) if fate is CommandFate.ACTING and acting[n] is None]
    assert wrong == []


@pytest.mark.parametrize("heard", [True, False])
def test_a_command_may_have_acted_at_a_sync_of_another_that_was_not_heard(heard: bool) -> None:
    """A drive that takes set-points at SYNCs and tells before it takes: at SYNC 5 it would tell command 3."""
    syncs = SyncLog(Duration(0), Duration(PERIOD), EchoBasis.BUS)
    meter = CommandMeter(HORIZON, syncs, acts_at_syncs=True)
    for number in range(1, 9):
        if number != 5 or heard:
            mark = syncs.heard(number, sync_at(number))
            followed = 2 if number == 5 else number - 2
            meter.told(followed, sync_at(number), sync_at(number), mark)
        meter.sent(command(number, number))
    outcome = [meter.outcome(number, 8 + HORIZON) for number in range(1, 4)][-1]
    assert outcome is not None
    assert outcome.fate is (CommandFate.LOST if heard else CommandFate.NOT_IDENTIFIABLE)
