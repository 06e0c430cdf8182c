"""A loop's own SYNCs: how many it learns by, which ticks go without, and what comes too late."""

from itertools import pairwise

import pytest

from servobench.drivers.errors import NoAnswer, PeerFault
from servobench.drivers.timebase import NS_PER_MS, Duration, Instant
from servobench.drivers.wire.frame_port import EchoBasis
from servobench.hil.loop.pace import CALIBRATION_LATE, HeardSync, OwnSync, Stall, Start
from servobench.hil.loop.syncs import SyncLog
from tests.unit.hil.loop_fakes import PERIOD, SYNC_LATENCY, FakeBus, FakeDrive, make_axis

SETTLE = Duration(3 * NS_PER_MS)
DELAY = 250_000


class Rig:
    """A pace of its own on a made-up bus, that tells its SYNCs' echoes if they are to come."""

    def __init__(
        self,
        drives: int = 1,
        lost: int = 0,
        echoes: bool = True,
        stall: Stall | None = None,
        watermark: int = 0,
    ) -> None:
        """``lost``: readings of the last drive at first."""
        answers = [lambda _number: DELAY] * (drives - 1)
        self.drives = [FakeDrive(each) for each in answers]
        self.drives.append(FakeDrive(lambda number: None if number <= lost else DELAY))
        self.bus = FakeBus(self.drives)
        self.log = SyncLog(SYNC_LATENCY, PERIOD, EchoBasis.BUS)
        if echoes:
            self.bus.on_sync_echo = self.log.came
        self.axes = [make_axis(drive, [], syncs=self.log) for drive in self.drives]
        self.pace = OwnSync(self.bus, self.bus, PERIOD, [self.log], stall, Duration(watermark))

    def begun(self) -> Instant:
        """The first tick."""
        return self.pace.begin(self.axes)


def told(start: Start) -> tuple[Instant, Instant | None, bool]:
    return start.due_at, start.woke_at, start.served


@pytest.mark.parametrize(("lost", "syncs"), [(0, 16), (7, 16), (8, 17), (30, 39), (55, 64), (56, 64)])
@pytest.mark.parametrize("drives", [1, 2])
def test_sixteen_syncs_calibrate_of_which_eight_must_teach(lost: int, syncs: int, drives: int) -> None:
    """Four times as many at most, each as long before the next as a reading may take, but for a part of a
    period by which it is late: so stamps show by what steps they advance. The first reading after a lost one
    teaches nothing: it might be that one's."""
    rig = Rig(drives, lost)
    assert rig.pace.calibrate(rig.axes, SETTLE) == [True] * drives
    assert len(rig.bus.handed_at) == syncs
    late = [at - number * SETTLE for number, at in enumerate(rig.bus.handed_at)]
    assert 0 <= min(late) < max(late) <= PERIOD // CALIBRATION_LATE
    assert len(set(late)) == syncs
    assert {mark.sequence for mark in rig.log.marks} == {0}, "of no cycle"


@pytest.mark.parametrize("stalled_ms", [2, 60, 700])
@pytest.mark.parametrize("at_ms", [7, 20, 44])
def test_syncs_of_a_calibration_are_not_made_up_for_after_a_standstill(at_ms: int, stalled_ms: int) -> None:
    """A burst of them would flood the bus, and its readings teach nothing."""
    rig = Rig()

    def stand_still() -> None:
        rig.bus.at = Instant(rig.bus.at + stalled_ms * NS_PER_MS)

    rig.bus.call_at(at_ms * NS_PER_MS, stand_still)
    assert rig.pace.calibrate(rig.axes, SETTLE) == [True]
    distances = [after - before for before, after in pairwise(rig.bus.handed_at)]
    assert min(distances) >= SETTLE - PERIOD // 2 - PERIOD // CALIBRATION_LATE
    assert max(distances) >= stalled_ms * NS_PER_MS
    assert len(rig.bus.handed_at) <= 18


def test_which_drives_have_answered_is_told() -> None:
    rig = Rig(2, lost=1000)
    assert rig.pace.calibrate(rig.axes, SETTLE) == [True, False]


def test_a_run_begins_a_period_from_now_and_goes_on_by_periods() -> None:
    rig = Rig()
    rig.bus.at = Instant(12_345)
    first = rig.begun()
    assert first == 12_345 + PERIOD
    for number in range(3):
        due = Instant(first + number * PERIOD)
        assert told(rig.pace.next()) == (due, due, True)
        assert rig.pace.sync(number + 1, due, False) == due
    assert [mark.sequence for mark in rig.log.marks] == [1, 2, 3]
    assert rig.pace.can_probe


def test_a_watermark_makes_each_sync_late_by_a_part_of_it_and_the_grid_is_kept() -> None:
    rig, again = Rig(watermark=5_000), Rig(watermark=5_000)
    first = rig.begun()
    late = []
    for number in range(100):
        due = Instant(first + number * PERIOD)
        assert told(rig.pace.next()) == (due, due, True)
        late.append(rig.pace.sync(number + 1, due, False) - due)
    assert 0 <= min(late) < 500 < 4_500 < max(late) <= 5_000
    due = again.begun()
    again.pace.next()
    assert again.pace.sync(1, due, False) - due == late[0], "by a seed of its own"


def test_a_probe_is_sent_a_quarter_of_a_period_late() -> None:
    rig = Rig()
    due = rig.begun()
    rig.pace.next()
    assert rig.pace.sync(1, due, True) == due + PERIOD // 4


@pytest.mark.parametrize(
    ("late", "skipped"), [(0, 0), (999_999, 0), (1_000_000, 1), (1_999_999, 1), (3_300_000, 3)]
)
def test_a_sync_that_is_whole_periods_late_is_that_of_a_later_cycle(late: int, skipped: int) -> None:
    """The process was stopped just before."""
    rig = Rig()
    due = rig.begun()
    rig.pace.next()
    rig.bus.at = Instant(due + late)
    assert rig.pace.sync(5, due, False) == due + late
    assert rig.log.marks[-1].sequence == 5 + skipped
    rig.bus.pump(Instant(rig.bus.at + SYNC_LATENCY))
    assert rig.pace.next().due_at == due + (1 + skipped) * PERIOD


@pytest.mark.parametrize(
    ("stalled", "missed"), [(500_000, 0), (500_001, 1), (1_500_000, 1), (1_500_001, 2), (3_700_000, 4)]
)
def test_ticks_for_which_the_host_comes_half_a_period_late_are_told_one_by_one(
    stalled: int, missed: int
) -> None:
    stalls = iter([stalled])
    rig = Rig(stall=lambda _now: Duration(next(stalls, 0)))
    first = rig.begun()
    starts = [told(rig.pace.next()) for _ in range(missed + 1)]
    assert starts[:missed] == [(first + number * PERIOD, None, False) for number in range(missed)]
    due = first + missed * PERIOD
    assert starts[missed] == (due, max(first + stalled, due), True)
    assert rig.bus.now() <= due + PERIOD // 2


def test_what_came_while_the_host_was_late_is_taken_in() -> None:
    stalls = iter([0, 800_000])
    rig = Rig(stall=lambda _now: Duration(next(stalls, 0)))
    due = rig.begun()
    rig.pace.next()
    rig.pace.sync(1, due, False)
    assert told(rig.pace.next()) == (due + PERIOD, None, False)
    assert len(rig.drives[0].readings) == 1


def test_no_sync_is_handed_over_before_the_last_one_is_out() -> None:
    """Its echo does not come: after two periods it is given up."""
    rig = Rig(echoes=False)
    due = rig.begun()
    assert rig.pace.next().served
    rig.pace.sync(1, due, False)
    starts = [told(rig.pace.next()) for _ in range(2)]
    assert starts == [
        (due + PERIOD, due + PERIOD, False),
        (due + 2 * PERIOD, due + 2 * PERIOD, True),
    ]


@pytest.mark.parametrize(
    ("ended", "served", "now"),
    [(-500_000, True, 0), (-200_000, True, 300_000), (0, True, 500_000), (1, False, 0)],
)
def test_a_sync_follows_the_last_one_by_half_a_period_and_is_late_by_no_more(
    ended: int, served: bool, now: int
) -> None:
    rig = Rig()
    due = rig.begun()
    rig.log.heard(0, Instant(due + ended))
    assert told(rig.pace.next()) == (due, due, served)
    assert rig.bus.now() == due + now


# ---- SYNCs of another node -------------------------------------------------------------------------------


def heard(*instants: int) -> HeardSync:
    drive = FakeDrive(lambda _number: DELAY)
    bus, log = FakeBus([drive]), SyncLog(SYNC_LATENCY, PERIOD, EchoBasis.BUS)
    pace = HeardSync(bus, bus, PERIOD, log)
    bus.produce(instants, pace.hear)
    pace.calibrate([make_axis(drive, [], syncs=log)], SETTLE)
    return pace


@pytest.mark.parametrize(("count", "evidence"), [(0, ""), (1, "after 1 of them"), (7, "after 7 of them")])
def test_all_that_is_said_of_a_producer_that_is_silent(count: int, evidence: str) -> None:
    with pytest.raises(NoAnswer) as caught:
        heard(*[number * PERIOD for number in range(1, count + 1)])
    assert (caught.value.summary, caught.value.evidence, caught.value.remedy) == (
        "no SYNC was heard within 1.002 s",
        evidence,
        "check that its producer is running, and sends it with COB-ID 080h (1005h)",
    )


def test_all_that_is_said_of_another_period() -> None:
    """1024 us for 1000 us, the smallest mistake in a setting."""
    with pytest.raises(PeerFault) as caught:
        heard(*[number * 1_024_000 for number in range(1, 150)])
    assert (caught.value.summary, caught.value.evidence, caught.value.remedy) == (
        "SYNC comes every 1024.0 us, and loop.period_us is 1000",
        "a line through 129 of them; 2% are let pass",
        "set loop.period_us or the producer's 1006h to the other; only one node may produce SYNC",
    )
    assert not heard(*[number * 1_020_000 for number in range(1, 50)]).can_probe
