"""Drawn plans in which readings were placed on the SYNC before or behind their own, for certain."""

import pytest

from tests.truth.drawn import drawn_plan
from tests.truth.drawn_run import judged


@pytest.mark.parametrize(
    ("seed", "cycles", "unsure"), [(451230, 950, 90), (450285, 1180, 400), (452008, 1160, 90)]
)
def test_a_sync_ended_before_an_echo_that_is_stamped_late(seed: int, cycles: int, unsure: int) -> None:
    """So a reading a period behind an echo may be that of the next SYNC, whose echo was stamped behind it: a
    gateway's delay that ended was taken for one that had grown. 66, 64 and 30 rows were a SYNC off."""
    verdict = judged(drawn_plan(seed), cycles)
    assert verdict.wrong == {}, verdict.examples
    assert verdict.readings.uncertain < unsure


@pytest.mark.parametrize(("seed", "cycles"), [(450805, 1500), (451018, 1500)])
def test_the_order_decides_only_where_the_last_delays_spread_over_a_period(seed: int, cycles: int) -> None:
    """They did so with those of before a gateway's step: 252 and 18 rows behind a reading told lost."""
    verdict = judged(drawn_plan(seed), cycles)
    assert verdict.wrong == {}, verdict.examples


def test_a_clock_set_back_by_a_period_is_no_delay_that_has_grown() -> None:
    """Its first reading was lost, so each lay on a SYNC that had none, and within what one that was held up
    had made of delays; or one seemed too short for such a clock, as a SYNC had come sooner, or a gateway's
    delay had ended: 1131 rows."""
    verdict = judged(drawn_plan(451670), 1400)
    assert verdict.wrong == {}, verdict.examples
    assert verdict.readings.uncertain < 160


def test_a_stamp_shows_its_steps_once_the_clock_s_rate_has_moved_it() -> None:
    """A calibration by SYNCs at equal distances had not: "its clock was set by +1005 us", and 78 rows lay on
    the SYNC behind their own."""
    verdict = judged(drawn_plan(451091), 720)
    assert verdict.wrong == {}, verdict.examples
    assert verdict.readings.uncertain < 80


@pytest.mark.parametrize(("seed", "cycles"), [(450744, 640), (451108, 150), (451359, 60), (451792, 400)])
def test_what_a_single_reading_seems_to_show(seed: int, cycles: int) -> None:
    """A surplus one among many of other delays does not show that none was lost, nor one that was held up
    that all come three periods later, nor one behind a SYNC that was not heard that it answers the one
    before. 1 to 3 rows each."""
    verdict = judged(drawn_plan(seed), cycles)
    assert verdict.wrong == {}, verdict.examples


@pytest.mark.parametrize(
    ("seed", "cycles"),
    [
        pytest.param(452914, 430, id="two were lost, or a delay grew by two periods"),
        pytest.param(452610, 780, id="the last certain reading was of a time of doubt"),
        pytest.param(452787, 20, id="a SYNC was late by a little, or the clock was set"),
        pytest.param(452367, 70, id="a reading came without those of other axes in front"),
    ],
)
def test_what_two_explanations_fit_alike_is_not_certain(seed: int, cycles: int) -> None:
    """Probes that were not followed counted for little where delays spread over a period; lags were counted
    from a reading in doubt; a bound lacked what stamps do not tell. 448, 5 and 2 rows, 6 bounds."""
    verdict = judged(drawn_plan(seed), cycles)
    assert verdict.wrong == {}, verdict.examples


@pytest.mark.parametrize(
    ("seed", "cycles"),
    [
        pytest.param(451853, 1112, id="one of a shorter delay overtook the last of the longer"),
        pytest.param(460853, 40, id="it came in front of a probe, and delays had not grown"),
        pytest.param(131025, 450, id="the reading of the SYNC before was a copy"),
    ],
)
def test_a_reading_of_an_unusual_delay_that_may_be_of_another_sync_is_in_doubt(
    seed: int, cycles: int
) -> None:
    """Frames are held up then, or have changed places, however well the others fit: 2, 1 and 1 rows."""
    verdict = judged(drawn_plan(seed), cycles)
    assert verdict.wrong == {}, verdict.examples


def test_a_statusword_by_a_timer_tells_a_delay_that_grew_by_whole_periods_from_losses() -> None:
    """At the kernel's SYNCs both give the same readings: a gateway's three periods were taken for three
    losses, 899 rows, and 780 of another plan."""
    verdict = judged(drawn_plan(461573), 760)
    assert verdict.wrong == {}, verdict.examples
    assert verdict.readings.uncertain < 120


@pytest.mark.parametrize(
    ("seed", "cycles"),
    [
        pytest.param(461656, 420, id="what was taken for the first loss of a way that keeps the order"),
        pytest.param(461669, 510, id="one of several strays took the only place that was open"),
    ],
)
def test_few_losses_and_several_strays_may_be_a_delay_that_has_grown(seed: int, cycles: int) -> None:
    """By a little less than a period, and by one and a half: 43 and 4 rows were a SYNC off."""
    verdict = judged(drawn_plan(seed), cycles)
    assert verdict.wrong == {}, verdict.examples


def test_a_reading_that_no_other_node_s_frame_held_up_is_no_sign_of_frames_that_are_held_up() -> None:
    """Frames of other axes in front of it were lost, one in six: 352 rows of 1500 were in doubt."""
    verdict = judged(drawn_plan(461671), 500)
    assert verdict.wrong == {}, verdict.examples
    assert verdict.readings.uncertain < 300


def test_delays_grow_by_no_more_periods_than_readings_are_missing() -> None:
    """Traffic that beats with the SYNCs held them up as it had 30 periods before, and most of the last
    readings were in doubt: "its readings come 30050 us after their SYNC now", and one was late."""
    verdict = judged(drawn_plan(460469), 1120)
    assert verdict.wrong == {}, verdict.examples


def test_a_delay_that_ends_a_little_under_whole_periods_may_have_ended_by_all_of_them() -> None:
    """2962 us of a gateway, by which readings seemed able to come two SYNCs sooner at most: three was the
    truth, chance chose another of 32, and 236 rows were told lost."""
    verdict = judged(drawn_plan(472528), 1290)
    assert verdict.wrong == {}, verdict.examples
    assert verdict.readings.uncertain < 30


def test_a_clock_that_was_set_by_whole_periods_with_delays_that_grew_by_as_much_explains_nothing() -> None:
    """Delays that spread over four periods left that as the only way: "its clock was set by +4000 us"."""
    verdict = judged(drawn_plan(472664), 1200)
    assert verdict.wrong == {}, verdict.examples
    assert verdict.readings.uncertain < 130
