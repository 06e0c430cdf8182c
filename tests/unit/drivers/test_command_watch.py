"""Whether a drive follows its commands, by what it tells."""

import random

import pytest

from servobench.drivers.cia402.command_watch import (
    ACTUAL_MARGIN_RAW,
    ACTUAL_SHARE,
    DEMAND_MARGIN_RAW,
)
from servobench.drivers.core.native import TOLD_THE_SAME, CommandWatch

CYCLES, HALF = 20, 10


def run(watch: CommandWatch, commands: list[int], told: list[int]) -> int | None:
    """Command and telling of each cycle; the first cycle in which the watch gave up."""
    for cycle, (command, shown) in enumerate(zip(commands, told, strict=True)):
        watch.sent(command)
        watch.told(shown)
        if not watch.follows:
            return cycle
    return None


def drawn(count: int, seed: int = 1) -> list[int]:
    random.seed(seed)
    return [random.randint(-1000, 1000) for _ in range(count)]


@pytest.mark.parametrize("delay", [0, 1, HALF - 1])
def test_a_drive_that_follows_late_is_left_alone(delay: int) -> None:
    commands = drawn(500)
    told = [commands[max(0, cycle - delay)] for cycle in range(500)]
    assert run(CommandWatch(CYCLES, 0), commands, told) is None


def test_a_drive_that_hears_nothing_any_more_is_noticed_within_the_cycles() -> None:
    commands = drawn(500)
    told = [commands[min(cycle, 200)] for cycle in range(500)]
    # The command of cycle 200 is among the last ten until cycle 209; ten more go by unfollowed.
    assert run(CommandWatch(CYCLES, 0), commands, told) == 200 + CYCLES - 1


def test_every_tenth_command_lost_is_borne() -> None:
    commands = drawn(20_000)
    random.seed(2)
    told, held = [], 0
    for command in commands:
        held = held if random.random() < 0.1 else command
        told.append(held)
    assert run(CommandWatch(CYCLES, 0), commands, told) is None


def test_commands_that_stay_the_same_prove_nothing() -> None:
    assert run(CommandWatch(CYCLES, 0), [7] * 500, [7] * 500) is None
    assert run(CommandWatch(CYCLES, 0), [7] * 100 + drawn(100), [7] * 200) is not None


def test_a_command_that_stays_at_its_limit_is_not_followed_by_an_older_one() -> None:
    """A drive that goes on with 300 runs away; the controller answers with the same limit in every cycle."""
    assert run(CommandWatch(CYCLES, 0), [300] * 50 + [-1000] * 100, [300] * 150) == 50 + CYCLES - 2


def test_the_margin_covers_what_is_only_measured() -> None:
    commands = [100 * (cycle % 7) for cycle in range(200)]
    told = [command + 20 for command in commands]
    assert run(CommandWatch(CYCLES, 20), commands, told) is None
    assert run(CommandWatch(CYCLES, 19), commands, told) is not None


def test_a_drive_that_tells_seldom_is_judged_by_the_commands_that_went_by() -> None:
    watch = CommandWatch(CYCLES, 0)
    for command in drawn(25):
        watch.sent(command)
    watch.told(5000)
    assert not watch.follows
    watch = CommandWatch(CYCLES, 0)
    for command in drawn(HALF - 1):
        watch.sent(command)
    watch.told(5000)
    assert watch.follows


def test_a_single_cycle_is_no_watch() -> None:
    with pytest.raises(ValueError, match="at least two"):
        CommandWatch(1, 0)


def test_two_cycles_are_a_watch() -> None:
    watch = CommandWatch(2, 0)
    watch.sent(1)
    watch.told(2)
    assert not watch.follows


def test_the_first_command_counts() -> None:
    """A drive that hears nothing from the beginning is noticed after half of the cycles: none was recent."""
    watch = CommandWatch(CYCLES, 0)
    for command in range(1, HALF + 1):
        assert watch.follows
        watch.sent(command)
        watch.told(5000)
    assert not watch.follows


def test_the_margins_are_to_either_side() -> None:
    """In thousandths of the rated torque: a demand is rounded, a torque is measured."""
    for margin, borne in ((DEMAND_MARGIN_RAW, 2), (ACTUAL_MARGIN_RAW, 100)):
        for sign in (1, -1):
            for error, follows in ((borne, True), (borne + 1, False)):
                watch = CommandWatch(2, margin)
                watch.sent(300)
                watch.told(300 + sign * error)
                assert watch.follows is follows, (margin, sign * error)


def test_a_demand_that_stands_still_among_commands_that_do_not_is_not_followed() -> None:
    """Though it is one of the last commands again and again."""
    commands = [100 * (cycle % 7) for cycle in range(200)]
    told = [commands[min(cycle, 100)] for cycle in range(200)]
    at = run(CommandWatch(CYCLES, 0), commands, told)
    assert at is not None
    assert 100 + HALF <= at <= 100 + CYCLES


@pytest.mark.parametrize("frozen", [False, True])
def test_a_torque_that_is_read_seldom_is_missed_when_more_are_equal_than_chance_has(frozen: bool) -> None:
    """Every third cycle, as by SDO: a drive that follows tells like commands by chance now and then."""
    random.seed(5)
    watch = CommandWatch(10, DEMAND_MARGIN_RAW)
    for cycle in range(30_000):
        command = random.randint(-5, 5)
        watch.sent(command)
        if cycle % 3 == 0:
            watch.told(0 if frozen else command)
        if frozen and not watch.follows:
            assert 3 * TOLD_THE_SAME <= cycle <= 3 * TOLD_THE_SAME + 20
            break
    assert watch.follows is not frozen


def test_a_few_commands_that_differ_prove_nothing() -> None:
    commands = [300 if cycle % 10 == 0 else 100 for cycle in range(500)]
    assert run(CommandWatch(CYCLES, 2), commands, [100] * 500) is None, "those may have been lost"


@pytest.mark.parametrize("start", [0, 2**31 - 500])
def test_speeds_and_positions_are_followed_by_any_demand_that_moves(start: int) -> None:
    """By a ramp that lags, and a position beyond the end of its 32 bits."""
    commands = [(start + 10 * cycle + 2**31) % 2**32 - 2**31 for cycle in range(200)]
    lagging = [command // 2 for command in commands]
    assert run(CommandWatch(CYCLES, 2, equal=False), commands, lagging) is None
    held = lagging[:100] + lagging[100:101] * 100
    at = run(CommandWatch(CYCLES, 2, equal=False), commands, held)
    assert at is not None
    assert at <= 100 + CYCLES
    assert run(CommandWatch(CYCLES, 2, equal=False), [7] * 200, [5] * 200) is None, "nothing moves"


def test_a_drive_that_cuts_a_command_follows_it() -> None:
    commands = drawn(500)
    told = [min(max(command, -100), 100) // 2 for command in commands]
    watch = CommandWatch(CYCLES, 2)
    for command, shown in zip(commands, told, strict=True):
        watch.sent(command)
        watch.told(shown, True)
        assert watch.follows
    for command in [-500] * CYCLES:
        watch.sent(command)
        watch.told(60, True)
    assert not watch.follows, "it pushes the other way"


def test_a_measured_torque_may_be_off_by_a_part_of_the_command() -> None:
    for error, follows in ((350, True), (351, False)):
        watch = CommandWatch(2, ACTUAL_MARGIN_RAW, share=ACTUAL_SHARE)
        watch.sent(1000)
        watch.told(1000 - error)
        assert watch.follows is follows


def test_what_is_excused_counts_from_then_on() -> None:
    watch = CommandWatch(CYCLES, 0)
    for command in drawn(HALF - 1):
        watch.sent(command)
        watch.told(5000)
    watch.excuse()
    for command in drawn(HALF - 1):
        watch.sent(command)
        watch.told(5000)
    assert watch.follows
    watch.sent(1)
    watch.told(5000)
    assert not watch.follows


@pytest.mark.parametrize(
    ("commands", "told", "noticed"),
    [
        ([1500], [0], True),
        ([1500], [-20], True),
        ([-1500], [0], True),
        ([1500], [900], False),
        ([20], [30], False),
        ([14], [0], False),
        ([1500, 1], [0], False),
    ],
    ids=["at rest", "the other way", "backwards", "cut", "raised", "slower than counts", "about rest"],
)
def test_a_speed_that_is_on_the_way_to_no_command_is_noticed_though_they_are_constant(
    commands: list[int], told: list[int], noticed: bool
) -> None:
    watch = CommandWatch(CYCLES, DEMAND_MARGIN_RAW, equal=False, least_raw=15)
    at = run(watch, commands * (200 // len(commands)), told * 200)
    assert (at is not None and at < 2 * CYCLES) is noticed


def test_commands_that_sway_about_a_demand_are_followed_by_it() -> None:
    """As read every 28 cycles, of a position loop at a constant speed."""
    watch = CommandWatch(110, DEMAND_MARGIN_RAW, equal=False)
    for cycle in range(2000):
        watch.sent(-308845 + (cycle * 7) % 51 - 25)
        if cycle % 28 == 0:
            watch.told(-308845)
        assert watch.follows


@pytest.mark.parametrize("told", [0, 2**31 - 1])
def test_a_position_at_the_end_of_its_32_bits_is_beside_the_commands_behind_it(told: int) -> None:
    """One and thirty counts further on, in turns."""
    watch = CommandWatch(110, DEMAND_MARGIN_RAW, equal=False)
    for cycle in range(2000):
        watch.sent((told + 1 + 29 * (cycle % 2) + 2**31) % 2**32 - 2**31)
        watch.told(told)
        assert watch.follows


@pytest.mark.parametrize(("least_raw", "follows"), [(76, True), (75, False), (None, False)])
def test_a_speed_among_commands_that_differ_by_less_than_counts_is_followed(
    least_raw: int | None, follows: bool
) -> None:
    """As a position loop at rest sends them, one count to and fro, and its drive ramps between them."""
    watch = CommandWatch(110, DEMAND_MARGIN_RAW, equal=False, least_raw=least_raw)
    for cycle in range(2000):
        watch.sent(25 if cycle % 5 < 3 else -51)
        if cycle % 28 == 0:
            watch.told(-13)
    assert watch.follows is follows


@pytest.mark.parametrize("rpm_s", [10, 20, 100, 1000])
def test_a_slow_ramp_in_whole_units_is_missed_once_it_is_two_units_away(rpm_s: int) -> None:
    """At 1 kHz: 110 cycles, 28 until it is read, and what the ramp takes for three units."""
    watch, left = CommandWatch(110, 1, equal=False), 0
    for cycle in range(3000):
        watch.sent(300 + max(0, cycle - 500) * rpm_s // 1000)
        if cycle % 28 == 0:
            watch.told(300)
        if not watch.follows:
            left = cycle - 500
            break
    assert 0 < left <= 110 + 28 + 3 * 1000 // rpm_s


def test_a_drive_whose_own_ramp_is_slow_is_given_the_time_for_two_units() -> None:
    commands = [300] * 50 + [600] * 950
    told = [300] * 50 + [300 + cycle // 100 for cycle in range(950)]
    assert run(CommandWatch(CYCLES, 1, equal=False, unit_cycles=100), commands, told) is None
    assert run(CommandWatch(CYCLES, 1, equal=False), commands, told) is not None


@pytest.mark.parametrize("equal", [True, False])
def test_a_drive_that_tells_before_its_first_command_is_not_judged(equal: bool) -> None:
    watch = CommandWatch(CYCLES, 0, equal=equal, least_raw=None if equal else 1)
    for told in (0, 0, 7, 7, 7):
        watch.told(told)
    assert watch.follows
