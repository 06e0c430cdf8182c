"""Readings with a stamp, one by one: on which SYNC each is placed, how well, and when it puts a question."""

import random

import pytest

from servobench.drivers.exchange import Reading
from servobench.drivers.timebase import Instant
from servobench.drivers.wire.frame_port import EchoBasis
from servobench.hil.loop.answered_syncs import STAMPS_MAX
from servobench.hil.loop.drive_stamps import MATCH_NS
from servobench.hil.loop.residuals import WATCHED
from servobench.hil.loop.samples import Sample
from servobench.hil.loop.stamp_attribution import StampAttribution
from servobench.hil.loop.syncs import ECHO_ERROR, REMEMBERED, STAMPED_LATE, SURPLUS, SyncLog
from tests.unit.hil.loop_fakes import PERIOD, SYNC_LATENCY, TRANSIT, reading_at

DELAY = 250_000
OFFSET = 987_654_000
"""Of the drive's clock."""
TAUGHT = 16
"""SYNCs before the first that is placed."""
FIRST = TAUGHT + 1


class Rig:
    """SYNC n of another node ends at n periods, the first ones later by up to 80 us where that shows that no
    stamp waits for a tick of the drive; they have taught the clock."""

    def __init__(self, echoes: EchoBasis = EchoBasis.BUS, taught: int = TAUGHT) -> None:
        self.told: list[str] = []
        self.log = SyncLog(SYNC_LATENCY, PERIOD, echoes)
        self.stamped = StampAttribution(self.log, PERIOD, TRANSIT, self.told.append)
        for number in range(1, taught + 1):
            self.sync(number)
            self.stamped.learn(self.reading(number), self.log.marks[-1])

    def sync(self, number: int, sequence: int | None = None) -> None:
        self.log.heard(number if sequence is None else sequence, self.end_of(number))

    def end_of(self, number: int) -> Instant:
        uneven = number <= TAUGHT and self.log.echoes not in STAMPED_LATE
        return Instant(number * PERIOD + (number % 5 * 20_000 if uneven else 0))

    def reading(self, number: int, late: int = 0, delay: int = DELAY) -> Reading:
        """Of SYNC ``number``, which was so late to the drive; received after ``delay`` from that SYNC on."""
        at = self.end_of(number)
        return reading_at(Instant(at + delay), at + late + OFFSET)

    def place(self, number: int, late: int = 0, delay: int = DELAY) -> Sample | None:
        return self.stamped.place(self.reading(number, late, delay))

    @property
    def match_ns(self) -> int:
        """How far a stamp may lie off its SYNC now."""
        return MATCH_NS + ECHO_ERROR[self.log.echoes] + self.stamped.clock.error_ns


def counts(rig: Rig) -> tuple[int, int, int, int, int]:
    health = rig.stamped.health
    return health.placed, health.unmatched, health.duplicates, health.below_transit, health.before_sync


@pytest.mark.parametrize("echoes", [EchoBasis.BUS, EchoBasis.HARDWARE, EchoBasis.RECEIPT])
def test_a_stamp_on_a_sync_is_that_sync_s(echoes: EchoBasis) -> None:
    rig = Rig(echoes)
    rig.sync(FIRST)
    match_ns = rig.match_ns
    sample = rig.place(FIRST)
    assert sample == Sample(FIRST, rig.reading(FIRST), Instant(FIRST * PERIOD), 2 * match_ns, True)
    assert counts(rig) == (1, 0, 0, 0, 0)
    assert rig.stamped.health.error_ns_max == 2 * match_ns
    assert (rig.stamped.question.open, rig.told) == (False, [])


@pytest.mark.parametrize(("off", "certain"), [(0, True), (1, False)])
@pytest.mark.parametrize("sign", [-1, 1])
def test_a_stamp_lies_on_a_sync_within_what_both_may_err(sign: int, off: int, certain: bool) -> None:
    rig = Rig()
    rig.sync(FIRST)
    # the line has a fraction of a nanosecond; what it places says where a stamp lies
    late = sign * (rig.match_ns + off)
    late -= rig.stamped.clock.place(FIRST * PERIOD + late + OFFSET) - (FIRST * PERIOD + late)
    sample = rig.place(FIRST, late)
    assert sample is not None
    assert (sample.sequence, sample.sampled_at, sample.certain) == (FIRST, FIRST * PERIOD, certain)
    assert rig.stamped.question.open is not certain
    assert rig.stamped.health.error_ns_max == (sample.sampled_at_error_ns if certain else 0)
    if not certain:
        assert sample.sampled_at_error_ns == REMEMBERED * PERIOD, "any SYNC that is remembered"


def test_a_stamp_that_comes_again_is_the_same_reading() -> None:
    rig = Rig()
    rig.sync(FIRST)
    assert rig.place(FIRST) is not None
    assert rig.place(FIRST, delay=3 * PERIOD) is None
    assert counts(rig) == (1, 0, 1, 0, 0)
    assert not rig.stamped.question.open


def test_what_cannot_be_placed_is_counted() -> None:
    fresh = Rig(taught=0)
    fresh.sync(1)
    assert fresh.place(1) is None, "nothing is known of the clock"
    rig = Rig()
    assert rig.stamped.place(reading_at(Instant(FIRST * PERIOD))) is None, "it has no stamp"
    empty = Rig()
    empty.log.marks.clear()
    assert empty.place(FIRST) is None, "no SYNC is remembered"
    assert [counts(each) for each in (fresh, rig, empty)] == [(0, 1, 0, 0, 0)] * 3


def test_a_reading_of_a_sync_of_no_cycle_is_known_and_not_used() -> None:
    rig = Rig()
    rig.sync(FIRST, SURPLUS)
    assert rig.place(FIRST) is None
    assert rig.place(FIRST) is None
    assert counts(rig) == (0, 1, 1, 0, 0)


@pytest.mark.parametrize(
    ("delay", "below", "before"),
    [("transit", 0, 0), ("sooner", 1, 0), ("at the sync", 1, 0), ("before it", 1, 1)],
)
def test_a_reading_sooner_than_its_frame_takes_is_an_alarm(delay: str, below: int, before: int) -> None:
    rig = Rig()
    rig.sync(FIRST)
    least = TRANSIT - 2 * rig.match_ns
    sooner = {"transit": least, "sooner": least - 1, "at the sync": 0, "before it": -1}[delay]
    assert rig.place(FIRST, delay=sooner) is not None
    assert counts(rig) == (1, 0, 0, below, before)


@pytest.mark.parametrize(
    ("change", "usual"),
    [(PERIOD // 2, True), (PERIOD // 2 + 1, False), (-PERIOD // 2, True), (-PERIOD // 2 - 1, False)],
)
def test_a_delay_that_changes_by_more_than_half_a_period_puts_a_question(change: int, usual: bool) -> None:
    rig = Rig()
    rig.sync(FIRST)
    sample = rig.place(FIRST, delay=DELAY + change)
    assert rig.stamped.question.open is not usual
    assert (sample is not None and sample.certain) is usual
    if not usual:
        rig.sync(FIRST + 1)
        assert rig.place(FIRST + 1) is not None
        assert rig.stamped.question.open is (change < 0), "the next answers it, but for what cannot be"


# ---- SYNCs that are late to the drive --------------------------------------------------------------------


def late_to_the_drive(rig: Rig, most: int, count: int = 2 * WATCHED) -> list[tuple[Sample, int]]:
    """Each of ``count`` SYNCs is up to ``most`` late to the drive: its sample, and when it was taken."""
    draw = random.Random(1)
    samples = []
    for number in range(FIRST, FIRST + count):
        late = draw.randint(0, most)
        rig.sync(number)
        sample = rig.place(number, late)
        assert sample is not None
        samples.append((sample, number * PERIOD + late))
    return samples


@pytest.mark.parametrize("echoes", [EchoBasis.BUS, EchoBasis.KERNEL, EchoBasis.NONE])
@pytest.mark.parametrize("most", [10_000, 50_000, 150_000])
def test_syncs_that_are_late_to_the_drive_are_told_apart_within_their_bounds(
    echoes: EchoBasis, most: int
) -> None:
    """How late they may be is measured."""
    settled = late_to_the_drive(Rig(echoes), most)[WATCHED:]
    assert sum(not sample.certain for sample, _ in settled) <= 0.01 * len(settled)
    certain = [(sample, at) for sample, at in settled if sample.certain]
    assert all(abs(sample.sampled_at - at) <= sample.sampled_at_error_ns for sample, at in certain)
    assert max(sample.sampled_at_error_ns for sample, _ in certain) <= 2 * most + 100_000


def test_no_sync_is_late_by_more_than_a_quarter_of_a_period() -> None:
    rig = Rig()
    late_to_the_drive(rig, PERIOD // 4)
    number = FIRST + 2 * WATCHED
    rig.sync(number)
    off = PERIOD // 4 + 1 - (rig.stamped.clock.place(number * PERIOD + OFFSET) - number * PERIOD)
    assert (sample := rig.place(number, off)) is not None
    assert not sample.certain


@pytest.mark.parametrize(("late", "certain"), [(0, True), (150_000, False), (160_000, False)])
def test_a_stamp_that_lies_on_two_syncs_is_uncertain(late: int, certain: bool) -> None:
    """SYNCs that waited in front of a bus end closer together than they are late to the drive."""
    rig = Rig()
    late_to_the_drive(rig, 200_000)
    first = FIRST + 2 * WATCHED
    rig.sync(first)
    rig.log.heard(first + 1, Instant(first * PERIOD + 140_000))
    sample = rig.place(first, late)
    assert sample is not None
    assert (sample.sequence, sample.certain) == (first, certain)
    assert (sample.sampled_at_error_ns == REMEMBERED * PERIOD) is not certain
    assert not rig.stamped.question.open


def test_no_reading_is_later_than_its_frame() -> None:
    """A lateness that the map shows and that cannot have been is the map's error."""
    rig = Rig()
    late_to_the_drive(rig, 200_000)
    number = FIRST + 2 * WATCHED
    rig.sync(number)
    sample = rig.place(number, late=180_000, delay=170_000)
    assert sample is not None
    assert sample.certain
    assert sample.sampled_at == number * PERIOD + 170_000 - TRANSIT
    assert sample.sampled_at_error_ns >= 180_000 - 170_000 + TRANSIT


def test_syncs_that_are_always_late_are_not_late_the_clock_is_behind() -> None:
    """The smallest lateness of all is the offset that it lacks, and no reading is in doubt for it. What a
    stamp might hide that lay in two heaps once is held by what its delay leaves open."""
    rig = Rig()
    late_to_the_drive(rig, 60_000)
    for number in range(FIRST + 2 * WATCHED, FIRST + 4 * WATCHED):
        rig.sync(number)
        sample = rig.place(number, 40_000 + number % 3)
        assert sample is not None
        assert sample.certain
        error_ns = sample.sampled_at_error_ns
    assert error_ns < 16_000


@pytest.mark.parametrize(("beyond", "kept"), [(0, STAMPS_MAX), (1, REMEMBERED)])
def test_stamps_of_syncs_that_are_forgotten_are_dropped(beyond: int, kept: int) -> None:
    rig = Rig()
    last = STAMPS_MAX + beyond
    for number in range(FIRST, last + 1):
        rig.sync(number)
        rig.place(number)
    stamps = rig.stamped._case.stamps
    assert sorted(stamps) == list(range(last - kept + 1, last + 1))
    assert stamps[last] == last * PERIOD + OFFSET


@pytest.mark.parametrize(("since", "certain"), [(1, False), (100, True)])
def test_where_a_sync_may_be_late_by_more_than_half_a_period_readings_are_in_doubt_and_no_alarm(
    since: int, certain: bool
) -> None:
    """One that reached the drive 0.4 of a period early has shown it; ``since``: readings that have not."""
    rig = Rig()
    rig.sync(FIRST)
    assert rig.place(FIRST, round(-0.4 * PERIOD)) is not None
    for number in range(FIRST + 1, FIRST + 1 + since):
        rig.sync(number)
        sample = rig.place(number)
    assert sample is not None
    assert (sample.sequence, sample.certain) == (FIRST + since, certain)
    assert not rig.stamped.question.open
    assert rig.stamped.health.stamp_error_ns_max <= PERIOD // 2
