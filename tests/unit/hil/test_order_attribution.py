"""Readings without a stamp, step by step: each placement, what is said of it, the probes that settle it."""

import pytest

from drivers.timebase import NS_PER_US, Instant
from drivers.wire.frame_port import EchoBasis
from hil.loop.order_attribution import PROBE_AGAIN_AFTER, OrderAttribution
from hil.loop.samples import Sample
from hil.loop.syncs import SURPLUS, SyncLog
from tests.unit.hil.loop_fakes import PERIOD, SYNC_LATENCY, TRANSIT, reading_at

DELAY = 240_000
ECHO = NS_PER_US
"""How far an echo with the stamp of an adapter may err."""
BEYOND = (
    "its readings come later than the next SYNC; without a stamp of the drive's clock beside the"
    " speed it cannot be told which SYNC they answer: they are marked uncertain"
)
AGAIN = "its readings answer the SYNC before them again"


class Rig:
    """SYNC n ends at n periods, those that are left out as well, and the first has taught the usual delay."""

    def __init__(self, echoes: EchoBasis = EchoBasis.HARDWARE) -> None:
        self.told: list[str] = []
        self.log = SyncLog(SYNC_LATENCY, PERIOD, echoes)
        self.order = OrderAttribution(self.log, PERIOD, TRANSIT, self.told.append)
        self.sync(1)
        self.order.learn(reading_at(Instant(PERIOD + DELAY)), self.log.marks[0])

    def sync(self, number: int, late: int = 0, sequence: int | None = None) -> None:
        for unanswered in range(self.log.counted + 1, number):
            self.log.heard(unanswered, Instant(unanswered * PERIOD))
        at = Instant(number * PERIOD + late)
        self.log.heard(number if sequence is None else sequence, at)

    def answer(self, delay: int = DELAY) -> Sample | None:
        """What comes so long after the last SYNC."""
        at = self.log.marks[-1].on_bus_at
        assert at is not None
        return self.order.place(reading_at(Instant(at + delay)))

    def answered(self, number: int, late: int = 0, delay: int = DELAY) -> Sample | None:
        self.sync(number, late)
        return self.answer(delay)

    def probe(self, number: int, late: int = PERIOD // 4, delay: int = DELAY) -> Sample | None:
        """SYNC ``number`` goes out late and is answered."""
        assert self.order.wants_probe
        self.sync(number, PERIOD // 4)
        self.order.probed(self.log.marks[-1])
        return self.answer(delay + PERIOD // 4 - late)

    def amended(self, *samples: Sample | None) -> list[tuple[int, bool, int]]:
        """What the rows of these say after all."""
        made = [self.order.question.applied(sample) for sample in samples if sample is not None]
        return [
            (each.sequence, each.certain, each.sampled_at_error_ns)
            for each in made
            if isinstance(each, Sample)
        ]


def placed(sample: Sample | None) -> tuple[int, int, int, bool] | None:
    if sample is None:
        return None
    return sample.sequence, sample.sampled_at, sample.sampled_at_error_ns, sample.certain


def counts(rig: Rig) -> tuple[int, int, int, int]:
    health = rig.order.health
    return health.placed, health.unmatched, health.below_transit, health.error_ns_max


def test_a_reading_answers_the_sync_before_it() -> None:
    rig = Rig()
    assert [placed(rig.answered(number)) for number in (2, 3)] == [
        (2, 2 * PERIOD, ECHO, True),
        (3, 3 * PERIOD, ECHO, True),
    ]
    assert counts(rig) == (2, 0, 0, ECHO)
    assert (rig.told, rig.order.wants_probe, rig.order.question.open) == ([], False, False)


def test_a_reading_without_a_sync_before_it_or_of_no_cycle_answers_none() -> None:
    rig = Rig()
    assert rig.order.place(reading_at(Instant(PERIOD - 1))) is None
    rig.sync(2, sequence=SURPLUS)
    assert rig.answer() is None
    assert counts(rig) == (0, 2, 0, 0)


@pytest.mark.parametrize(("early", "below"), [(0, 0), (ECHO, 0), (ECHO + 1, 1)])
def test_a_reading_that_comes_sooner_than_its_frame_takes_is_counted(early: int, below: int) -> None:
    rig = Rig()
    assert placed(rig.answered(2, delay=TRANSIT - early)) == (2, 2 * PERIOD, ECHO, True)
    assert counts(rig) == (1, 0, below, ECHO)


def test_after_a_gap_readings_are_uncertain_until_a_probe_is_answered_as_late_as_it_went() -> None:
    rig = Rig()
    first = rig.answered(3)
    assert placed(first) == (3, 3 * PERIOD, ECHO + 2 * PERIOD + DELAY, False), "it may be of any SYNC known"
    assert (rig.order.wants_probe, rig.order.question.open) == (True, True)
    second = rig.answered(4)
    assert placed(second) == (4, 4 * PERIOD, ECHO + 3 * PERIOD + DELAY, False)
    assert counts(rig) == (2, 0, 0, 0), "what is uncertain tells nothing of errors"
    third = rig.probe(5)
    assert placed(third) == (5, 5 * PERIOD + PERIOD // 4, ECHO, True)
    assert (rig.order.wants_probe, rig.order.question.open, rig.order.question.cleared) == (
        False,
        False,
        True,
    )
    assert rig.amended(first, second) == [(3, True, ECHO), (4, True, ECHO)]
    told_again = [(3, False, ECHO + 2 * PERIOD + DELAY), (4, False, ECHO + 3 * PERIOD + DELAY)]
    assert rig.amended(first, second) == told_again, "amended once"
    assert rig.told == []


def test_while_a_probe_is_out_no_other_is_wanted() -> None:
    rig = Rig()
    rig.answered(3)
    rig.sync(4, PERIOD // 4)
    rig.order.probed(rig.log.marks[-1])
    assert not rig.order.wants_probe
    assert placed(rig.order.place(reading_at(Instant(4 * PERIOD + DELAY)))) is None, "a second answer to 3"
    assert not rig.order.wants_probe


@pytest.mark.parametrize(
    ("off", "sure"),
    [(PERIOD // 8 - 1, True), (PERIOD // 8, False), (-PERIOD // 8 + 1, True), (-PERIOD // 8, False)],
)
def test_a_probe_is_answered_if_its_reading_is_an_eighth_of_a_period_from_the_usual_at_most(
    off: int, sure: bool
) -> None:
    rig = Rig()
    rig.answered(3)
    sample = rig.probe(4, delay=DELAY + off)
    assert sample is not None
    assert sample.certain is sure
    assert rig.told == ([] if sure else [BEYOND])
    assert not rig.order.question.open


def test_the_usual_delay_follows_by_a_quarter_of_each_change() -> None:
    """From 240 us to 240 + 80 (1 - 0.75^2) = 275 us after two readings."""
    for last, sure in [(275_000 + PERIOD // 8 - 1, True), (275_000 + PERIOD // 8, False)]:
        rig = Rig()
        rig.answered(3, delay=320_000)
        rig.answered(4, delay=320_000)
        sample = rig.probe(5, delay=last)
        assert sample is not None
        assert sample.certain is sure


def test_a_second_reading_between_two_syncs_shows_that_they_come_late() -> None:
    rig = Rig()
    rig.answered(2)
    assert rig.answer(DELAY + 100_000) is None
    assert rig.told == [BEYOND]
    late = rig.answered(3)
    assert placed(late) == (3, 3 * PERIOD, ECHO + 2 * PERIOD + DELAY, False)
    assert (counts(rig), rig.order.question.open) == ((2, 1, 0, ECHO), False)
    assert rig.answer(DELAY + 100_000) is None
    assert rig.told == [BEYOND], "said once"
    assert counts(rig) == (2, 2, 0, ECHO)


def test_a_second_reading_after_a_gap_ends_the_wait_for_a_probe() -> None:
    rig = Rig()
    rig.answered(3)
    assert (rig.order.wants_probe, rig.order.question.open) == (True, True)
    assert rig.answer(DELAY + 100_000) is None
    assert (rig.order.wants_probe, rig.order.question.open, rig.told) == (False, False, [BEYOND])


def test_each_gap_has_its_own_question_and_answer() -> None:
    rig = Rig()
    first = rig.answered(3)
    rig.probe(4)
    assert rig.amended(first) == [(3, True, ECHO)]
    second = rig.answered(6)
    rig.probe(7)
    assert rig.amended(second, first) == [(6, True, ECHO), (3, False, ECHO + 2 * PERIOD + DELAY)]
    assert rig.told == []


def test_that_readings_come_late_is_said_anew_after_they_came_in_time() -> None:
    rig = Rig()
    rig.answered(2)
    rig.answer(DELAY + 100_000)
    rig.answered(2 + PROBE_AGAIN_AFTER)
    rig.probe(3 + PROBE_AGAIN_AFTER)
    rig.answered(5 + PROBE_AGAIN_AFTER)
    assert rig.order.question.open, "there was a gap"
    rig.answer(DELAY + 100_000)
    assert rig.told == [BEYOND, AGAIN, BEYOND]


@pytest.mark.parametrize("answered_in_time", [True, False])
def test_a_hundred_syncs_after_a_failure_it_is_tried_again(answered_in_time: bool) -> None:
    rig = Rig()
    rig.answered(2)
    rig.answer(DELAY + 100_000)
    uncertain = []
    for number in range(3, 2 + PROBE_AGAIN_AFTER):
        uncertain.append(rig.answered(number))
        assert not rig.order.wants_probe
    uncertain.append(rig.answered(2 + PROBE_AGAIN_AFTER))
    last = rig.probe(3 + PROBE_AGAIN_AFTER, late=PERIOD // 4 if answered_in_time else 0)
    assert last is not None
    assert last.certain is answered_in_time
    assert {certain for _, certain, _ in rig.amended(*uncertain)} == {False}, "they stay so"
    assert not rig.order.question.cleared
    assert rig.told == ([BEYOND, AGAIN] if answered_in_time else [BEYOND])
    following = rig.answered(4 + PROBE_AGAIN_AFTER)
    assert following is not None
    assert (following.certain, rig.order.wants_probe) == (answered_in_time, False)


def test_what_is_learned_is_the_last_sync_answered() -> None:
    """Its number and its delay; of a SYNC whose end is not known, nothing."""
    rig = Rig(EchoBasis.BUS)
    rig.log.handed(2, Instant(2 * PERIOD))
    rig.order.learn(reading_at(Instant(2 * PERIOD + 9 * DELAY)), rig.log.marks[-1])
    sample = rig.answered(3)
    assert sample is not None
    assert not sample.certain, "2 is open as before"


def test_where_the_oldest_sync_never_came_to_the_bus_its_hand_over_bounds_the_error() -> None:
    log = SyncLog(SYNC_LATENCY, PERIOD, EchoBasis.HARDWARE)
    order = OrderAttribution(log, PERIOD, TRANSIT, print)
    log.handed(1, Instant(PERIOD))
    log.heard(2, Instant(2 * PERIOD))
    assert placed(order.place(reading_at(Instant(2 * PERIOD + DELAY)))) == (
        2,
        2 * PERIOD,
        ECHO + PERIOD + DELAY,
        False,
    )
