"""Readings without a stamp, step by step: each placement, what is said of it, the probes that settle it."""

import pytest

from servobench.drivers.record import replaced
from servobench.drivers.timebase import NS_PER_US, Duration, Instant
from servobench.drivers.wire.frame_port import EchoBasis
from servobench.hil.loop.attribution import HELD_MAX
from servobench.hil.loop.beats import Beats
from servobench.hil.loop.order_attribution import OrderAttribution
from servobench.hil.loop.order_memory import HELD_UP
from servobench.hil.loop.order_question import ASK_AGAIN_AFTER, PROBE_AFTER, STRAYS_MAX
from servobench.hil.loop.residuals import HIDDEN_PARTS
from servobench.hil.loop.samples import Sample
from servobench.hil.loop.syncs import SURPLUS, SyncLog
from servobench.hil.loop.usual_delays import ALIKE_MIN, FIRST, KEPT, RESOLUTION_NS
from tests.unit.hil.loop_fakes import PERIOD, SYNC_LATENCY, TRANSIT, reading_at

DELAY = 240_000
TIMER = 5 * PERIOD
"""The drive tells its statusword so often."""
ECHO = NS_PER_US
"""How far an echo with the stamp of an adapter may err."""
ERROR = ECHO + TRANSIT // HIDDEN_PARTS
"""Beside that, what the three bits between SYNC and reading hide."""
QUARTER = PERIOD // 4


class Rig:
    """SYNC n ends at n periods, those that are left out as well, and the first has taught the usual delay."""

    def __init__(self, delay: int = DELAY) -> None:
        self.told: list[str] = []
        self.log = SyncLog(SYNC_LATENCY, PERIOD, EchoBasis.HARDWARE)
        self.beats = Beats(PERIOD, Duration(TIMER))
        for before in range(-8, 0):
            self.beats.take(Instant(before * TIMER))
        self.order = OrderAttribution(self.log, PERIOD, TRANSIT, self.told.append, self.beats)
        self.sync(1)
        self.order.learn(reading_at(Instant(PERIOD + delay)), self.log.marks[0])
        self.speed = 0.0

    def sync(self, number: int, late: int = 0, sequence: int | None = None) -> None:
        for unanswered in range(self.log.counted + 1, number):
            self.log.heard(unanswered, Instant(unanswered * PERIOD))
        at = Instant(number * PERIOD + late)
        self.log.heard(number if sequence is None else sequence, at)

    def comes(self, at: int) -> Sample | None:
        self.speed += 1.0
        reading = reading_at(Instant(at), velocity_rad_s=self.speed)
        return self.order.place(replaced(reading, status_told_at=Instant(at // TIMER * TIMER)))

    def comes_again(self, at: int) -> Sample | None:
        """The last reading, once more."""
        self.speed -= 1.0
        return self.comes(at)

    def answered(self, number: int, late: int = 0, delay: int = DELAY) -> Sample | None:
        """SYNC ``number`` goes out, and a reading comes ``delay`` after it."""
        self.sync(number, late)
        return self.comes(number * PERIOD + late + delay)

    def ask(self, missing: int = 1) -> list[Sample | None]:
        """So many readings are missing, and as many come as are watched before a probe."""
        first = 2 + missing
        return [self.answered(first + place) for place in range(PROBE_AFTER)]

    def probe(self, lag: int = 0) -> list[Sample | None]:
        """The next SYNC goes out late; what comes until one so many SYNCs later has been answered, as late as
        the one that it answers."""
        assert self.order.wants_probe
        number = self.log.counted + 1
        samples = []
        for place in range(lag + 1):
            self.sync(number + place, QUARTER if place == 0 else 0)
            if place == 0:
                self.order.probed(self.log.marks[-1])
            samples.append(self.comes((number + place) * PERIOD + DELAY + (QUARTER if place == lag else 0)))
        return samples

    def amended(self, *samples: Sample | None) -> list[tuple[int, bool]]:
        """What the rows of these say after all."""
        question = self.order.question
        made = [question.applied(each, each.reading.received_at) for each in samples if each is not None]
        return [(each.sequence, each.certain) for each in made]


def placed(sample: Sample | None) -> tuple[int, bool] | None:
    return None if sample is None else (sample.sequence, sample.certain)


def test_a_reading_answers_the_sync_that_ended_as_long_before_as_is_usual() -> None:
    rig = Rig()
    samples = [rig.answered(number) for number in range(2, 40)]
    assert [placed(sample) for sample in samples] == [(number, True) for number in range(2, 40)]
    bounds = [(each.sampled_at, each.sampled_at_error_ns) for each in samples if each is not None]
    assert bounds[0] == (2 * PERIOD, ECHO + DELAY - TRANSIT)  # a calibration says little of a run
    assert bounds[-1] == (39 * PERIOD, ERROR)
    health = rig.order.health
    assert (health.placed, health.unmatched, health.below_transit) == (38, 0, 0)
    assert health.error_ns_max == ECHO + DELAY - TRANSIT
    assert (rig.told, rig.order.wants_probe, rig.order.question.open) == ([], False, False)


def test_a_reading_without_a_sync_before_it_or_of_no_cycle_answers_none() -> None:
    rig = Rig()
    assert rig.comes(PERIOD - 1) is None
    rig.sync(2, sequence=SURPLUS)
    assert rig.comes(2 * PERIOD + DELAY) is None
    assert rig.order.health.unmatched == 2


@pytest.mark.parametrize(("early", "below"), [(0, 0), (ECHO, 0), (ECHO + 1, 1)])
def test_a_reading_that_comes_sooner_than_its_frame_takes_is_counted(early: int, below: int) -> None:
    rig = Rig()
    rig.order.learn(reading_at(Instant(PERIOD + TRANSIT)), rig.log.marks[0])
    assert placed(rig.answered(2, delay=TRANSIT - early)) == (2, True)
    assert rig.order.health.below_transit == below


def test_a_delay_that_changes_within_the_period_is_no_question_while_every_sync_is_answered() -> None:
    rig = Rig()
    assert [placed(rig.answered(number, delay=DELAY + 300_000)) for number in (2, 3)] == [
        (2, True),
        (3, True),
    ]
    assert placed(rig.answered(4, delay=DELAY)) == (4, True)
    assert not rig.order.question.open


def test_after_a_gap_a_probe_that_is_answered_late_shows_that_a_reading_was_lost() -> None:
    rig = Rig()
    before = rig.ask()
    assert [placed(sample) for sample in before] == [(3, False), (4, False), (5, False)]
    assert (rig.order.wants_probe, rig.order.question.open) == (True, True)
    assert [placed(sample) for sample in rig.probe()] == [(6, True)]
    assert (rig.order.wants_probe, rig.order.question.open, rig.order.question.cleared) == (
        False,
        False,
        True,
    )
    assert rig.amended(*before) == [(3, True), (4, True), (5, True)]
    assert rig.told == []


@pytest.mark.parametrize("lag", [1, 2])
def test_after_a_gap_a_probe_that_is_answered_later_shows_by_how_much_the_delay_has_grown(lag: int) -> None:
    rig = Rig()
    before = rig.ask(missing=2)
    *_, last = rig.probe(lag)
    assert placed(last) == (7, True), "the probe"
    assert rig.amended(*before) == [(4, False), (5, False), (6, False)]
    assert rig.told == [f"its readings come {DELAY // 1000 + 1000 * lag} us after their SYNC now"]
    after = rig.answered(8 + lag)
    assert placed(after) == (8, True)


def test_an_uneven_host_answers_by_itself() -> None:
    rig = Rig()
    samples = [rig.answered(number, late) for number, late in ((3, 0), (4, 90_000))]
    assert placed(samples[-1]) == (4, True)
    assert (rig.amended(samples[0]), rig.order.wants_probe) == ([(3, True)], False)


@pytest.mark.parametrize(("off", "believed"), [(0, True), (RESOLUTION_NS, True), (30_000, False)])
def test_where_no_probe_goes_out_the_delay_is_what_it_was_if_it_looks_so(off: int, believed: bool) -> None:
    rig = Rig()
    samples = [rig.answered(3 + number, delay=DELAY + off) for number in range(ALIKE_MIN + 1)]
    assert samples[-1] is not None
    assert samples[-1].certain is believed


@pytest.mark.parametrize(("before", "believed"), [(0, True), (FIRST, False)])
def test_stuff_bits_make_the_least_delay_another_only_at_the_begin_of_a_run(
    before: int, believed: bool
) -> None:
    """A calibration knows the frames of a shaft at rest: 99 % of a run stayed in doubt for 3 us."""
    rig = Rig()
    for number in range(before):
        rig.answered(2 + number)
    first = 3 + before
    samples = [rig.answered(first + number, delay=DELAY - 3_000) for number in range(ALIKE_MIN + 1)]
    assert samples[-1] is not None
    assert samples[-1].certain is believed


def test_a_question_without_an_answer_ends_and_is_put_again() -> None:
    """Its readings come at another phase, and nobody sends a probe."""
    rig = Rig()
    for number in range(HELD_MAX):
        rig.answered(4 + number, delay=DELAY + 300_000)
        assert rig.order.question.open
    while rig.order.question.open:
        rig.answered(rig.log.counted + 1, delay=DELAY + 300_000)
    given_up = rig.log.counted
    assert given_up <= 4 + HELD_MAX + STRAYS_MAX
    assert ["it cannot be told which SYNCs" in text for text in rig.told] == [True]
    assert not rig.order.wants_probe
    number = rig.log.counted
    while not rig.order.wants_probe:
        number += 1
        rig.answered(number, delay=DELAY + 300_000)
    assert number == given_up + ASK_AGAIN_AFTER


def test_a_reading_that_was_held_up_is_uncertain_and_the_others_are_not() -> None:
    rig = Rig()
    rig.ask()
    rig.probe()
    held = rig.comes(6 * PERIOD + DELAY + 500_000)
    assert placed(held) == (2, False), "the one that is missing"
    assert rig.amended(Sample(6, reading_at(Instant(0)), Instant(0), 0, certain=True)) == [(6, False)]
    assert placed(rig.answered(7)) == (7, True)
    assert rig.told == []


def test_while_frames_are_held_up_a_reading_behind_a_gap_may_be_an_earlier_one() -> None:
    rig = Rig()
    rig.ask()
    rig.probe()
    rig.comes(6 * PERIOD + DELAY + 500_000)
    rig.answered(8)
    rig.answered(9, 90_000)
    rig.answered(10, 50_000)
    assert not rig.order.question.open
    certain = [rig.answered(number) for number in range(11, 9 + HELD_UP)]
    assert [sample is not None and sample.certain for sample in certain] == [False, True]


def test_of_two_readings_of_one_sync_neither_is_believed() -> None:
    rig = Rig()
    first = rig.answered(2)
    assert rig.comes(2 * PERIOD + DELAY + 10_000) is None
    assert rig.amended(first) == [(2, False)]
    assert rig.order.health.unmatched == 1


def test_a_copy_of_a_reading_is_not_believed_where_frames_come_twice() -> None:
    rig = Rig()
    rig.answered(2)
    rig.comes(2 * PERIOD + DELAY + 10_000)
    assert placed(rig.answered(3)) == (3, True)
    rig.speed -= 1.0
    assert placed(rig.answered(4)) == (4, False), "it tells what the one before told"


def test_several_readings_at_another_phase_put_the_question_and_a_probe_answers_it() -> None:
    """Each comes 1300 us later than before, and the first is missing."""
    rig = Rig()
    late = DELAY + 300_000
    number = 2
    while not rig.order.wants_probe:
        number += 1
        sample = rig.answered(number, delay=late)
        assert sample is None or not sample.certain
    assert number >= 2 + STRAYS_MAX
    number += 1
    rig.sync(number, QUARTER)
    rig.order.probed(rig.log.marks[-1])
    rig.comes(number * PERIOD + late)
    sample = rig.answered(number + 1, delay=late + QUARTER)
    while sample is None or not sample.certain:
        assert rig.log.counted < number + 8
        sample = rig.answered(rig.log.counted + 1, delay=late)
    assert sample.sequence == rig.log.counted - 1
    assert rig.told == [f"its readings come {(late + PERIOD) // 1000} us after their SYNC now"]


def test_readings_that_were_let_go_of_before_the_run_are_not_missing() -> None:
    rig = Rig()
    rig.sync(5)
    rig.order.skip(reading_at(Instant(5 * PERIOD + DELAY)))
    assert placed(rig.answered(6)) == (6, True)


def test_of_a_sync_whose_end_is_not_known_nothing_is_learned() -> None:
    rig = Rig()
    rig.log.handed(2, Instant(2 * PERIOD))
    rig.order.learn(reading_at(Instant(2 * PERIOD + 2 * DELAY)), rig.log.marks[-1])
    assert placed(rig.answered(3)) == (3, True), "the second was never on the bus"


def test_two_readings_in_one_period_are_those_of_two_syncs_though_the_second_has_a_usual_delay() -> None:
    """A gateway of a period goes away: 398 rows of 1500 stood one SYNC early, for certain."""
    long = PERIOD + 200_000
    short = long - PERIOD - 20_000  # from the SYNC before it is as usual as ``long``
    rig = Rig(long)
    rig.sync(2)
    for number in range(2, 2 + FIRST + KEPT):
        rig.sync(number + 1)
        assert placed(rig.comes(number * PERIOD + long)) == (number, True)
    last = rig.log.counted
    assert placed(rig.comes(last * PERIOD + 500_000)) == (last, True)
    for number in range(last + 1, last + 1 + KEPT):
        assert placed(rig.answered(number, delay=short)) == (number, True)
    assert not rig.order.question.open


def test_a_shift_beyond_a_sync_that_was_not_heard_is_counted_with_it() -> None:
    """An uneven host, a SYNC of another node that is not heard, and readings that come a period later."""
    rig = Rig()
    uneven = [0, 70_000, -50_000, 30_000, -80_000, 60_000, -20_000, 90_000, -60_000, 40_000]
    ends = [0]
    for number, late in enumerate(uneven * 3, start=2):
        ends.append(number * PERIOD + late)
    heard = [end for place, end in enumerate(ends[1:], start=2) if place != 6]
    grown = 4
    came = [end + DELAY + (PERIOD if place >= grown else 0) for place, end in enumerate(ends[1:], start=2)]
    frames = sorted([(end, True) for end in heard] + [(at, False) for at in came])
    placed_in: list[Sample] = []
    for at, is_sync in frames:
        if is_sync:
            rig.log.heard(rig.log.counted + 1, Instant(at))
        elif sample := rig.comes(at):
            placed_in.append(sample)
    certain = [sample for sample in placed_in if sample.certain]
    delays = {round((sample.reading.received_at - sample.sampled_at) / PERIOD, 2) for sample in certain}
    assert delays <= {0.24, 1.24}
    assert 1.24 in delays
    assert rig.told == [f"its readings come {(PERIOD + DELAY) // 1000} us after their SYNC now"]


def delays_after_a_loss(frame: int) -> list[Sample | None]:
    """The readings behind one that was lost, most of them off by ``frame``."""
    rig = Rig()
    for number in range(2, 8):
        rig.answered(number)
    return [rig.answered(number, delay=DELAY + (number % 7 > 2) * frame) for number in range(9, 140)]


def test_delays_below_the_usual_ones_may_have_grown_by_a_little_less_than_whole_periods() -> None:
    assert not any(sample is not None and sample.certain for sample in delays_after_a_loss(-TRANSIT // 2))


def test_delays_that_hold_the_usual_ones_are_those_of_before_where_a_reading_was_lost() -> None:
    """Another node's frame comes in front of some of them."""
    samples = delays_after_a_loss(TRANSIT)
    settled = next(place for place, sample in enumerate(samples) if sample is not None and sample.certain)
    assert settled < HELD_MAX
    assert [sample.sequence for sample in samples if sample is not None] == list(range(9, 140))
    assert all(sample is not None and sample.certain for sample in samples[settled:])


def test_where_each_sync_has_a_reading_in_its_own_period_none_was_lost_however_delays_spread() -> None:
    rig = Rig()
    rig.answered(2)
    late = [DELAY + PERIOD * part // 20 for part in (12, 3, 9, 11, 6, 8, 12, 4, 10, 5, 7, 9, 11, 8)]
    samples = [rig.answered(number, delay=delay) for number, delay in enumerate(late, start=3)]
    assert [placed(sample) for sample in samples[-3:]] == [(14, True), (15, True), (16, True)]
    of_question = samples[STRAYS_MAX + 1 : -3]
    assert rig.amended(*of_question) == [(number, True) for number in range(4 + STRAYS_MAX, 14)]


def test_delays_that_spread_and_lack_a_reading_are_a_question_still() -> None:
    rig = Rig()
    rig.answered(2)
    late = [DELAY + PERIOD * part // 20 for part in (12, 3, 9, 11, 6, 8, 12, 4, 10, 5, 7, 9, 11, 8)]
    samples = [rig.answered(number, delay=delay) for number, delay in enumerate(late, start=4)]
    assert not any(sample is not None and sample.certain for sample in samples)


@pytest.mark.parametrize("copy", [False, True], ids=["its own", "a copy"])
def test_a_copy_in_the_place_of_a_lost_reading_is_not_confirmed_by_the_answer(copy: bool) -> None:
    """It comes at an unusual delay while it is open whether another one was lost."""
    rig = Rig()
    rig.answered(2)
    rig.comes(2 * PERIOD + DELAY + 10_000)
    for number in range(3, 16):
        rig.answered(number)
    for number in range(17, 22):
        rig.answered(number)
    rig.sync(22)
    rig.speed -= copy
    unusual = rig.comes(22 * PERIOD + DELAY + PERIOD // 3)
    number = 22
    while not rig.order.settled:
        number += 1
        rig.answered(number)
        assert number < 22 + HELD_MAX
    assert rig.amended(unusual) == [(22, not copy)]


def test_a_reading_behind_a_copy_may_be_of_the_sync_at_which_that_was_placed() -> None:
    """A copy comes a usual delay after the next SYNC, whose own reading waits until a usual delay after the
    one behind it."""
    rig = Rig()
    for number in range(2, 60):
        rig.answered(number, delay=DELAY + number % 10 * DELAY // 6)
    assert rig.comes_again(59 * PERIOD + 3 * DELAY) is None
    assert placed(rig.answered(60)) == (60, True)
    rig.sync(61)
    copy = rig.comes_again(61 * PERIOD + DELAY)
    assert placed(copy) == (61, False)
    assert placed(rig.answered(62)) == (62, False)
    assert placed(rig.answered(63)) == (63, True)
