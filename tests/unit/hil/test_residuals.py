"""How far stamps lie from their SYNCs, and what the bounds of samples and map are made from."""

import random

import pytest

from servobench.hil.loop.residuals import LEAST, OUTLYING, WATCHED, DelayExtremes, Extremes, Residuals

UNSEEN = 4_000


# ---- the smallest and the largest of the last values -------------------------------------------------------


def window(*values: int) -> Extremes:
    made = Extremes()
    for value in values:
        made.add(value)
    return made


@pytest.mark.parametrize(
    ("values", "low", "high"),
    [((), 0, 0), ((5,), 5, 5), ((5, 3, 9), 3, 9), ((5, 9, 3), 3, 9), ((0, 4), 0, 4)],
)
def test_the_smallest_and_the_largest_value(values: tuple[int, ...], low: int, high: int) -> None:
    made = window(*values)
    assert (made.low, made.high) == (low, high)


def test_a_value_is_forgotten_after_one_to_two_halves_of_the_window() -> None:
    """At the end of each half only those in it count; meanwhile all since the last end but one."""
    half = WATCHED // 2
    made = window(1, 99, *[50] * (half - 3))
    assert (made.low, made.high) == (1, 99)
    made.add(50)
    assert (made.low, made.high) == (1, 99), "the end of the half that they came in"
    for _ in range(half - 1):
        made.add(50)
    assert (made.low, made.high) == (1, 99)
    made.add(60)
    assert (made.low, made.high) == (50, 60)
    made.add(40)
    assert (made.low, made.high) == (40, 60)


def test_values_spread_over_so_much_or_more() -> None:
    made = window(100, 300)
    assert (made.spreads(200), made.spreads(201)) == (True, False)


@pytest.mark.parametrize(("count", "slack"), [(0, 0), (2, 400), (3, 266), (128, 6), (1000, 6)])
def test_the_next_value_lies_within_four_mean_gaps_beyond(count: int, slack: int) -> None:
    """Of 200 ns, among as many as are watched."""
    made = window(*[100, 300][:count])
    for number in range(2, count):
        made.add(100 if number % 2 else 300)
    assert made.slack() == slack


# ---- how far below the smallest delay others may lie ------------------------------------------------------


@pytest.mark.parametrize("parts", [1, 2])
def test_no_delay_lies_further_below_the_smallest_however_many_parts_it_has(parts: int) -> None:
    """A late SYNC and a late reading are hardly ever both on time. Seen too late in 37 of 100 windows, where
    mean gaps alone were counted."""
    draw, missed = random.Random(3), 0
    for _ in range(400):
        made = DelayExtremes()
        for _ in range(WATCHED // 2):
            made.add(sum(draw.randint(0, 100_000) for _ in range(parts)))
        missed += made.low > made.unseen(0)
        assert made.unseen(0) <= 0.35 * parts * 100_000
    assert missed <= 0.03 * 400


def test_delays_that_are_others_now_forget_the_least_of_before() -> None:
    made = DelayExtremes()
    for value in range(1_000, 1_000 + 3 * LEAST):
        made.add(value)
    made.begin([9_000] * (3 * LEAST))
    assert made.unseen(0) < LEAST - 1


# ---- residuals -------------------------------------------------------------------------------------------


def spread_evenly(low: int, high: int, count: int = 2_000) -> Residuals:
    made, draw = Residuals(0.0), random.Random(1)
    for _ in range(count):
        made.add(draw.randint(low, high), UNSEEN)
    return made


def test_what_map_and_stamp_err_by_is_no_spread() -> None:
    made = spread_evenly(-UNSEEN, UNSEEN)
    assert (made.early, made.late, made.least, made.spread) == (0, 0, 0, 0)


def test_values_that_scatter_within_what_the_map_errs_by_have_a_variance_of_their_own() -> None:
    """The map would follow each of them else."""
    assert spread_evenly(-UNSEEN // 2 + 100, UNSEEN // 2 - 100).variance_ns2(UNSEEN) == 0.0
    assert spread_evenly(-UNSEEN, UNSEEN).variance_ns2(UNSEEN) ** 0.5 == pytest.approx(UNSEEN / 1.5, rel=0.2)


def test_a_spread_is_known_on_either_side_and_no_next_one_lies_beyond_it() -> None:
    made = spread_evenly(-70_000, 30_000)
    assert made.early + UNSEEN == pytest.approx(70_000, rel=0.02) == -made.least
    assert made.late + UNSEEN == pytest.approx(30_000, rel=0.05)
    assert made.early + UNSEEN + made.slack >= 70_000
    assert made.late + UNSEEN + made.slack >= 30_000
    assert made.spread == made.early + made.late + made.slack
    assert 100_000 <= made.reach <= 112_000


def test_the_deviation_is_hardly_larger_than_that_of_values_evenly_spread() -> None:
    deviation_ns = 100_000 / 12**0.5
    assert 1.0 <= spread_evenly(-50_000, 50_000).variance_ns2(UNSEEN) ** 0.5 / deviation_ns <= 1.5


def test_a_rare_one_is_cut_and_a_spread_is_not() -> None:
    made = Residuals(0.0)
    made.learn([0, 1_000] * 20, UNSEEN)
    assert made.cut(200_000, UNSEEN) == OUTLYING * 1_000 + UNSEEN
    assert made.cut(-200_000, UNSEEN) == -made.cut(200_000, UNSEEN)
    evenly = spread_evenly(-50_000, 50_000)
    assert (evenly.cut(-50_000, UNSEEN), evenly.cut(50_000, UNSEEN)) == (-50_000, 50_000)


@pytest.mark.parametrize(("width", "residual", "apart"), [(50_000, 80_000, False), (1_000, 5_000, True)])
def test_one_lies_apart_that_is_further_off_than_most_from_one_another(
    width: int, residual: int, apart: bool
) -> None:
    made = spread_evenly(-width, width)
    assert made.lies_apart(residual, UNSEEN) is apart
    assert made.lies_apart(-residual, UNSEEN) is apart
    assert not made.lies_apart(residual, 3 * residual)
    assert not Residuals(0.0).lies_apart(residual, UNSEEN)


def test_a_spread_that_has_ended_is_forgotten() -> None:
    made = spread_evenly(-50_000, 50_000)
    for number in range(WATCHED):
        made.add(number % 2, UNSEEN)
    assert made.spread == 0


@pytest.mark.parametrize(("anew", "reach"), [(True, 0), (False, 40_000)])
def test_a_clock_that_was_set_leaves_how_far_stamps_reach(anew: bool, reach: int) -> None:
    """By eight readings the map errs by as much as stamps seem to."""
    made = spread_evenly(-20_000, 20_000)
    made.learn([-9_000, 8_000, 3_000, -2_000, 5_000, -6_000, 1_000, 0], 20_000, anew=anew)
    assert made.spread >= reach
    assert (made.spread > 0) is not anew


def test_what_is_expected_holds_until_more_is_seen() -> None:
    made = Residuals(10_000.0)
    made.learn([0, 1, 2, 1], UNSEEN)
    assert made.cut(1_000_000, 0) == OUTLYING * 10_000


def test_a_delay_far_below_all_others_tells_of_no_least_one() -> None:
    """Delays that were longer for a time are what they were: the first of them bound their own samples."""
    delays, transit = DelayExtremes(), 80_000
    for number in range(200):
        delays.add(358_000 + number * 37 % 376 * 1000)
    assert delays.late(358_000, transit) < 40_000

    assert delays.late(300_000, transit) == 300_000 - transit
    delays.add(300_000)
    assert delays.late(310_000, transit) >= 200_000
