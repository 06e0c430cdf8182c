"""What an axis learns while it is calibrated, lets go of, takes in, and goes by until it decides."""

import pytest

from servobench.drivers.exchange import DemandChange
from servobench.drivers.timebase import Duration, Instant
from servobench.hil.loop.clock_map import STAMP_RESOLUTION
from servobench.hil.loop.order_question import PROBE_AFTER
from servobench.hil.loop.protocol import Context, Controller, SetPoint, TorqueSetPoint
from servobench.hil.loop.samples import CommandFate
from tests.unit.hil.axis_rig import DELAY, HORIZON, TAUGHT, Rig
from tests.unit.hil.loop_fakes import (
    DEVICE_CLOCK_OFFSET_NS,
    PERIOD,
)

# ---- calibration ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("answers", "learned"),
    [([1, 1, 1], 3), ([1, 0, 1], 1), ([0, 1, 1], 1), ([1, 2, 1], 1), ([1, 2, 0, 1, 1], 2)],
)
def test_a_sync_teaches_with_a_reading_of_its_own_after_one_that_had_one(
    answers: list[int], learned: int
) -> None:
    rig = Rig()
    before = len(rig.axis.lessons)
    assert before == TAUGHT
    for number, count in enumerate(answers, start=1):
        rig.sync(number)
        for place in range(count):
            rig.answer(number - place)
        assert rig.axis.calibrate(rig.log.marks[-1]) is (count > 0)
    assert len(rig.axis.lessons) - before == learned


def test_one_reading_that_came_twice_is_one() -> None:
    for clock in (True, False):
        rig = Rig(clock=clock)
        rig.sync(1)
        rig.answer(1), rig.answer(1)
        assert rig.axis.calibrate(rig.log.marks[-1])
        assert len(rig.axis.lessons) == TAUGHT + 1


def test_a_sync_whose_echo_did_not_come_teaches_nothing() -> None:
    rig = Rig()
    rig.sync(1, echoed=False)
    rig.answer(1)
    assert rig.axis.calibrate(rig.log.marks[-1])
    assert len(rig.axis.lessons) == TAUGHT


def test_what_is_learned_is_the_clock_and_the_usual_delay() -> None:
    stamped, plain = Rig(), Rig(clock=False)
    assert stamped.axis.by_stamp.clock.offset_ns == -DEVICE_CLOCK_OFFSET_NS
    assert (plain.axis.by_stamp.clock.ready, plain.axis.by_order._answered) == (False, TAUGHT)
    assert stamped.axis.meter.typical_delay == plain.axis.meter.typical_delay == DELAY


# ---- what is let go of, and what is kept ----------------------------------------------------------------


def acting(rig: Rig, sequence: int) -> CommandFate:
    (record,) = [record for record in rig.records if record.sequence == sequence]
    assert record.sending is not None
    return record.sending.fate


def play_with_readbacks(rig: Rig, readings_before: int = 0) -> CommandFate:
    """Three cycles in which the drive follows each command by the next SYNC; the fate of the second."""
    raws = [0, 1000, 2000, 3000, 4000]
    for number in range(1, 5):
        tick = rig.begin(number)
        rig.answer(number, speed=-float(number))
        rig.read_back(raws[number - 1], number, readings_before + number)
        rig.axis.collect()
        rig.decide(tick)
        rig.axis.settle(number)
    rig.axis.settle_all(4 + HORIZON)
    return acting(rig, 2)


class Sending(Controller):
    """As many N m as the cycle's number."""

    def output(self, context: Context) -> SetPoint:
        return TorqueSetPoint(float(context.sequence))


def test_readbacks_go_with_the_readings_before_them() -> None:
    assert play_with_readbacks(Rig(Sending())) is CommandFate.ACTING


def test_what_came_before_the_run_is_let_go_of_and_counted() -> None:
    """Readings that wait as well: a read-back tells how many readings there were before it."""
    rig = Rig(Sending())
    rig.sync(0)
    rig.answer(0)
    rig.axis.collect(rig.at(0))
    rig.answer(0, DELAY + 1)
    rig.read_back(77, 0, 2)
    rig.drive.changes.append(DemandChange(77, 0, rig.at(0)))
    rig.axis.discard()
    assert rig.drive.readings == rig.drive.readbacks == rig.drive.changes == []
    rig.axis.collect()
    assert "sample 0" not in rig.compensator.told
    assert play_with_readbacks(rig, readings_before=2) is CommandFate.ACTING
    assert rig.axis.commands.unexplained == 0


def test_what_came_while_calibrating_is_let_go_of() -> None:
    rig = Rig(Sending())
    rig.sync(0)
    rig.answer(0)
    rig.read_back(77, 0, 1)
    rig.drive.changes.append(DemandChange(77, 0, rig.at(0)))
    rig.axis.calibrate(rig.log.marks[-1])
    assert rig.drive.readbacks == rig.drive.changes == []
    assert play_with_readbacks(rig, readings_before=1) is CommandFate.ACTING


def test_what_had_come_by_an_instant_is_taken_in_and_the_rest_in_its_order() -> None:
    rig = Rig()
    for number in (1, 2, 3):
        rig.begin(number)
        rig.answer(number)
    rig.axis.collect(Instant(rig.at(2) + DELAY))
    assert rig.compensator.told == ["sample 1"], "2 came just then"
    rig.axis.collect(Instant(rig.at(2) + DELAY + 1))
    assert rig.compensator.told == ["sample 1", "sample 2"]
    rig.begin(4)
    rig.answer(4)
    rig.axis.collect()
    assert rig.compensator.told == [f"sample {number}" for number in (1, 2, 3, 4)]
    rig.axis.collect()
    assert len(rig.compensator.told) == 4


@pytest.mark.parametrize("late", [0, PERIOD // 2, PERIOD - DELAY - 1])
def test_a_readback_goes_with_the_reading_before_it_until_the_next_sync_ends(late: int) -> None:
    rig = Rig(Sending())
    rig.cycle(1)
    rig.read_back(0, 1, 1)
    rig.axis.settle(1)
    rig.begin(2)
    rig.answer(2)
    rig.read_back(1000, 2, 2, DELAY + late)
    rig.axis.collect()
    rig.axis.settle_all(2 + HORIZON)
    assert acting(rig, 1) is CommandFate.ACTING
    assert (rig.axis.readbacks.exact, rig.axis.readbacks.inexact) == (2, 0)


@pytest.mark.parametrize(("readings", "placed"), [(1, (1, 0)), (2, (1, 0)), (0, (0, 1)), (3, (0, 0))])
def test_a_readback_after_a_reading_that_is_not_known_is_of_no_one_sync(
    readings: int, placed: tuple[int, int]
) -> None:
    rig = Rig(Sending())
    for number in (1, 2):
        rig.begin(number)
        rig.answer(number)
    rig.axis.collect()
    rig.read_back(77, readings, readings)
    rig.axis.settle_all(2 + HORIZON)
    assert (rig.axis.readbacks.exact, rig.axis.readbacks.inexact) == placed


@pytest.mark.parametrize(("in_reading", "exact"), [(True, True), (False, False)])
def test_a_readback_is_of_the_sync_of_its_own_frame_whatever_its_stamp(in_reading: bool, exact: bool) -> None:
    """One from before that comes twice may be stamped just as the next reading is."""
    rig = Rig(Sending())
    rig.axis.readbacks.doubt()
    rig.cycle(1)
    rig.begin(2)
    rig.answer(2)
    rig.axis.collect()
    rig.read_back(0, 2, 2, DELAY, in_reading)
    rig.axis.settle_all(2 + HORIZON)
    assert (rig.axis.readbacks.exact, rig.axis.readbacks.inexact) == (int(exact), int(not exact))


def test_a_change_is_told_between_the_readbacks_before_and_after_it() -> None:
    """At SYNC 2 the drive followed nothing yet, 300 us later command 1, and so at SYNC 3."""
    rig = Rig(Sending())
    rig.cycle(1)
    rig.begin(2)
    rig.answer(2)
    rig.read_back(0, 2, 2)
    rig.begin(3)
    rig.answer(3)
    rig.read_back(1000, 3, 3)
    began = Instant(rig.at(2) + 300_000)
    received = Instant(rig.at(2) + DELAY + 200_000)
    rig.drive.changes.append(DemandChange(1000, began + DEVICE_CLOCK_OFFSET_NS, received))
    rig.axis.collect()
    rig.axis.settle(3)
    rig.axis.settle_all(3 + HORIZON)
    sending = rig.records[0].sending
    assert sending is not None
    # Three SYNCs at equal distances show no steps of its stamps, and this is the first change: 700 us apart.
    error = rig.axis.by_stamp.clock.error_ns + 700_000 - STAMP_RESOLUTION
    assert sending.fate is CommandFate.ACTING
    assert (sending.acts_after, sending.acts_by) == (began - error, began + error)


# ---- probes ---------------------------------------------------------------------------------------------


def test_a_drive_without_a_clock_wants_a_probe_after_a_gap_until_it_has_gone_out() -> None:
    rig = Rig(clock=False)
    rig.cycle(1)
    assert not rig.axis.wants_probe
    rig.cycle(2, answered=False)
    for number in range(3, 3 + PROBE_AFTER):
        assert not rig.axis.wants_probe, "readings may show it by themselves"
        rig.cycle(number)
    assert rig.axis.wants_probe
    rig.begin(3 + PROBE_AFTER)
    rig.axis.probed()
    assert not rig.axis.wants_probe


# ---- when to decide -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("usual", "decide_after", "behind"),
    [
        (DELAY, DELAY, 0),
        (DELAY, DELAY - 1, 1),
        (DELAY + PERIOD, DELAY, 1),
        (DELAY + PERIOD + 1, DELAY, 2),
        (0, DELAY, 0),
    ],
)
def test_a_reading_that_usually_comes_after_the_decision_is_not_awaited(
    usual: int, decide_after: int, behind: int
) -> None:
    rig = Rig()
    rig.cycle(1)
    rig.cycle(2)
    rig.axis.meter._typical_ns = float(usual)
    expected = [rig.axis.has_expected(number, Duration(decide_after)) for number in range(1, 7)]
    assert expected == [number - behind <= 2 for number in range(1, 7)]
