"""Drawn plans in which it is asked whether a drive's clock was set, and what SYNCs rest on."""

import pytest

from tests.truth.drawn import drawn_plan
from tests.truth.drawn_run import Verdict, judged


def verdict_of(seed: int, cycles: int) -> Verdict:
    """What is told of all cycles of a plan must hold."""
    verdict = judged(drawn_plan(seed), cycles)
    assert not verdict.wrong, verdict.examples
    return verdict


@pytest.mark.parametrize(("seed", "cycles", "unsure"), [(402271, 320, 180), (410181, 1320, 300)])
def test_a_sync_that_jitters_by_a_quarter_of_a_period_sets_no_clock(
    seed: int, cycles: int, unsure: int
) -> None:
    """Neighbours lie further apart than a quarter of a period, which left the readings no line without a
    step; 746 and 23 rows were of other SYNCs, and 223 commands outside."""
    assert verdict_of(seed, cycles).readings.uncertain <= unsure


@pytest.mark.parametrize("cycles", [640, 920])
def test_what_may_be_placed_far_off_leaves_no_cycle_lost_for_certain(cycles: int) -> None:
    """A clock that is set on and back again may have been set by what it lacks, or readings may come 40
    periods late: as many cycles in front of them have none then. And a clock that is set on in two places
    makes no way of placing its readings impossible."""
    verdict_of(400279, cycles)


def test_a_sync_that_jitters_by_half_a_period_puts_no_question() -> None:
    """Its stamps lie 0 to 450 us behind it; those beyond a quarter of a period did, 398 rows of 1500."""
    assert verdict_of(9130, 700).readings.uncertain <= 30


def test_syncs_that_wait_rest_on_their_echoes() -> None:
    """Other traffic holds them up by up to 120 us, and echoes are 7 us late: the hand-over was taken for the
    better of both, by a hair."""
    assert verdict_of(402424, 60).readings.uncertain <= 30


def test_a_command_that_equals_an_older_one_may_be_told_by_a_copy_of_that() -> None:
    """It was replaced before it acted, and "acting" as the older one came once more."""
    verdict_of(410088, 260)


@pytest.mark.parametrize(("seed", "cycles"), [(450280, 60), (450120, 30), (451333, 520)])
def test_the_bound_holds_what_a_stamp_hides_that_waits_for_a_tick(seed: int, cycles: int) -> None:
    """Of which the bench was told nothing. Another's SYNCs come at a whole number of ticks and never show it;
    those of the calibration have, and a bound that waited for a second heap of stamps did not hold."""
    verdict_of(seed, cycles)


@pytest.mark.parametrize(("seed", "cycles"), [(451802, 200), (450790, 130)])
def test_a_stamped_change_may_be_of_a_command_that_has_left(seed: int, cycles: int) -> None:
    """Behind a horizon of eight periods: the next command, with the same data, was told for it, and acting
    before the SYNC at which it could have."""
    verdict_of(seed, cycles)


def test_a_sync_that_jitters_is_no_tick() -> None:
    """Up to 315 us late at the drive: taken for a tick of as much, it left a third of the rows in doubt."""
    assert verdict_of(450085, 120).readings.uncertain <= 5


def test_a_step_hides_in_what_echoes_are_late() -> None:
    """By -1499 us, SYNCs 2 ms apart and echoes up to 596 us late: stamps lay on the SYNCs before their own,
    whose delays were unusual for a step by whole periods; 399 rows were of other SYNCs."""
    assert verdict_of(460054, 280).readings.uncertain <= 60


def test_one_frame_comes_twice_and_answers_one_sync() -> None:
    """Off its SYNC by more than any before, whose echo was stamped behind it, it was placed nowhere near; so
    its copy was taken for the reading, and was late. The drive followed a command again as it came twice, by
    its own stamps, and that was told for the first time. 1 row and 1 command; 142 of 510 rows in doubt."""
    assert verdict_of(451272, 170).readings.uncertain <= 70


def test_late_echoes_leave_a_question_open_no_longer_than_they_must() -> None:
    """Without what they may be off 75 rows of 1500 are in doubt, with four times as much 95."""
    assert verdict_of(450173, 1500).readings.uncertain <= 60


@pytest.mark.parametrize(("seed", "cycles", "unsure"), [(451721, 1250, 45), (452118, 220, 10)])
def test_a_stamp_before_its_sync_is_of_the_one_before(seed: int, cycles: int, unsure: int) -> None:
    """Which waited in front of the bus for more than half a period, where no echo tells it. Taken for how far
    stamps reach, it let the next one lie on a SYNC that its reading had come before: a row each was wrong,
    and what half of the SYNCs' distance hides left 422 and 235 of 1500 in doubt."""
    assert verdict_of(seed, cycles).readings.uncertain <= unsure


def test_a_line_is_borne_out_by_all_readings_since_the_question() -> None:
    """Clock and delay changed at once, so the right line was too unlikely to be taken soon; eight readings,
    looked at seven times, lay on a wrong one by chance: 375 rows, 251 commands."""
    verdict_of(460486, 1180)


def test_the_only_line_on_which_all_suspects_lie_is_taken_whatever_it_needs() -> None:
    """Delays of up to five periods in which no frame overtakes: the smallest of 32 seemed to have changed by
    more than a period, the clock was held for unmoved, and readings lay 900 us off: 5 rows."""
    assert verdict_of(460508, 170).readings.uncertain <= 80


def test_a_sync_of_another_that_began_no_cycle_is_one_that_a_drive_answers() -> None:
    """It came too soon behind the last, and the right line met it: one that was two periods off was taken.
    4 of 260 rows were wrong, 118 in doubt; 1302 of 1500."""
    assert verdict_of(460514, 260).readings.uncertain <= 40


def test_the_first_suspects_show_what_delays_were_before_a_step() -> None:
    """A gateway's 2194 us, and 358 669 us of the clock four readings later, SYNCs 2001 us apart: one step by
    a period less explained the others, and not those four. 1104 rows of 3000, 69 commands."""
    assert verdict_of(460657, 420).readings.uncertain <= 100


@pytest.mark.parametrize(
    ("seed", "cycles", "unsure"),
    [
        pytest.param(461856, 700, 100, id="a step behind one that had met another delay"),
        pytest.param(462010, 790, 360, id="the smallest delay on the line was less than none"),
        pytest.param(461413, 905, 240, id="a clock set back twice made its stamps again"),
        pytest.param(461697, 690, 560, id="stamps lay from their SYNCs as far as these from one another"),
    ],
)
def test_a_step_is_told_by_delays_and_stamps_as_they_are(seed: int, cycles: int, unsure: int) -> None:
    """The smallest delay of before was remembered, and "no step, 38 ms longer" seemed as likely as a step; a
    reading was sampled, by its stamp, when its frame had begun; a second reading was a copy by its stamp
    alone; and suspects were proved with bounds of 1.8 periods. 644, 35, 5 and 19 rows."""
    verdict = judged(drawn_plan(seed), cycles)
    assert verdict.readings.wrong == 0, verdict.examples
    assert verdict.readings.uncertain <= unsure


def test_the_bound_holds_jitter_that_the_map_s_own_error_hides() -> None:
    """Of 473 us, behind a calibration that showed it to 16 readings: 2 bounds did not hold."""
    verdict = judged(drawn_plan(471841), 20)
    assert verdict.wrong == {}, verdict.examples


def test_stamps_on_a_grid_that_regular_syncs_hid_are_rounded_to_it() -> None:
    """Of 250 us, hidden by a calibration whose SYNCs had no jitter: 6 bounds of 130 us did not hold."""
    verdict = judged(drawn_plan(471883), 60)
    assert verdict.wrong == {}, verdict.examples
    assert verdict.readings.uncertain <= 20
