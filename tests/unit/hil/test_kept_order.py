"""Readings without a stamp whose delays spread over more than a period, in order and not."""

from random import Random

import pytest

from servobench.drivers.exchange import Reading
from servobench.drivers.timebase import Duration, Instant
from servobench.drivers.wire.frame_port import EchoBasis
from servobench.hil.loop.beats import Beats
from servobench.hil.loop.order_attribution import OrderAttribution
from servobench.hil.loop.samples import Sample
from servobench.hil.loop.syncs import SyncLog
from tests.unit.hil.loop_fakes import PERIOD, SYNC_LATENCY, TRANSIT, reading_at

SYNCS = 600
MOST = PERIOD * 3 // 2
LEARNED = 200
"""SYNCs until the order has shown, and the longest delay."""


def come(
    seed: int,
    in_order: bool,
    lost: float,
    surplus: float = 0.0,
    held: int = 0,
    grown: int = 0,
    most: int = MOST,
) -> list[tuple[int, int, int]]:
    """Return of each reading when it comes, when the position of its SYNC did, and the number of that.

    ``held``: by so much each delay is longer than its frame takes, and nothing is lost until the order has
    shown; ``grown``: from the middle on by so much more. ``most``: so far delays spread."""
    draw = Random(seed)
    frames: list[tuple[int, bool, int]] = []
    released = 0
    for number in range(2, SYNCS):
        is_lost = draw.random() < lost and not (held and number < LEARNED)
        queued = held + (grown if number > SYNCS // 2 else 0)
        for is_speed in (False, True):
            at = (
                number * PERIOD
                + queued
                + TRANSIT * (1 + is_speed)
                + draw.randrange(most if is_speed or not in_order else 1)
            )
            if in_order:
                at = released = max(at, released)
            if not is_lost:
                frames.append((at, is_speed, number))
                if is_speed and draw.random() < surplus:
                    frames.append((at + TRANSIT, True, number))
    frames.sort(key=lambda frame: (frame[0], frame[2], frame[1]))
    readings, position_at = [], 0
    for at, is_speed, number in frames:
        if is_speed:
            readings.append((at, position_at, number))
        else:
            position_at = at
    return readings


def placed(readings: list[tuple[int, int, int]]) -> list[tuple[int, int, bool]]:
    """Of each reading, the number of its SYNC, that of the one it was placed at, and whether for certain."""
    log = SyncLog(SYNC_LATENCY, PERIOD, EchoBasis.HARDWARE)
    order = OrderAttribution(log, PERIOD, TRANSIT, lambda text: None, Beats(PERIOD, Duration(0)))
    log.heard(1, Instant(PERIOD))
    order.learn(reading_at(Instant(PERIOD + 2 * TRANSIT)), log.marks[0])
    waiting: list[tuple[int, Sample]] = []
    found = []
    for count, (at, position_at, number) in enumerate(readings):
        while (log.counted + 1) * PERIOD < at:
            log.heard(log.counted + 1, Instant((log.counted + 1) * PERIOD))
        told = Instant(position_at)
        reading = Reading(float(count), None, Instant(at), 0.0, told, 0.0, told, 0, told)
        sample = order.place(reading)
        if sample is not None:
            waiting.append((number, sample))
        while waiting and (len(waiting) > 60 or count == len(readings) - 1):
            own, first = waiting.pop(0)
            after_all = order.question.applied(first, first.reading.received_at)
            found.append((own, after_all.sequence, after_all.certain))
    return found


@pytest.mark.parametrize(("lost", "least"), [(0.0, 0.95), (0.02, 0.75)])
def test_readings_that_keep_their_order_are_known_though_their_delays_spread_over_a_period(
    lost: float, least: float
) -> None:
    rows = placed(come(1, in_order=True, lost=lost))
    assert all(own == told for own, told, certain in rows if certain)
    later = [certain for own, _, certain in rows if own > LEARNED]
    assert sum(later) > least * len(later)


@pytest.mark.parametrize(("seed", "lost", "least"), [(4, 0.0, 0.95), (5, 0.02, 0.6)])
def test_so_they_are_where_delays_spread_over_almost_a_period_and_none_is_usual(
    seed: int, lost: float, least: float
) -> None:
    """They reach from 0.4 to 1.3 periods, and a calibration's were none of them."""
    rows = placed(come(seed, in_order=True, lost=lost, held=PERIOD * 2 // 5, most=PERIOD * 9 // 10))
    assert all(own == told for own, told, certain in rows if certain)
    later = [certain for own, _, certain in rows if own > LEARNED]
    assert sum(later) > least * len(later)


@pytest.mark.parametrize("lost", [0.0, 0.02])
def test_readings_that_overtake_each_other_are_not_taken_for_such(lost: float) -> None:
    rows = placed(come(2, in_order=False, lost=lost))
    assert not any(certain and own != told for own, told, certain in rows)


def test_a_reading_that_another_frame_of_its_syncs_has_overtaken_counts_for_none() -> None:
    """A SYNC that comes twice to the drive is answered twice."""
    rows = placed(come(3, in_order=True, lost=0.0, surplus=0.02))
    assert not any(certain and own != told for own, told, certain in rows)


@pytest.mark.parametrize(("held", "grown"), [(20, 70), (20, 85), (40, 75), (67, 75), (67, 90), (67, 100)])
def test_a_delay_that_grows_by_nearly_a_period_is_no_loss(held: int, grown: int) -> None:
    """In percent of a period. No reading comes before its SYNC for that, but one does sooner than all before;
    and where even the shortest is held long, what looks like a loss shows none."""
    held, grown = PERIOD * held // 100, PERIOD * grown // 100
    for seed in (4, 5, 7):
        rows = placed(come(seed, in_order=True, lost=0.02, held=held, grown=grown))
        assert not any(certain and own != told for own, told, certain in rows)
        assert any(certain for _, _, certain in rows)
