"""Fates of SYNC sequences."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobench.drivers.timebase import NS_PER_MS, Duration, Instant
from servobench.hil.loop.delay import UNHEARD_MAX, DelayMeter
from servobench.hil.loop.samples import Dropout, DropoutCause, Sample
from tests.draws import examples_of
from tests.unit.hil.loop_fakes import reading_at

DEADLINE = Duration(2 * NS_PER_MS)
HEARD = 1 << 62
"""Nothing is on its way any more."""


def sample(sequence: int, delay_us: int, certain: bool = True) -> Sample:
    sampled_at = Instant(sequence * NS_PER_MS)
    received_at = Instant(sampled_at + delay_us * 1000)
    return Sample(sequence, reading_at(received_at), sampled_at, 0, certain)


def sent(meter: DelayMeter, *sequences: int) -> None:
    """Nothing has been heard of the bus so far."""
    for sequence in sequences:
        meter.sync_sent(sequence, Instant(sequence * NS_PER_MS), 0)


def causes(meter: DelayMeter) -> list[DropoutCause | None]:
    fates = meter.settle(HEARD)
    return [fate.observation.cause if isinstance(fate.observation, Dropout) else None for fate in fates]


def test_a_reading_in_time_is_used() -> None:
    meter = DelayMeter(DEADLINE, 5)
    sent(meter, 1)
    assert meter.arrived(sample(1, 300))
    (fate,) = meter.settle(HEARD)
    assert fate.sequence == 1
    assert fate.delay == 300_000
    assert meter.settle(HEARD) == []


def test_a_reading_is_given_up_when_the_bus_has_been_heard_of_for_as_long_as_the_horizon() -> None:
    """A hub that stands still keeps readings that have their stamps already."""
    meter = DelayMeter(DEADLINE, 3)
    for number in range(1, 12):
        meter.sync_sent(number, Instant(number * NS_PER_MS), number * NS_PER_MS)
    assert meter.settle(4 * NS_PER_MS - 1) == []
    meter.arrived(sample(1, 300))
    used, lost = meter.settle(5 * NS_PER_MS)
    assert used.observation.certain
    assert isinstance(lost.observation, Dropout)
    assert (lost.sequence, lost.observation.cause, lost.observation.certain) == (2, DropoutCause.LOST, True)


def test_what_is_given_up_while_nothing_is_heard_is_uncertain() -> None:
    meter = DelayMeter(DEADLINE, 3)
    sent(meter, *range(1, UNHEARD_MAX + 4))
    assert meter.settle(0) == []
    sent(meter, UNHEARD_MAX + 4)
    (lost,) = meter.settle(0)
    assert (lost.sequence, lost.observation.certain) == (1, False)


def test_a_reading_after_the_deadline_is_late_and_of_no_use() -> None:
    meter = DelayMeter(DEADLINE, 5)
    sent(meter, 1)
    assert not meter.arrived(sample(1, 2001))
    assert causes(meter) == [DropoutCause.LATE]


def test_a_reading_overtaken_by_a_newer_one_is_stale() -> None:
    meter = DelayMeter(DEADLINE, 5)
    sent(meter, 1, 2)
    assert meter.arrived(sample(2, 100))
    assert not meter.arrived(sample(1, 1500))
    assert causes(meter) == [DropoutCause.STALE, None]


def test_a_reading_is_certainly_stale_only_if_the_newer_one_was_certain() -> None:
    meter = DelayMeter(DEADLINE, 5)
    sent(meter, 1, 2, 3)
    meter.arrived(sample(3, 100, certain=False))
    assert not meter.arrived(sample(1, 1500))
    meter.arrived(sample(3, 100))
    assert not meter.arrived(sample(2, 1800))
    certain = [fate.observation.certain for fate in meter.settle(HEARD)]
    assert certain == [False, True, True]


def test_a_reading_not_seen_within_the_horizon_is_lost_and_keeps_its_place() -> None:
    meter = DelayMeter(DEADLINE, 3)
    sent(meter, 1, 2)
    meter.arrived(sample(2, 100))
    assert causes(meter) == []
    sent(meter, 3)
    assert causes(meter) == []
    sent(meter, 4)
    assert causes(meter) == [DropoutCause.LOST, None]


def test_a_duplicate_and_one_beyond_the_horizon_are_unmatched() -> None:
    meter = DelayMeter(DEADLINE, 3)
    sent(meter, 1)
    meter.arrived(sample(1, 100))
    assert not meter.arrived(sample(1, 150))
    meter.settle(HEARD)
    assert not meter.arrived(sample(1, 900))
    assert meter.unmatched == 2


def test_what_is_open_at_the_end_is_lost_for_certain_if_a_later_one_came_and_the_bus_was_heard_of() -> None:
    """Seen on a hub: a drive's process stood still for 18 ms as a run ended, and answered all SYNCs then."""
    meter = DelayMeter(DEADLINE, 20)
    for number in (1, 2, 3, 4):
        meter.sync_sent(number, Instant(number * NS_PER_MS), number * NS_PER_MS)
    meter.arrived(sample(2, 100))
    meter.missed(5, Instant(5 * NS_PER_MS))
    fates = meter.settle_all(9 * NS_PER_MS)
    assert [fate.delay for fate in fates] == [None, 100_000, None, None, None]
    assert [fate.observation.certain for fate in fates] == [True, True, False, False, True]


def test_the_typical_delay_is_the_median_not_the_mean() -> None:
    meter = DelayMeter(Duration(100 * NS_PER_MS), 5)
    for number in range(1, 2001):
        sent(meter, number)
        meter.arrived(sample(number, 40_000 if number % 4 == 0 else 500))
        meter.settle(HEARD)
    assert meter.typical_delay == pytest.approx(500_000, rel=0.1)


@examples_of(100)
@given(st.lists(st.one_of(st.none(), st.integers(0, 8000)), min_size=1, max_size=60))
def test_every_sequence_has_exactly_one_fate_in_order(delays_us: list[int | None]) -> None:
    meter = DelayMeter(DEADLINE, 10)
    events = [(number * 1000, 0, number) for number in range(1, len(delays_us) + 1)]
    for number, delay in enumerate(delays_us, 1):
        if delay is not None:
            events.append((number * 1000 + delay, 1, number))
    fates = []
    for _, kind, number in sorted(events):
        if kind == 0:
            sent(meter, number)
        else:
            meter.arrived(sample(number, delays_us[number - 1] or 0))
        fates += meter.settle(HEARD)
    fates += meter.settle_all(HEARD)
    assert [fate.sequence for fate in fates] == list(range(1, len(delays_us) + 1))
    for fate, delay in zip(fates, delays_us, strict=True):
        if delay is None:
            assert fate.observation.cause is DropoutCause.LOST  # type: ignore[union-attr]
        elif delay > 2000:
            assert fate.observation.cause is DropoutCause.LATE  # type: ignore[union-attr]
        else:
            assert fate.delay == delay * 1000


def test_a_cycle_without_sync_has_its_fate_at_once_and_in_order() -> None:
    meter = DelayMeter(DEADLINE, 5)
    sent(meter, 1)
    meter.missed(2, Instant(2 * NS_PER_MS))
    sent(meter, 3)
    assert causes(meter) == []
    meter.arrived(sample(1, 100))
    assert causes(meter) == [None, DropoutCause.MISSED]


def test_a_loss_near_a_reading_of_uncertain_place_is_uncertain_too() -> None:
    meter = DelayMeter(DEADLINE, 3)
    sent(meter, *range(1, 30))
    for number in range(1, 30):
        if number not in (4, 14):
            meter.arrived(sample(number, 100, certain=number != 15))
    assert [meter.doubts(number) for number in (4, 11, 12, 14, 18, 19)] == [
        False,
        False,
        True,
        True,
        True,
        False,
    ]
    meter.forget_doubts()
    assert not meter.doubts(14)


def test_cycles_whose_readings_are_open_after_all_are_in_doubt() -> None:
    meter = DelayMeter(DEADLINE, 3)
    sent(meter, *range(1, 30))
    meter.doubt(10, 20)
    assert [number for number in range(1, 30) if meter.doubts(number)] == list(range(7, 24))


def test_what_was_in_doubt_before_a_question_stays_so_whatever_its_answer() -> None:
    meter = DelayMeter(DEADLINE, 3)
    meter.doubt(10, 12)
    meter.keep_doubts()
    meter.doubt(14, 18)
    assert meter.doubts(20)
    meter.forget_doubts()
    assert [number for number in range(1, 30) if meter.doubts(number)] == list(range(7, 16))


def test_a_certain_reading_takes_the_place_of_an_uncertain_one() -> None:
    meter = DelayMeter(DEADLINE, 5)
    sent(meter, 1, 2)
    assert meter.arrived(sample(1, 100, certain=False))
    assert meter.arrived(sample(1, 300))
    (fate,) = meter.settle(HEARD)
    assert fate.delay == 300_000
    assert fate.observation.certain
