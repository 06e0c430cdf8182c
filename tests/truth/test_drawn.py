"""Drawn plans: what a short run under each of a few tells is what happened; and what draws them.

``python -m tests.truth`` draws as many as one has time for.
"""

from itertools import pairwise

import numpy as np
import pytest

from servobench.drivers.timebase import NS_PER_MS, NS_PER_US, Instant
from servobench.drivers.wire.frame_port import UNTOLD, EchoBasis, WireFrame
from servobench.virtual_bus.bus.segment import CanSegment
from servobench.virtual_bus.bus.simulated_bus import SimulatedBus
from servobench.virtual_bus.timeline import Timeline
from tests.truth.adapter import Adapter, AdapterPort
from tests.truth.drawn import FEATURES, drawn_plan, shrunk
from tests.truth.drawn_bench import DrawnPlan
from tests.truth.drawn_run import bench_config, judged
from tests.truth.rows import USED
from tests.truth.tapped_run import run_with_taps

CYCLES = 800
SEEDS = (2, 27, 33, 57, 59, 65, 69, 79, 113)
"""Plans that have every feature between them, nothing certain wrong and few rows in doubt."""
SENT = 200


@pytest.mark.parametrize("seed", SEEDS)
def test_what_a_run_under_a_drawn_plan_tells_is_what_happened(seed: int) -> None:
    verdict = judged(drawn_plan(seed), CYCLES)
    assert verdict.readings.rows >= CYCLES
    assert verdict.wrong == {}, verdict.examples


def test_a_clock_that_is_set_again_while_that_is_a_question_leaves_nothing_wrong() -> None:
    """Six times, by less than the SYNC jitters and by more: 36 rows were wrong, 110 bounds did not hold."""
    verdict = judged(drawn_plan(147), 1500)
    assert verdict.wrong == {}, verdict.examples


def test_a_reading_that_comes_before_the_cycle_of_its_sync_begins_is_not_lost() -> None:
    """Of SYNCs of another that come 560 us apart, while the host waits for the reading of the one before."""
    verdict = judged(drawn_plan(5018), CYCLES)
    assert verdict.wrong == {}, verdict.examples


def test_the_bound_holds_what_a_stamp_that_waits_for_a_tick_hides() -> None:
    """Nothing is known of the tick before the first stamp lies one further; 116 bounds did not hold."""
    verdict = judged(drawn_plan(142), 400)
    assert (verdict.readings.wrong, verdict.readings.uncertain <= 10) == (0, True)
    assert verdict.readings.bound_broken <= 2


def test_stamps_that_show_their_steps_teach_the_clock_anew() -> None:
    """Of 100 us, taken for exact at first: they taught a rate of 11 900 ppm, and 39 rows were wrong."""
    verdict = judged(drawn_plan(137), 400)
    assert verdict.wrong == {}, verdict.examples
    assert verdict.readings.uncertain <= 4


def test_delays_as_they_were_are_not_excluded_by_more_even_ones() -> None:
    """Traffic holds up SYNCs of another and readings behind them: a period later these came more evenly,
    and 39 rows of 1500 were taken for those of the SYNC before."""
    verdict = judged(drawn_plan(153), 400)
    assert verdict.wrong == {}, verdict.examples
    assert verdict.readings.uncertain < verdict.readings.rows


@pytest.mark.parametrize(("seed", "cycles"), [(9024, 60), (9147, 850)])
def test_a_second_reading_that_is_held_up_confirms_nothing(seed: int, cycles: int) -> None:
    """It was taken for proof that none was lost, though delays spread over most of a period, and for that of
    the only SYNC that had none, though the one before was held up itself."""
    verdict = judged(drawn_plan(seed), cycles)
    assert verdict.readings.wrong == 0, verdict.examples


@pytest.mark.parametrize(
    ("without", "cycles"),
    [(["late stamps"], 800), ([], 90)],
    ids=["a stamp lies on both", "the first is answered with the stamp of the second"],
)
def test_two_syncs_that_come_close_together_are_neither_lost_nor_taken_for_one_another(
    without: list[str], cycles: int
) -> None:
    """51 us apart, so that a drive acts on both in one instant; 300 us, and it latches when they arrive."""
    verdict = judged(drawn_plan(9128, without), cycles)
    assert verdict.wrong == {}, verdict.examples


@pytest.mark.parametrize(("seed", "cycles"), [(28, 25), (106, 1075), (111, 40)])
def test_a_demand_that_overtook_or_was_overtaken_is_of_no_one_sync(seed: int, cycles: int) -> None:
    """One that came before its reading was taken for that of the SYNC before, whose own was lost, and a
    command that acted was told lost; one that was held up, or came twice, for that of the next SYNC."""
    verdict = judged(drawn_plan(seed), cycles)
    assert verdict.wrong == {}, verdict.examples


@pytest.mark.parametrize(("seed", "cycles"), [(9043, 60), (52033, 60), (121, 700), (462009, 240)])
def test_without_stamps_a_bound_holds_before_the_delays_of_a_run_are_known(seed: int, cycles: int) -> None:
    """At its begin, where the calibration alone told how far they spread, and behind a question that three
    readings had answered: 4, 1 and 4 bounds did not hold; 7 while the calibration's were among the last."""
    verdict = judged(drawn_plan(seed), cycles)
    assert verdict.wrong == {}, verdict.examples


@pytest.mark.parametrize(("seed", "unsure"), [(9033, 120), (9155, 1200)])
def test_what_looks_as_before_is_decided_though_more_readings_are_missing(seed: int, unsure: int) -> None:
    """1499 and 1442 of 1500 rows were in doubt: the calibration had seen frames with 3 us more of stuff bits,
    and beside probes each further loss began the count anew."""
    verdict = judged(drawn_plan(seed), 1500)
    assert verdict.wrong == {}, verdict.examples
    assert verdict.readings.uncertain < unsure


@pytest.mark.parametrize(("seed", "unsure"), [(140003, 60), (210432, 200)])
def test_neither_late_echoes_nor_other_axes_frames_keep_a_loss_in_doubt(seed: int, unsure: int) -> None:
    """Another's jitter told e^80 times which SYNCs were answered, and delays that spread over 0.4 of a period
    refused it: 1443 of 1500 rows. One axis' lost reading let another's come a frame sooner, and that was
    taken for a frame held up, which puts all behind a loss in doubt: 1202 of 3000."""
    verdict = judged(drawn_plan(seed), 1500)
    assert verdict.wrong == {}, verdict.examples
    assert verdict.readings.uncertain < unsure


def test_a_reading_behind_a_sync_that_was_not_heard_is_not_that_of_the_one_before() -> None:
    """The one before had lost its own: 2 of 1500 certain rows were wrong."""
    verdict = judged(drawn_plan(210583), 1300)
    assert verdict.readings.wrong == 0, verdict.examples


@pytest.mark.parametrize(
    ("seed", "cycles"), [(110028, 1120), (110033, 30), (110072, 360), (130070, 60), (131025, 530)]
)
def test_a_usual_delay_places_no_reading_where_all_before_have_theirs_or_others_are_not_rare(
    seed: int, cycles: int
) -> None:
    """A gateway of a period went away, and all readings since stood one SYNC early; of delays that spread
    over two periods and more those that the calibration had were believed; probes that hardly one reading had
    followed, and a spread five times as wide, left the delay as it was; a copy, or a reading whose own place
    was in doubt, stood for one of those before."""
    verdict = judged(drawn_plan(seed), cycles)
    assert verdict.readings.wrong == 0, verdict.examples


def test_a_short_delay_is_no_proof_that_a_clock_was_not_set_forward() -> None:
    """By 1016 us, a period and the SYNC's jitter: each reading lay on the next SYNC, and the first whose
    delay seemed usual, where delays spread over more than a period, ended it: 50 rows were wrong."""
    verdict = judged(drawn_plan(140019), 640)
    assert verdict.readings.wrong == 0, verdict.examples


@pytest.mark.parametrize(
    ("seed", "cycles", "unsure"), [(200330, 760, 140), (200413, 515, 60), (200274, 210, 120)]
)
def test_what_nothing_explains_is_not_taken_for_what_was(seed: int, cycles: int, unsure: int) -> None:
    """A clock set forward by a period behind a gateway's step: 48 readings had come too soon for it, and the
    clock was held for unmoved; 189 rows. One set twice within seven readings: those before the second step
    were placed by it, and one was certain. One SYNC that waited where no echo tells it, and was the anchor of
    every line: all had it that the clock was set by 466 us; 216 rows."""
    verdict = judged(drawn_plan(seed), cycles)
    assert verdict.wrong == {}, verdict.examples
    assert verdict.readings.uncertain < unsure


@pytest.mark.parametrize(("seed", "cycles", "unsure"), [(200416, 1235, 740), (300108, 60, 110)])
def test_readings_of_a_phase_that_is_not_known_may_be_those_of_later_syncs(
    seed: int, cycles: int, unsure: int
) -> None:
    """A gateway's delay that ended: reckoned from the SYNC before, and only those before that were weighed.
    119 rows were placed 24 periods off or told lost, by one uneven SYNC. Copies among few readings are in
    their deviation: told by what half of them keep within, 81 rows were wrong."""
    verdict = judged(drawn_plan(seed), cycles)
    assert verdict.wrong == {}, verdict.examples
    assert verdict.readings.uncertain < unsure


@pytest.mark.parametrize(
    ("seed", "cycles", "unsure"),
    [(450077, 420, 300), (420123, 700, 40), (420125, 800, 60), (440012, 1500, 300)],
)
def test_a_clock_that_is_set_back_makes_a_second_stamp_of_a_sync(seed: int, cycles: int, unsure: int) -> None:
    """So it did not run on: a delay that had grown by a period was believed, 12 rows; or the stamps, which
    were those of before, for copies, 648 of 700 rows in doubt. Each further step doubled how far stamps were
    taken to reach, 816 of 1500. Delays over half a period, but below one, asked for 32 readings: 8 tell."""
    verdict = judged(drawn_plan(seed), cycles)
    assert verdict.wrong == {}, verdict.examples
    assert verdict.readings.uncertain < unsure


@pytest.mark.parametrize(
    ("seed", "cycles", "unsure"), [(420056, 500, 20), (450064, 600, 300), (402151, 1000, 40)]
)
def test_a_stamp_of_up_to_a_third_of_a_period_tells_its_sync(seed: int, cycles: int, unsure: int) -> None:
    """By order 497 of 500 and 1019 of 1200 rows were in doubt; stamps of 250 us seemed to advance by 4 ms,
    as SYNCs of a calibration were late by less than a step. Not where an adapter gives no echo: a step of
    724 us would look like a smaller one, and 625 rows like those of the SYNC before."""
    verdict = judged(drawn_plan(seed), cycles)
    assert verdict.wrong == {}, verdict.examples
    assert verdict.readings.uncertain < unsure


def test_a_copy_that_comes_when_all_syncs_have_their_readings_puts_none_of_them_in_doubt() -> None:
    """Without stamps it is known by its speed, unless a shaft is at rest: 716 of 3000 rows were in doubt."""
    verdict = judged(drawn_plan(450002), 600)
    assert verdict.wrong == {}, verdict.examples
    assert verdict.readings.uncertain < 60


def test_syncs_that_rest_on_their_hand_over_have_an_error_that_no_stamp_shows() -> None:
    """An adapter stamped 0 to 681 us late: 392 of 1500 commands acted up to 4 us outside their interval."""
    verdict = judged(drawn_plan(450214), 300)
    assert verdict.wrong == {}, verdict.examples
    assert verdict.commands.told_acting > 200


def test_a_clock_that_is_set_twice_lies_on_no_line_between() -> None:
    """By -987 and -507 us within 32 readings, on a line that fits none of them: -995 us was told, and 792 of
    3000 rows were a SYNC off. Nor is a delay that is longer by a period nothing, as few were known yet."""
    verdict = judged(drawn_plan(450377), 1050)
    assert verdict.readings.wrong == 0, verdict.examples


def test_a_delay_that_grew_is_no_loss_where_readings_come_too_soon_for_it() -> None:
    """By 951 us at SYNCs of 1001 us: most came sooner than a frame can behind the SYNC before, and one
    surplus reading was taken for proof that nothing had changed. 393 rows were wrong, 320 commands too."""
    verdict = judged(drawn_plan(450200), 900)
    assert verdict.wrong == {}, verdict.examples


def test_a_line_through_readings_of_syncs_that_were_not_heard_is_one() -> None:
    """A clock set back by 5816 us: the right line met a SYNC of another that was lost on the way here, and
    six periods of delay were believed, at which each reading lay a fifth of a period off: 709 rows were late
    by then, for certain."""
    verdict = judged(drawn_plan(440125), 700)
    assert verdict.wrong == {}, verdict.examples
    assert verdict.readings.uncertain < 20


def test_a_longer_loss_is_not_as_likely_as_the_single_ones_before_it() -> None:
    """A gateway's 3953 us at SYNCs of 2000 us, where readings are lost by ones: two were missing, delays
    looked as before but for such as came sooner than frames can, and 419 rows were two SYNCs off."""
    verdict = judged(drawn_plan(28), 600)
    assert verdict.readings.wrong == 0, verdict.examples


@pytest.mark.parametrize(("seed", "cycles", "unsure"), [(402107, 150, 100), (440053, 1500, 400)])
def test_a_frame_that_comes_twice_is_known_by_its_stamp(seed: int, cycles: int, unsure: int) -> None:
    """However coarse it is: a copy in the place of a lost reading was taken for that, and 1464 of 1500 rows
    were in doubt as frames seemed to be held up."""
    verdict = judged(drawn_plan(seed), cycles)
    assert verdict.wrong == {}, verdict.examples
    assert verdict.readings.uncertain < unsure


@pytest.mark.parametrize(("seed", "cycles"), [(410194, 760), (72, 120), (402237, 30)])
def test_what_a_frame_that_is_held_up_may_stand_for_is_in_doubt(seed: int, cycles: int) -> None:
    """Without stamps. One came as the SYNC behind it did, whose echo was stamped late: 2 rows. A question
    that was answered and put again with one reading forgot what was in doubt, and of a SYNC behind a missing
    reading an unusual one was believed: 3 rows. Delays of up to 2.4 periods; a calibration saw 0.9: 3."""
    verdict = judged(drawn_plan(seed), cycles)
    assert verdict.readings.wrong == 0, verdict.examples


def test_order_alone_decides_nothing_where_delays_spread_over_two_periods() -> None:
    """Delays of up to 4.25 periods, and 0.6 of one more from 0.6 s on: 69 certain rows were wrong."""
    assert judged(drawn_plan(410035), 1000).wrong == {}


def test_syncs_that_were_not_heard_are_counted_where_readings_are_shifted_against_them() -> None:
    """By arrival only a shift by 29 SYNCs met none that was missing, and looked the most even, as four of 26
    readings would have come too soon for the right one: 9 rows were late by 33 ms for certain."""
    verdict = judged(drawn_plan(200402), 800)
    assert verdict.readings.wrong == 0, verdict.examples
    assert verdict.readings.uncertain < 450, "728 by arrival"


@pytest.mark.parametrize("seed", [200203, 200212])
def test_a_demand_behind_a_blackout_may_be_that_of_before(seed: int) -> None:
    """The last command that was lost in it equalled the one that the drive followed, which had not been told:
    it was told acting."""
    verdict = judged(drawn_plan(seed), 560)
    assert verdict.wrong == {}, verdict.examples


@pytest.mark.parametrize(
    ("seed", "cycles"),
    [
        *(
            (300052, 770),
            (200263, 230),
        ),  # the clock's map lagged: a rate that changed, or was taken for another
        *((400074, 270), (300083, 10)),  # stamps of a tick, or of 250 us, that SYNCs at equal distances hide
        *((300038, 10), (140019, 500), (400071, 420)),  # commands that came twice, and told once
        *((165, 90), (300137, 970)),  # SYNCs stamped late, whose own reading was lost
    ],
)
def test_a_command_acts_in_the_interval_that_is_told(seed: int, cycles: int) -> None:
    """137, 122, 489, 3, 2, 10, 1, 17 and 3 of 1500 or 3000 lay outside."""
    verdict = judged(drawn_plan(seed), cycles)
    assert verdict.commands.told_acting > 0
    assert verdict.wrong == {}, verdict.examples


@pytest.mark.parametrize(
    ("seed", "cycles"),
    [
        pytest.param(460915, 670, id="a change waits for twelve readings, and its command had left"),
        pytest.param(430048, 700, id="a demand came before the echo of its SYNC"),
        pytest.param(461229, 40, id="the drive's stamps show that a command came twice"),
    ],
)
def test_a_change_or_a_demand_is_tied_to_no_other_command_or_sync(seed: int, cycles: int) -> None:
    """One command each acted outside of its interval."""
    verdict = judged(drawn_plan(seed), cycles)
    assert verdict.wrong == {}, verdict.examples


def test_a_sync_lost_in_front_of_the_bus_holds_no_later_reading_up() -> None:
    """Each waited for its echo until the next SYNC: 61 of 1437 decisions rested on the reading of their
    cycle."""
    rows = run_with_taps(bench_config(drawn_plan(460891), 200)).rows
    used = rows[rows["fate"] == USED]
    assert np.mean(used["estimate_sequence"] == used["sequence"]) > 0.98


def test_a_feature_that_is_left_out_changes_no_other() -> None:
    for seed in range(30):
        plan = drawn_plan(seed)
        said = dict(zip(plan.features, plan.words, strict=True))
        fewer = drawn_plan(seed, without=["loss", "adapter", "held frames"])
        assert not {"loss", "adapter", "held frames"} & set(fewer.features)
        assert {name: said[name] for name in fewer.features} == dict(
            zip(fewer.features, fewer.words, strict=True)
        )


def test_every_feature_is_drawn_and_makes_a_bench() -> None:
    drawn: set[str] = set()
    for seed in range(480_000, 480_060):
        plan = drawn_plan(seed)
        drawn |= set(plan.features)
        bench_config(plan, CYCLES)
    assert drawn == set(FEATURES)


def test_a_failing_plan_shrinks_to_what_it_needs_to_fail() -> None:
    seed = next(seed for seed in range(1000) if {"loss", "adapter"} <= set(drawn_plan(seed).features))

    def fails(plan: DrawnPlan) -> bool:
        return {"loss", "adapter"} <= set(plan.features)

    assert len(drawn_plan(seed).features) > 2
    assert shrunk(drawn_plan(seed), fails).features == ["loss", "adapter"]


def through(adapter: Adapter) -> tuple[list[tuple[Instant, bool, Instant]], list[Instant]]:
    """What an adapter brings of frames that a loop and another node send in turn: stamp, echo or not and the
    instant at which it was fetched; and the ends of all frames on the bus."""
    timeline = Timeline()
    segment = CanSegment(timeline, 1_000_000)
    bus, other = (SimulatedBus(segment=segment, receive_own_messages=own) for own in (True, False))
    ends: list[Instant] = []
    segment.add_monitor(lambda _frame, at: ends.append(at))
    port = AdapterPort(bus.frame_port, adapter, 1, lambda: timeline.now)
    came = []
    for number in range(SENT):
        frame = WireFrame(0x181, bytes([number]))
        frame.handed_at = timeline.now
        port.transmit(frame)
        other.frame_port.transmit(WireFrame(0x201, bytes([number])))
        until = Instant(timeline.now + NS_PER_MS)
        while (fetched := port.receive(until)) is not None:
            assert fetched.handed_at == UNTOLD
            came.append((port.came_at, port.came_own, timeline.now))
    bus.shutdown()
    other.shutdown()
    return came, ends


@pytest.mark.parametrize("basis", [EchoBasis.KERNEL, EchoBasis.RECEIPT, EchoBasis.HARDWARE, EchoBasis.NONE])
def test_an_adapter_brings_every_frame_late_and_stamps_it(basis: EchoBasis) -> None:
    came, ends = through(Adapter(basis, 400.0))
    late = 400 * NS_PER_US
    kinds = (False,) if basis is EchoBasis.NONE else (False, True)
    for own in kinds:
        stamps = [at for at, is_own, _ in came if is_own is own]
        true = ends[1::2] if own is False else ends[::2]
        errors = [at - end for at, end in zip(stamps, true, strict=True)]
        assert min(errors) >= 0
        if basis is EchoBasis.HARDWARE:
            assert max(errors) < NS_PER_US
        else:
            assert late // 2 < max(errors) <= late
        assert all(earlier <= later for earlier, later in pairwise(stamps))
    assert len(came) == SENT * len(kinds)
    assert all(fetch >= at for at, _, fetch in came)
    changed_places = any(first[1] is False and then[1] is True for first, then in pairwise(came))
    assert changed_places is (basis is not EchoBasis.NONE)
