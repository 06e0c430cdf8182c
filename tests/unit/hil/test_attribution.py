"""Which SYNC a reading answers, against a made-up world that knows."""

import random
from collections.abc import Callable

import pytest

from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.drivers.wire.frame_port import EchoBasis
from servobench.hil.loop.attribution import Question
from servobench.hil.loop.samples import Sample
from servobench.hil.loop.syncs import ECHO_ERROR, GIVEN_UP_AFTER_PERIODS, REMEMBERED, SyncLog
from tests.draws import few_of
from tests.unit.hil.attribution_world import Network, Outcome, play
from tests.unit.hil.loop_fakes import PERIOD, SYNC_LATENCY, reading_at

Delay = Callable[[int, random.Random], int | None]


def uniform(low_us: int, high_us: int, loss: float = 0.0) -> Delay:
    return lambda _n, r: None if r.random() < loss else r.randint(low_us * 1000, high_us * 1000)


DELAYS: dict[str, Delay] = {
    "fixed": lambda _n, _r: 240_000,
    "loss": uniform(240, 240, 0.1),
    "above a period": lambda _n, _r: 1_240_000,
    "five periods": lambda _n, _r: 5_300_000,
    "uniform": uniform(150, 900, 0.05),
    "reordered": uniform(150, 3_500, 0.02),
    "burst": lambda n, _r: None if n % 300 > 280 else 300_000,
}


def judge(outcome: Outcome, readings_min: int) -> None:
    assert outcome.misjudged == []
    assert outcome.violations == []
    assert len(outcome.placed) >= readings_min
    assert outcome.errors[len(outcome.errors) * 99 // 100] < 2_000
    health = outcome.by_stamp.health
    assert health.below_transit == health.before_sync == health.two_stamps == 0


@pytest.mark.parametrize("drift_ppm", few_of([-1000.0, 0.0, 100.0, 1000.0], 2))
@pytest.mark.parametrize("name", DELAYS)
def test_no_reading_is_misplaced_and_none_uncertain_once_the_delays_are_known(
    name: str, drift_ppm: float
) -> None:
    outcome = play(Network(DELAYS[name], drift_ppm=drift_ppm), 2000)
    judge(outcome, 1600)
    assert max(outcome.uncertain, default=0) <= 50, "calibration had another delay"


@pytest.mark.long
@pytest.mark.parametrize("drift_ppm", few_of([1000.0, 0.0], 1))
@pytest.mark.parametrize("step_ns", few_of([-350_000, 37_000, 2_000_000, 200_000, 800_000, 10**9], 3))
@pytest.mark.parametrize("name", DELAYS)
def test_a_clock_that_is_set_costs_fifty_cycles_at_most(name: str, step_ns: int, drift_ppm: float) -> None:
    """Also where it is set by whole periods: each SYNC is late by a part of 5 us of its own."""
    network = Network(
        DELAYS[name],
        lateness=lambda _n, r: r.randint(0, 5_000),
        drift_ppm=drift_ppm,
        steps={500: step_ns, 1000: -step_ns},
    )
    outcome = play(network, 1500)
    judge(outcome, 1200)
    uncertain = {number for number in outcome.uncertain if number > 50}
    assert uncertain <= {*range(484, 550), *range(984, 1050)}, sorted(uncertain)
    assert outcome.by_stamp.health.steps == len(outcome.told) == 2


@pytest.mark.parametrize("seed", [5, 19, 20, 40])
def test_a_reading_shorter_than_any_before_does_not_show_that_the_clock_ran_on(seed: int) -> None:
    """Delays of two parts in a queue are rare near their least: a clock that was set back by a period makes
    one look longer by it, so that a shorter one than any before seemed to exclude it."""
    before = 0

    def queued(_number: int, choices: random.Random) -> int:
        nonlocal before
        delay = 300_000 + choices.randrange(PERIOD * 7 // 10) + choices.randrange(PERIOD * 7 // 10)
        before = max(delay, before - PERIOD)
        return before

    dithered = Network(
        delay=queued, lateness=lambda _n, choices: choices.randrange(5_000), steps={900: -PERIOD}
    )
    outcome = play(dithered, 1000, seed)
    assert outcome.misjudged == []
    assert len(outcome.uncertain) < 100


@pytest.mark.parametrize("seed", [7, 36, 44, 45])
def test_a_clock_set_back_while_the_jitter_of_the_sync_is_being_learned_is_no_grown_delay(seed: int) -> None:
    """A calibration was quiet. From then on SYNCs are late to the drive by up to half a period, and before
    the question of that is answered the clock is set by three: by what stamps scattered so far only a wrong
    line, on which a few lay well by chance, seemed possible."""
    jittery = Network(
        delay=lambda _n, choices: None if choices.random() < 0.07 else 130_000 + choices.randrange(100_000),
        sync_delay=lambda _n, choices: choices.randrange(475_000),
        lateness=lambda number, choices: choices.randrange(110_000) if number % 4 == 0 else 0,
        steps={38: -3 * PERIOD},
    )
    assert play(jittery, 160, seed).misjudged == []


def test_a_late_host_misplaces_nothing() -> None:
    def lateness(_n: int, r: random.Random) -> int:
        return r.choice([0, 0, 0, 80_000, 490_000])

    outcome = play(Network(uniform(150, 900, 0.02), lateness=lateness, drift_ppm=-100.0), 5000)
    judge(outcome, 4500)
    assert outcome.uncertain == []


def test_a_reading_that_comes_twice_is_known_by_its_stamp() -> None:
    outcome = play(Network(duplicate=lambda n, _r: 3_000_000 if n % 3 == 0 else None), 2500)
    judge(outcome, 2500)
    assert len(outcome.placed) == 2500
    assert outcome.by_stamp.health.duplicates == 833


def test_a_sync_that_is_late_to_the_drive_shifts_the_sample_not_the_cycle() -> None:
    """As behind a gateway; the smallest delay of it cannot be seen, so it is 0 here. A map through the middle
    of such stamps wanders by some microseconds."""
    outcome = play(Network(sync_delay=lambda _n, r: r.choice([0, r.randint(0, 200_000)])), 6000)
    assert outcome.misjudged == []
    assert outcome.violations == []
    settled = [truth for truth in outcome.placed if truth.sequence > 500]
    errors = sorted(abs(truth.sample.sampled_at - truth.sampled_at) for truth in settled)
    assert errors[len(errors) * 99 // 100] < 10_000
    assert sum(not truth.sample.certain for truth in settled) < 0.02 * len(settled)


def test_two_stamps_for_one_sync_are_an_alarm() -> None:
    outcome = play(Network(), 200)
    place, log = outcome.by_stamp, outcome.by_stamp._syncs
    mark = log.marks[-5]
    assert mark.on_bus_at is not None
    stamp = mark.on_bus_at - place.clock.offset_ns + 2_000
    sample = place.place(reading_at(Instant(mark.on_bus_at + 300_000), stamp))
    assert sample is None or not sample.certain
    log.handed(201, Instant(log.marks[-1].handed_at + PERIOD))
    on_bus = Instant(log.marks[-1].handed_at + SYNC_LATENCY)
    log.came(on_bus)
    place.place(reading_at(Instant(on_bus + 240_000), on_bus - place.clock.offset_ns))
    assert place.health.two_stamps == 1


# ---- drives without a clock -----------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("loss", [0.0, 0.02, 0.3])
def test_by_order_nothing_is_misplaced_while_the_drive_answers_before_the_next_sync(loss: float) -> None:
    def lateness(_n: int, r: random.Random) -> int:
        return r.choice([0, 0, 60_000, 480_000])

    outcome = play(Network(uniform(150, 400, loss), lateness=lateness, has_clock=False), 3000)
    assert outcome.misjudged == []
    assert outcome.violations == []
    assert len(outcome.placed) > 2_800 * (1.0 - loss)
    if not loss:
        assert outcome.uncertain == []


@pytest.mark.parametrize("has_clock", [True, False])
def test_every_reading_is_counted_once(has_clock: bool) -> None:
    again = {number: 60_000 for number in range(4, 2000, 4)}
    outcome = play(
        Network(uniform(150, 400, 0.1), duplicate=lambda n, _r: again.get(n), has_clock=has_clock), 2000
    )
    health = (outcome.by_stamp if has_clock else outcome.by_order).health
    assert health.placed == len(outcome.placed)
    if has_clock:
        assert 0.8 * len(again) < health.duplicates + health.unmatched < len(again), (
            "as many as were not lost"
        )
    assert outcome.misjudged == []
    assert health.below_transit == 0


def test_by_order_a_delay_that_grows_by_whole_periods_is_found() -> None:
    """A gateway's 5 ms that begin after calibration: they would look like 0.24 ms and five losses."""
    outcome = play(Network(lambda n, _r: 240_000 if n < 1000 else 5_240_000, has_clock=False), 4000)
    assert outcome.misjudged == []
    assert outcome.violations == []
    assert len(outcome.uncertain) < 50
    assert outcome.told == ["its readings come 5240 us after their SYNC now"]


def test_by_order_delays_that_spread_over_more_than_a_period_are_uncertain_never_wrong() -> None:
    outcome = play(Network(lambda n, r: 240_000 + r.randint(0, 1_500_000), has_clock=False), 2000)
    assert outcome.misjudged == []
    assert len(outcome.uncertain) > 1_900
    assert any("it cannot be told which SYNCs" in text for text in outcome.told)


# ---- the log of SYNCs -----------------------------------------------------------------------------------


def test_a_sync_that_never_came_to_the_bus_makes_the_next_echo_unsure() -> None:
    log = SyncLog(SYNC_LATENCY, PERIOD, EchoBasis.BUS)
    lost = log.handed(1, Instant(0))
    assert not log.may_hand_over(Instant(PERIOD))
    assert log.may_hand_over(Instant(2 * PERIOD))
    later = log.handed(3, Instant(2 * PERIOD))
    log.came(Instant(2 * PERIOD + SYNC_LATENCY))
    assert [lost.on_bus_at, later.on_bus_at] == [None, 2 * PERIOD + SYNC_LATENCY]
    assert not later.sure, "it may have been that of the first"
    next_mark = log.handed(4, Instant(3 * PERIOD))
    log.came(Instant(3 * PERIOD + SYNC_LATENCY))
    assert not later.sure, "a bus that was stopped may have given the first one back just then"
    assert not next_mark.sure, "and the later one now"
    last = log.handed(5, Instant(4 * PERIOD))
    log.came(Instant(4 * PERIOD + SYNC_LATENCY))
    assert last.sure


def test_two_echoes_of_two_syncs_are_told_apart_by_their_order() -> None:
    log = SyncLog(SYNC_LATENCY, PERIOD, EchoBasis.BUS)
    first = log.handed(1, Instant(0))
    second = log.handed(3, Instant(2 * PERIOD))
    log.came(Instant(2 * PERIOD + 10_000))
    log.came(Instant(2 * PERIOD + 60_000))
    assert [first.on_bus_at, second.on_bus_at] == [2 * PERIOD + 10_000, 2 * PERIOD + 60_000]
    assert first.sure
    assert second.sure
    assert log.crowded == 1


def test_an_echo_from_before_a_hand_over_is_of_an_earlier_sync() -> None:
    """A hub that was stopped for two periods gives the first SYNC back after the second was handed over."""
    log = SyncLog(SYNC_LATENCY, PERIOD, EchoBasis.BUS)
    first = log.handed(1, Instant(0))
    second = log.handed(3, Instant(3 * PERIOD))
    log.came(Instant(PERIOD // 2))
    assert (first.on_bus_at, first.sure, second.on_bus_at) == (PERIOD // 2, True, None)
    assert not log.may_hand_over(Instant(4 * PERIOD)), "the second one is still awaited"
    log.came(Instant(3 * PERIOD + SYNC_LATENCY))
    assert (second.on_bus_at, second.sure) == (3 * PERIOD + SYNC_LATENCY, True)


def test_an_echo_of_one_that_is_not_waited_for_any_more_is_taken_for_no_other() -> None:
    log = SyncLog(SYNC_LATENCY, PERIOD, EchoBasis.BUS)
    log.handed(1, Instant(0))
    log.handed(3, Instant(2 * PERIOD))
    log.came(Instant(2 * PERIOD + SYNC_LATENCY))
    last = log.handed(4, Instant(3 * PERIOD))
    log.came(Instant(3 * PERIOD - 1))
    assert (last.on_bus_at, log.surplus) == (None, 1)
    log.came(Instant(3 * PERIOD + SYNC_LATENCY))
    assert (last.on_bus_at, last.sure) == (3 * PERIOD + SYNC_LATENCY, False)


def test_the_instant_of_an_echo_counts_for_as_much_as_its_stamps_are_worth() -> None:
    log = SyncLog(SYNC_LATENCY, PERIOD, EchoBasis.KERNEL)
    log.handed(1, Instant(0))
    second = log.handed(3, Instant(3 * PERIOD))
    log.came(Instant(3 * PERIOD - ECHO_ERROR[EchoBasis.KERNEL]))
    assert (second.on_bus_at, second.sure) == (3 * PERIOD - ECHO_ERROR[EchoBasis.KERNEL], False)


def test_an_echo_that_tells_its_hand_over_is_never_in_doubt() -> None:
    """A bus that stood still: the first SYNC comes after the third was handed over, the second later."""
    log = SyncLog(SYNC_LATENCY, PERIOD, EchoBasis.BUS)
    marks = [log.handed(number, Instant(number * 2 * PERIOD)) for number in range(4)]
    ended = {0: 4 * PERIOD + 1, 2: 4 * PERIOD + 2, 1: 7 * PERIOD}  # the last is lost in front of the bus
    for number, at in ended.items():
        log.came(Instant(at), marks[number].handed_at)
    assert [mark.on_bus_at for mark in marks] == [4 * PERIOD + 1, 7 * PERIOD, 4 * PERIOD + 2, None]
    assert all(mark.sure for mark in marks)
    log.came(Instant(7 * PERIOD + 1), marks[1].handed_at)
    assert log.surplus == 1, "a copy"


def test_syncs_that_never_came_to_the_bus_are_forgotten() -> None:
    log = SyncLog(SYNC_LATENCY, PERIOD, EchoBasis.BUS)
    first = log.handed(1, Instant(0))
    for number in range(1, REMEMBERED + 1):
        log.handed(number, Instant(number * PERIOD))
    log.came(Instant(REMEMBERED * PERIOD + 1), first.handed_at)
    assert (first.on_bus_at, log.surplus) == (None, 1)


def test_an_echo_nobody_asked_for_is_surplus() -> None:
    log = SyncLog(SYNC_LATENCY, PERIOD, EchoBasis.BUS)
    log.handed(1, Instant(0))
    log.came(Instant(50_000))
    log.came(Instant(110_000))
    assert log.surplus == 1
    assert log.nearest(Instant(110_000)) is log.marks[-1]


def test_without_echoes_the_hand_over_stands_for_the_bus() -> None:
    log = SyncLog(SYNC_LATENCY, PERIOD, EchoBasis.NONE)
    mark = log.handed(1, Instant(0))
    assert mark.on_bus_at == Instant(SYNC_LATENCY)
    assert log.may_hand_over(Instant(1))


def test_the_time_for_which_a_bus_stood_still_is_none_for_which_it_was_heard_of() -> None:
    """It brings what lay there behind the first SYNC after that."""
    log = SyncLog(SYNC_LATENCY, PERIOD, EchoBasis.BUS)
    for number, at in enumerate((1, 2, 3, 40, 41, 42), 1):
        log.handed(number, Instant(min(at, 5) * NS_PER_MS + number))
        log.came(Instant(at * NS_PER_MS), Instant(min(at, 5) * NS_PER_MS + number))
        if number == 1:
            begun = log.heard_ns
    assert log.heard_ns - begun == (2 + GIVEN_UP_AFTER_PERIODS + 2) * PERIOD
    assert log.heard_for(6, begun)
    assert not log.heard_for(7, begun)


def test_a_row_is_proved_for_its_own_reading_alone() -> None:
    """It may have been settled with another, by a guess, when it is known which reading is its own."""
    question, reading = Question(), reading_at(Instant(3 * PERIOD))
    guess = Sample(2, reading, Instant(2 * PERIOD), 128 * PERIOD, False)
    question.prove(2, Instant(5 * PERIOD), 8_000)
    assert question.applied(guess, reading.received_at) == guess
    question.prove(2, reading.received_at, 8_000)
    proved = question.applied(guess, reading.received_at)
    assert isinstance(proved, Sample)
    assert (proved.certain, proved.sampled_at_error_ns) == (True, 8_000)


def test_a_row_in_doubt_stays_so_though_another_reading_is_proved_to_be_its_own() -> None:
    question, reading = Question(), reading_at(Instant(3 * PERIOD))
    told = Sample(2, reading, Instant(2 * PERIOD), 8_000, True)
    question.doubt(2, 128 * PERIOD)
    question.prove(2, Instant(5 * PERIOD), 8_000)
    doubted = question.applied(told, reading.received_at)
    assert isinstance(doubted, Sample)
    assert (doubted.certain, doubted.sampled_at_error_ns) == (False, 128 * PERIOD)
