"""What a log of SYNCs remembers of each, and which of them an instant belongs to."""

from collections.abc import Sequence
from itertools import accumulate

import pytest

from servobench.drivers.timebase import NS_PER_US, Duration, Instant
from servobench.drivers.wire.frame_port import EchoBasis
from servobench.hil.loop.syncs import REMEMBERED, SURPLUS, SyncLog, SyncMark
from tests.unit.hil.loop_fakes import PERIOD, SYNC_LATENCY

HARDWARE_ERROR = NS_PER_US
"""How far the stamp of an adapter's clock may lie from the end of its frame."""


def log_on(echoes: EchoBasis = EchoBasis.BUS) -> SyncLog:
    return SyncLog(SYNC_LATENCY, PERIOD, echoes)


def heard_at(instants: Sequence[int]) -> SyncLog:
    """A log that heard the SYNCs 1, 2, ... end at these instants."""
    log = log_on()
    for sequence, at in enumerate(instants, start=1):
        log.heard(sequence, Instant(at))
    return log


def fields(mark: SyncMark) -> tuple[int, int, int, int | None, bool]:
    return mark.number, mark.sequence, mark.handed_at, mark.on_bus_at, mark.sure


def number_of(mark: SyncMark | None) -> int | None:
    return None if mark is None else mark.number


def test_a_new_log_knows_of_nothing() -> None:
    log = log_on()
    assert (log.marks, log.surplus, log.crowded, log.counted, log.heard_ns) == ([], 0, 0, 0, 0)
    assert log.nearest(Instant(0)) is log.newest_before(Instant(0)) is log.last_of(1) is None
    assert log.may_hand_over(Instant(0))


def test_syncs_are_counted_from_one_whoever_sent_them() -> None:
    log = log_on()
    log.handed(7, Instant(1_000))
    log.came(Instant(51_000))
    log.heard(8, Instant(PERIOD))
    assert log.heard(9, Instant(3 * PERIOD // 2)) is log.marks[2]
    log.stray(Instant(2 * PERIOD))
    assert [fields(mark) for mark in log.marks] == [
        (1, 7, 1_000, 51_000, True),
        (2, 8, PERIOD, PERIOD, True),
        (3, 9, 3 * PERIOD // 2, 3 * PERIOD // 2, True),
        (4, SURPLUS, 2 * PERIOD, 2 * PERIOD, True),
    ]
    assert (log.counted, log.surplus, log.last_on_bus) == (4, 1, 2 * PERIOD)


@pytest.mark.parametrize(("count", "first"), [(REMEMBERED - 1, 1), (REMEMBERED, 1), (REMEMBERED + 1, 2)])
def test_the_oldest_sync_is_forgotten_for_a_new_one(count: int, first: int) -> None:
    log = heard_at(range(PERIOD, (count + 1) * PERIOD, PERIOD))
    assert [mark.number for mark in log.marks] == list(range(first, count + 1))
    assert log.counted == count


def test_without_echoes_a_sync_is_on_the_bus_a_frame_s_time_after_its_hand_over() -> None:
    log = log_on(EchoBasis.NONE)
    mark = log.handed(3, Instant(1_000))
    assert fields(mark) == (1, 3, 1_000, 1_000 + SYNC_LATENCY, True)
    assert log.may_hand_over(Instant(1_000)), "none is waited for"
    assert log.last_on_bus == 1_000 + SYNC_LATENCY


# ---- echoes that tell no frame --------------------------------------------------------------------------


def test_an_echo_may_seem_to_be_from_before_its_hand_over_by_as_much_as_its_stamp_errs() -> None:
    for early, placed in [(HARDWARE_ERROR, True), (HARDWARE_ERROR + 1, False)]:
        log = log_on(EchoBasis.HARDWARE)
        mark = log.handed(1, Instant(10_000))
        log.came(Instant(10_000 - early))
        assert (mark.on_bus_at is not None, log.surplus) == (placed, 0 if placed else 1)


def test_of_three_syncs_and_two_echoes_the_newer_ones_are_the_likelier() -> None:
    log = log_on(EchoBasis.HARDWARE)
    marks = [log.handed(number, Instant(number * PERIOD)) for number in (1, 2, 3)]
    echoes = [Instant(3 * PERIOD + 10_000 + each) for each in (0, PERIOD)]
    log.came(echoes[0])
    assert [(mark.on_bus_at, mark.sure) for mark in marks] == [
        (None, False),
        (None, False),
        (echoes[0], False),
    ]
    log.came(echoes[1])
    assert [(mark.on_bus_at, mark.sure) for mark in marks] == [
        (None, False),
        (echoes[0], False),
        (echoes[1], False),
    ]
    assert log.surplus == 0


def test_as_many_echoes_as_syncs_end_all_doubt_and_one_more_is_surplus() -> None:
    log = log_on(EchoBasis.HARDWARE)
    marks = [log.handed(number, Instant(number * PERIOD)) for number in (1, 2)]
    echoes = [Instant(2 * PERIOD + each) for each in (10_000, 700_000, 800_000)]
    for echo in echoes:
        log.came(echo)
    assert [(mark.on_bus_at, mark.sure) for mark in marks] == [(echoes[0], True), (echoes[1], True)]
    assert (log.surplus, log.crowded, log.last_on_bus) == (1, 1, echoes[2])
    following = log.handed(3, Instant(3 * PERIOD))
    log.came(Instant(3 * PERIOD + 10_000))
    assert (following.on_bus_at, following.sure) == (3 * PERIOD + 10_000, True)


def test_a_sync_that_is_handed_over_after_an_echo_of_two_is_not_its() -> None:
    log = log_on(EchoBasis.HARDWARE)
    for number in (1, 2, 3):
        log.handed(number, Instant(number * PERIOD))
    log.came(Instant(2 * PERIOD + 10_000))
    assert [(mark.on_bus_at, mark.sure) for mark in log.marks] == [
        (None, False),
        (2 * PERIOD + 10_000, False),
        (None, True),
    ]


def test_after_a_doubt_the_next_sync_is_unsure_and_the_one_after_it_is_not() -> None:
    log = log_on(EchoBasis.HARDWARE)
    log.handed(1, Instant(PERIOD))
    log.handed(2, Instant(2 * PERIOD))
    log.came(Instant(2 * PERIOD + 10_000))
    sure = []
    for number in (3, 4):
        mark = log.handed(number, Instant(number * PERIOD))
        log.came(Instant(number * PERIOD + 10_000))
        assert mark.on_bus_at == number * PERIOD + 10_000
        sure.append(mark.sure)
    assert sure == [False, True]


def test_an_echo_that_tells_its_hand_over_finds_its_sync_among_several() -> None:
    log = log_on()
    marks = [log.handed(number, Instant(number * PERIOD)) for number in (1, 2, 3)]
    log.came(Instant(3 * PERIOD + 5), Instant(2 * PERIOD))
    log.came(Instant(3 * PERIOD + 600_000), Instant(2 * PERIOD))
    assert [mark.on_bus_at for mark in marks] == [None, 3 * PERIOD + 5, None]
    assert log.surplus == 1, "that one had its echo"


@pytest.mark.parametrize(("passed", "may"), [(0, False), (2 * PERIOD - 1, False), (2 * PERIOD, True)])
def test_an_echo_is_waited_for_two_periods_from_the_last_hand_over(passed: int, may: bool) -> None:
    log = log_on(EchoBasis.HARDWARE)
    log.handed(1, Instant(0))
    log.handed(2, Instant(PERIOD // 2))
    log.handed(3, Instant(PERIOD))
    assert log.may_hand_over(Instant(PERIOD + passed)) is may
    log.came(Instant(PERIOD + 10_000))
    assert log.may_hand_over(Instant(PERIOD + 10_000)), "one of the three has come"


@pytest.mark.parametrize("beyond", [0, 1])
def test_of_syncs_without_an_echo_the_oldest_is_awaited_no_longer(beyond: int) -> None:
    log = log_on()
    count = REMEMBERED + beyond
    marks = [log.handed(number, Instant(number * PERIOD)) for number in range(1, count + 1)]
    for mark in marks:
        log.came(Instant(mark.handed_at + count * PERIOD), mark.handed_at)
    assert log.surplus == beyond
    assert [mark.number for mark in marks if mark.on_bus_at is not None] == list(range(1 + beyond, count + 1))


# ---- how SYNCs follow each other ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("spacing", "crowded"), [(0, 1), (PERIOD // 2 - 1, 1), (PERIOD // 2, 0), (PERIOD, 0)]
)
def test_a_sync_less_than_half_a_period_after_another_is_crowded(spacing: int, crowded: int) -> None:
    assert heard_at([PERIOD, PERIOD + spacing]).crowded == crowded


@pytest.mark.parametrize(
    ("spacings", "heard_ns"),
    [
        ([], 2 * PERIOD),
        ([PERIOD], 3 * PERIOD),
        ([2 * PERIOD], 4 * PERIOD),
        ([2 * PERIOD + 1], 4 * PERIOD),
        ([100 * PERIOD, 5], 4 * PERIOD + 5),
        ([-5], 2 * PERIOD),
    ],
)
def test_a_bus_is_heard_of_for_two_periods_at_most_before_a_sync(spacings: list[int], heard_ns: int) -> None:
    log = heard_at(list(accumulate(spacings, initial=10 * PERIOD)))
    assert log.heard_ns == heard_ns
    assert log.heard_for(2, heard_ns - 2 * PERIOD)
    assert not log.heard_for(2, heard_ns - 2 * PERIOD + 1)


# ---- which SYNC it was ----------------------------------------------------------------------------------


def test_the_last_sync_of_a_cycle_is_found() -> None:
    log = log_on()
    for at, sequence in enumerate([4, 4, 5, 6]):
        log.heard(sequence, Instant(at * PERIOD))
    assert [number_of(log.last_of(sequence)) for sequence in (3, 4, 5, 6, 7)] == [None, 2, 3, 4, None]


@pytest.mark.parametrize(
    ("at", "nearest", "before"),
    [
        (0, 1, None),
        (PERIOD - 1, 1, None),
        (PERIOD, 1, 1),
        (PERIOD * 3 // 2 - 1, 1, 1),
        (PERIOD * 3 // 2, 1, 1),
        (PERIOD * 3 // 2 + 1, 2, 1),
        (2 * PERIOD - 1, 2, 1),
        (2 * PERIOD, 2, 2),
        (9 * PERIOD, 3, 3),
    ],
)
def test_a_sync_is_near_an_instant_or_before_it(at: int, nearest: int, before: int | None) -> None:
    """Between two of them, the older one."""
    log = heard_at([PERIOD, 2 * PERIOD, 3 * PERIOD])
    assert number_of(log.nearest(Instant(at))) == nearest
    assert number_of(log.newest_before(Instant(at))) == before


def test_a_sync_whose_end_is_not_known_is_near_nothing() -> None:
    log = log_on()
    log.handed(1, Instant(PERIOD))
    log.handed(2, Instant(2 * PERIOD))
    assert log.nearest(Instant(PERIOD)) is log.newest_before(Instant(9 * PERIOD)) is None
    log.came(Instant(PERIOD + 5), Instant(PERIOD))
    for at in (PERIOD + 5, 2 * PERIOD):
        assert number_of(log.nearest(Instant(at))) == number_of(log.newest_before(Instant(at))) == 1


def test_the_time_of_a_frame_is_kept_to_the_nanosecond() -> None:
    log = SyncLog(Duration(1), Duration(3), EchoBasis.NONE)
    log.handed(1, Instant(0))
    log.handed(2, Instant(1))
    assert (log.last_on_bus, log.crowded) == (2, 0), "half of three is one"


@pytest.mark.parametrize(("next_at", "lacks"), [(2.3, False), (2.4, False), (3.0, True)])
def test_a_stamp_between_two_syncs_is_of_a_third_only_if_that_is_missing(next_at: float, lacks: bool) -> None:
    """Neighbours of another node lie further apart than a period where they jitter; none was between them."""
    log = heard_at([0, PERIOD, round(next_at * PERIOD)])
    for between in (1.0 + (next_at - 1.0) / 2 - 0.01, 1.0 + (next_at - 1.0) / 2 + 0.01):
        at = Instant(round(between * PERIOD))
        mark = log.nearest(at)
        assert mark is not None
        assert log.may_lack(mark, at) is lacks
