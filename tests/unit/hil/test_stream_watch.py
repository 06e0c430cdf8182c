"""A stream that is regular: what comes between two of its frames is told, and nothing else is."""

from collections.abc import Collection
from random import Random
from typing import Final

import pytest

from servobench.drivers.canopen.pdo import PdoDirection, PdoEntry, PdoMap
from servobench.drivers.timebase import NS_PER_MS, Duration, Instant
from servobench.drivers.wire.frame_port import EchoBasis
from servobench.hil.execution.stream_watch import DelaysKnown, SyncedStream, TimedStream
from servobench.hil.loop.syncs import SyncLog
from tests.ports import kept_rows

PERIOD: Final = NS_PER_MS
DELAY: Final = 300_000
LOOK: Final = 50
FORGED: Final = b"forged"


class Stream:
    """A drive that answers SYNCs, and a bench that looks every 50."""

    def __init__(
        self, every: int = 1, delays: DelaysKnown = DelaysKnown.SHORT, unheard: Collection[int] | None = None
    ) -> None:
        """``unheard``: SYNCs of another node that this host does not hear; None: the SYNCs are its own."""
        self.delays = delays
        self.unheard = unheard
        self.sync_late: dict[int, int] = {}
        """By how much a SYNC comes behind its instant, ns, and the answers with it."""
        self.frames: list[tuple[Instant, bytes]] = []
        self.syncs = SyncLog(Duration(0), Duration(PERIOD), EchoBasis.NONE)
        pdo = PdoMap(PdoDirection.TRANSMIT, 1, 0x181, (PdoEntry(0x606C, 0, "i"),), every)
        period = Duration(PERIOD)
        self.watch = SyncedStream(pdo, self.take_frames, self.syncs, period, lambda: self.delays)

    def take_frames(self, cob_id: int) -> bytes:
        assert cob_id == 0x181
        frames, self.frames = sorted(self.frames), []
        return kept_rows((data, at) for at, data in frames)

    def told(self, arrivals: dict[int, list[int]], syncs: int, at_end: bool = False) -> list[bytes]:
        """What is told of ``syncs``; ``arrivals``: by SYNC, delays of its frames, ns, negative: forged."""
        found: list[bytes] = []
        for number in range(1, syncs + 1):
            at = number * PERIOD + self.sync_late.get(number, 0)
            if self.unheard is None:
                self.syncs.handed(number, Instant(at))
            elif number not in self.unheard:
                self.syncs.heard(number, Instant(at))
            for nth, delay in enumerate(arrivals.get(number, [])):
                data = FORGED if delay < 0 else b"%d %d" % (number, nth)
                self.frames.append((Instant(at + abs(delay)), data))
            if number % LOOK == 0:
                found += self.look(at)
        return found + (self.look(1 << 60, at_end=True) if at_end else [])

    def look(self, at: int, at_end: bool = False) -> list[bytes]:
        later = [frame for frame in self.frames if frame[0] > at]
        self.frames = [frame for frame in self.frames if frame[0] <= at]
        extras, more = self.watch.look(at_end=at_end)
        self.frames += later
        return [extra.data for extra in extras] + more * [b"too many"]


def regular(syncs: int, every: int = 1) -> dict[int, list[int]]:
    return {number: [DELAY] for number in range(every, syncs + 1, every)}


@pytest.mark.parametrize("every", [1, 10])
@pytest.mark.parametrize("late", [-1000, -DELAY + 1000, -999_000])
def test_a_single_frame_too_many_is_told_wherever_it_comes(every: int, late: int) -> None:
    for number in (810, 813, 850, 1499):
        arrivals = regular(1500, every)
        arrivals[number] = [*arrivals.get(number, []), late]
        found = Stream(every).told(arrivals, 1500, at_end=True)
        assert found == [FORGED], (number, late)


def test_what_was_held_back_is_nobodys() -> None:
    """Losses, and frames up to 40 periods late, out of order, drawn 40 times."""
    for seed in range(40):
        draw, stream = Random(seed), Stream()
        rate = draw.choice((0.003, 0.02, 0.2))
        arrivals = {
            number: [DELAY + draw.choice((0, draw.randrange(40 * PERIOD)))]
            if draw.random() < rate
            else [DELAY]
            for number in range(1, 3001)
            if draw.random() > rate
        }
        assert stream.told(arrivals, 3000, at_end=True) == []


@pytest.mark.parametrize("every", [1, 10])
def test_an_answer_to_a_sync_of_another_that_this_host_did_not_hear_is_nobodys(every: int) -> None:
    """Wherever it lies: between two looks, before the last SYNC of one, or two in a row."""
    draw = Random(11)
    drawn = {number for number in range(70, 3000) if draw.random() < 0.03}
    unheard = {*drawn, 1000, 1050, 1051, 3000}
    assert Stream(every, unheard=unheard).told(regular(3000, every), 3000, at_end=True) == []
    for number in (999, 1002, 1501):
        arrivals = regular(3000, every)
        arrivals[number] = [*arrivals.get(number, []), -200_000]
        few = {each for each in unheard if each % 500 < 2}
        found = Stream(every, unheard=few).told(arrivals, 3000, at_end=True)
        assert found == [FORGED], (number, every)


@pytest.mark.long
@pytest.mark.parametrize("every", [1, 10])
@pytest.mark.parametrize("delay", [DELAY // 10, DELAY, 2 * DELAY])
def test_an_answer_to_an_irregular_sync_that_was_not_heard_is_nobodys(every: int, delay: int) -> None:
    """SYNCs up to 0.4 periods late: one that was not heard lay elsewhere than half-way; 40 drawn."""
    for seed in range(40):
        draw = Random(seed)
        stream = Stream(every, unheard={number for number in range(70, 3000) if draw.random() < 0.1})
        stream.sync_late = {number: draw.randrange(400_000) for number in range(1, 3001)}
        arrivals = {number: [delay + draw.randrange(200_000)] for number in range(every, 3001, every)}
        assert stream.told(arrivals, 3000, at_end=True) == [], seed


@pytest.mark.parametrize("spread", [30_000, 300_000])
def test_answers_after_a_period_that_change_sides_of_the_next_sync_are_nobodys(spread: int) -> None:
    """A TPDO behind that of the reading may take longer than a period where readings do not."""
    for seed in range(40):
        draw, stream = Random(seed), Stream()
        late = PERIOD + draw.randrange(spread)
        arrivals = {
            number: [late + draw.randrange(spread) - (spread if draw.random() < 0.02 else 0)]
            for number in range(1, 2001)
        }
        assert stream.told(arrivals, 2000, at_end=True) == [], seed
    for number in (810, 1250, 1499):
        arrivals = {each: [PERIOD + 30_000] for each in range(1, 2001)}
        arrivals[number].append(-DELAY)
        assert Stream().told(arrivals, 2000, at_end=True) == [FORGED], number


def test_a_frame_that_was_in_question_may_be_repeated() -> None:
    """Frame 500 comes behind the repetition of 499, and is repeated behind the next SYNC."""
    stream, arrivals = Stream(), regular(1000)
    arrivals[500] = [DELAY + 100_000]
    stream.frames += [
        (Instant(500 * PERIOD + DELAY), b"499 0"),
        (Instant(501 * PERIOD + DELAY + 200_000), b"500 0"),
    ]
    assert stream.told(arrivals, 1000) == []


@pytest.mark.parametrize("delays", [*DelaysKnown])
def test_repetitions_that_cross_syncs_are_nobodys(delays: DelaysKnown) -> None:
    """One before the answer to the next SYNC, which then is in question and repeated itself, and some answers
    held back for longer than a period, so that a repetition is all that came in it; 40 drawn."""
    held = 0.0 if delays is DelaysKnown.ALL_SHORT else 0.1
    for seed in range(40):
        draw, stream = Random(seed), Stream(delays=delays)
        syncs, rate = draw.randrange(400, 1000), draw.choice((0.02, 0.15, 0.5))
        later = draw.choice((376_000, 900_000, 2_500_000))
        arrivals = {number: [DELAY + draw.randrange(690_000)] for number in range(1, syncs + 1)}
        for number, delays_ns in arrivals.items():
            if draw.random() < held:
                delays_ns[0] += draw.randrange(PERIOD)
            if draw.random() < rate:
                at = number * PERIOD + delays_ns[0] + later
                stream.frames.append((Instant(at), b"%d 0" % number))
        assert stream.told(arrivals, syncs, at_end=True) == [], seed


def test_a_frame_behind_the_last_of_a_drive_that_says_the_same_each_time_is_told() -> None:
    stream = Stream()
    stream.frames = [(Instant(number * PERIOD + DELAY), b"at rest") for number in range(1, 501)]
    stream.frames.append((Instant(500 * PERIOD + DELAY + 200_000), FORGED))
    assert stream.told({}, 500, at_end=True) == [FORGED]


def test_a_delay_that_was_longer_than_a_period_and_then_is_not_is_nobodys() -> None:
    arrivals = {number: [DELAY + (number < 1010) * PERIOD] for number in range(1, 2001)}
    assert Stream(delays=DelaysKnown.UNKNOWN).told(arrivals, 2000) == []


@pytest.mark.parametrize("less", [1_020_000, 1_081_000, 1_250_000])
def test_an_answer_that_took_a_little_more_than_a_period_and_then_less_is_nobodys(less: int) -> None:
    """A read-back behind readings that take less than a period: its last late one and its first in time
    answer two SYNCs within the time of one."""
    arrivals = {number: [less if number <= 120 else DELAY] for number in range(1, 301)}
    assert Stream().told(arrivals, 300, at_end=True) == []


def test_at_the_end_nothing_is_told_while_it_is_in_question_how_long_readings_take() -> None:
    """The last three come behind the last SYNC, as the delay has been three periods longer than was known."""
    stream = Stream()
    arrivals = {number: [DELAY + (number > 64) * 3 * PERIOD] for number in range(1, 501)}
    assert stream.told(arrivals, 500) == []
    stream.delays = DelaysKnown.UNKNOWN
    assert stream.look(1 << 60, at_end=True) == []


def test_nobody_need_look_before_more_syncs_have_come_than_are_remembered() -> None:
    """As while drives are stopped, with SYNCs that somebody else makes."""
    stream = Stream()
    assert stream.told(regular(100), 100) == []
    for number in range(101, 801):
        stream.syncs.handed(number, Instant(number * PERIOD))
        stream.frames.append((Instant(number * PERIOD + DELAY), b"%d" % number))
    assert stream.look(1 << 60, at_end=True) == []


@pytest.mark.parametrize("later", [0, 100_000, 900_000, 2_500_000])
def test_a_repetition_is_no_news(later: int) -> None:
    stream = Stream()
    arrivals = regular(1000)
    for number in range(500, 900, 70):
        at = Instant(number * PERIOD + DELAY + later)
        stream.frames.append((at, b"%d 0" % number))
    assert stream.told(arrivals, 1000) == []


def test_where_all_delays_are_short_losses_hide_nothing() -> None:
    draw, found = Random(7), 0
    for number in range(2300, 2330):
        arrivals = {each: [DELAY] for each in range(1, 2501) if draw.random() > 0.05}
        arrivals[number] = [*arrivals.get(number, []), -draw.randrange(PERIOD)]
        found += Stream(delays=DelaysKnown.ALL_SHORT).told(arrivals, 2500) == [FORGED]
    assert found >= 22, "all but those behind a loss"


@pytest.mark.parametrize("lost", [1, 2, 5])
def test_a_frame_before_a_loss_is_told_where_all_delays_are_short(lost: int) -> None:
    """Later than half a period after the answer it may be that to the next SYNC, which came too soon."""
    for late, told in ((10_000, [FORGED]), (DELAY + 200_000, [FORGED]), (PERIOD - 50_000, [])):
        arrivals = regular(2500)
        for number in range(2301, 2301 + lost):
            del arrivals[number]
        arrivals[2300].append(-late)
        assert Stream(delays=DelaysKnown.ALL_SHORT).told(arrivals, 2500) == told, late
        assert Stream(delays=DelaysKnown.SHORT).told(arrivals, 2500) == [], "the missing one may come yet"


@pytest.mark.parametrize("off_ms", [1, 12, 24])
def test_a_frame_between_two_of_a_timer_is_told_and_one_that_begins_it_anew_is_not(off_ms: int) -> None:
    period = Duration(25 * NS_PER_MS)

    def told(*frames: tuple[int, bytes]) -> list[bytes]:
        stream = TimedStream(period, repeats=False)
        return [extra.data for at, data in frames for extra in stream.take(data, Instant(at * NS_PER_MS))]

    before = [(at, b"state") for at in range(0, 200, 25)]
    after = [(at, b"state") for at in range(200, 400, 25)]
    assert told(*before, (175 + off_ms, FORGED), *after) == [FORGED]
    changed = 175 + off_ms
    assert told(*before, *[(at, b"changed") for at in range(changed, 400, 25)]) == []
    assert told(*before, (changed, b"state"), *after) == [], "the same again"
