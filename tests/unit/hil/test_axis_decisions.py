"""What an axis decides in a cycle, and the whole record of it."""

import math
from collections.abc import Sequence
from dataclasses import replace

import pytest

from servobench.drivers.errors import LimitExceeded
from servobench.drivers.exchange import Command
from servobench.drivers.timebase import Duration, Instant
from servobench.hil.loop.axis import Axis
from servobench.hil.loop.cycle_record import CycleRecord
from servobench.hil.loop.protocol import Context, Controller, PositionSetPoint, SetPoint, TorqueSetPoint
from servobench.hil.loop.safety import PositionLimits, SafetyGuard, TorqueLimits
from servobench.hil.loop.samples import CommandFate, Dropout, DropoutCause, Sample, StateEstimate
from servobench.hil.loop.scenario import LevelStep, Quantity, Ramp, ReferenceProfile
from tests.unit.hil.axis_rig import DECIDED, DELAY, HORIZON, Rig
from tests.unit.hil.loop_fakes import (
    COMMAND_LATENCY,
    PERIOD,
    SYNC_LATENCY,
    Proportional,
)


class LoadMachine:
    """Takes torques."""

    def __init__(self) -> None:
        self.torques_nm: list[float] = []

    def set_torque(self, torque_nm: float) -> None:
        self.torques_nm.append(torque_nm)


# ---- decisions ------------------------------------------------------------------------------------------


class Telling(Proportional):
    """Tells twice its set-point, and notes what it was called for."""

    def __init__(self) -> None:
        super().__init__()
        self.told: list[str] = []
        self.contexts: list[tuple[int, Instant, float, Instant, Instant, int]] = []

    def reset(self) -> None:
        self.told.append("reset")

    def output(self, context: Context) -> SetPoint:
        self.contexts.append(
            (
                context.sequence,
                context.due_at,
                context.reference_rad_s,
                context.now,
                context.acts_at,
                len(context.samples),
            )
        )
        return super().output(context)

    def update(self, context: Context, command: Command) -> None:
        sent = context.sent is command
        self.told.append(f"update {command.sequence}{' sent' if sent else ''}")

    def telemetry(self) -> Sequence[float]:
        return (2.0 * len(self.told),)


def test_a_cycle_is_decided_on_its_samples_and_recorded_whole() -> None:
    controller = Telling()
    rig = Rig(controller)
    rig.axis.reset()
    tick = rig.begin(1)
    reading = rig.answer(1, speed=1.5)
    rig.axis.collect()
    rig.decide(tick)
    at = tick.due_at
    decided, acts_at = at + DECIDED, at + DECIDED + COMMAND_LATENCY
    assert controller.contexts == [(1, at, 0.0, decided, acts_at, 1)]
    assert rig.compensator.told == ["reset", "sample 1", "estimate 1", "sent 1"]
    assert controller.told == ["reset", "update 1 sent"]
    assert rig.drive.commands == [Command(1, -1.5, Instant(acts_at), Instant(acts_at + PERIOD))]
    rig.axis.settle(1)
    assert rig.records == []
    rig.axis.settle_all(1 + HORIZON)
    (record,) = rig.records
    assert record.compute_ns is not None
    assert 0 <= record.compute_ns < 10**9
    sample = record.observation
    assert isinstance(sample, Sample)
    assert (sample.sequence, sample.reading, sample.sampled_at, sample.certain) == (1, reading, at, True)
    assert (record.sequence, record.axis, record.due_at, record.woke_at) == (1, 0, at, at)
    assert (record.sync_handed_at, record.sync_on_bus_at, record.delay) == (at - SYNC_LATENCY, at, DELAY)
    assert record.estimate == StateEstimate(0.0, 1.5, 0.0, at, 1)
    assert (record.reference_rad_s, record.load_torque_nm, record.channels) == (0.0, 0.0, (4.0,))
    assert record.command == rig.drive.commands[0]
    assert record.sending is not None
    assert (record.sending.raw, record.sending.fate) == (-1500, CommandFate.NOT_MEASURED)
    clock = rig.axis.by_stamp.clock
    assert (record.clock_offset_ns, record.clock_error_ns) == (clock.offset_ns, clock.error_ns)
    assert (record.reference_rad, record.reference_nm) == (None, None)


def test_samples_are_fresh_in_one_cycle_only() -> None:
    controller = Telling()
    rig = Rig(controller, TorqueLimits(5.0, 200.0, dropouts_consecutive_max=2))
    rig.cycle(1)
    rig.cycle(2, answered=False)
    rig.cycle(3, answered=False)
    assert [each[5] for each in controller.contexts] == [1, 0, 0]
    with pytest.raises(LimitExceeded) as caught:
        rig.cycle(4, answered=False)
    assert str(caught.value) == (
        "axis1: no usable reading for 3 cycles (limit 2); the drive is being brought to rest"
    )
    assert len(rig.drive.commands) == 3, "none is sent after it"


def test_a_command_that_was_not_sent_is_no_compensator_s_and_has_no_fate() -> None:
    controller = Telling()
    rig = Rig(controller)
    rig.drive.sends = False
    rig.cycle(1)
    assert rig.compensator.told == ["sample 1", "estimate 1"]
    assert controller.told == ["update 1"]
    rig.axis.settle_all(1 + HORIZON)
    (record,) = rig.records
    assert record.sending is None
    assert record.command is not None


def test_a_reading_beyond_the_limit_of_speed_stops_the_run() -> None:
    rig = Rig(limits=TorqueLimits(5.0, 20.0))
    rig.cycle(1, speed=-20.0)
    with pytest.raises(LimitExceeded) as caught:
        rig.cycle(2, speed=-20.1)
    assert str(caught.value) == (
        "axis1: speed -20.1 rad/s is beyond the limit of 20.0 rad/s; the drive is being brought to rest"
    )


def made_anew(rig_records: list[CycleRecord], axis: Axis, number: int = 0, **parts: object) -> Axis:
    return Axis(number, replace(axis.parts, **parts), PERIOD, rig_records.append)  # type: ignore[arg-type]


def test_the_load_machine_is_told_when_its_torque_changes() -> None:
    machine = LoadMachine()
    load = ReferenceProfile([LevelStep(0.002, 0.5), LevelStep(0.004, 0.25)], Quantity.TORQUE)
    records: list[CycleRecord] = []
    rig = Rig(change=lambda axis: made_anew(records, axis, 3, load=load, load_machine=machine))
    for number in range(1, 6):
        rig.cycle(number)
    rig.axis.settle_all(5 + HORIZON)
    assert machine.torques_nm == [0.5, 0.25]
    assert [record.load_torque_nm for record in records] == [0.0, 0.5, 0.5, 0.25, 0.25]
    assert {record.axis for record in records} == {3}


def test_on_a_slower_segment_a_command_acts_later() -> None:
    records: list[CycleRecord] = []
    rig = Rig(change=lambda axis: made_anew(records, axis, acts_later=Duration(33_000)))
    rig.cycle(1)
    acts_at = rig.at(1) + DECIDED + COMMAND_LATENCY + 33_000
    assert [(command.effective_at, command.expires_at) for command in rig.drive.commands] == [
        (acts_at, acts_at + PERIOD)
    ]


# ---- references of other quantities ---------------------------------------------------------------------


class GoingTo(Controller):
    """To the position that is asked for."""

    def output(self, context: Context) -> SetPoint:
        return PositionSetPoint(context.reference_rad)


def test_positions_are_counted_from_where_the_shaft_is_held() -> None:
    records: list[CycleRecord] = []
    reference = ReferenceProfile([Ramp(0.001, 0.02, 0.004)], Quantity.POSITION)
    guard = SafetyGuard(PositionLimits(1000.0, 2000.0), PERIOD / 1e9)
    rig = Rig(GoingTo(), change=lambda axis: made_anew(records, axis, reference=reference, guard=guard))
    rig.drive.held_rad = 7.0
    rig.axis.reset()
    for number in (1, 2, 3):
        rig.cycle(number)
    rig.axis.settle_all(3 + HORIZON)
    assert [record.reference_rad for record in records] == pytest.approx([7.0, 7.005, 7.01])
    assert [record.reference_rad_s for record in records] == pytest.approx([5.0, 5.0, 5.0])
    assert {record.reference_nm for record in records} == {None}


class Asked(Controller):
    """The torque that is asked for."""

    def output(self, context: Context) -> SetPoint:
        return TorqueSetPoint(context.reference_nm)


def test_a_reference_of_torques_has_no_speed() -> None:
    records: list[CycleRecord] = []
    reference = ReferenceProfile([LevelStep(0.002, 1.25)], Quantity.TORQUE)
    rig = Rig(Asked(), change=lambda axis: made_anew(records, axis, reference=reference))
    rig.axis.reset()
    rig.cycle(1)
    rig.cycle(2)
    rig.axis.settle_all(2 + HORIZON)
    assert [record.reference_nm for record in records] == [0.0, 1.25]
    assert [command.torque_nm for command in rig.drive.commands] == [0.0, 1.25]
    assert all(math.isnan(record.reference_rad_s) for record in records)
    assert {record.reference_rad for record in records} == {None}


# ---- cycles without a SYNC, and rows that wait ----------------------------------------------------------


def test_a_cycle_without_sync_is_a_dropout_that_counts() -> None:
    controller = Telling()
    rig = Rig(controller, TorqueLimits(5.0, 200.0, dropouts_consecutive_max=3))
    rig.cycle(1)
    assert [rig.axis.miss(rig.tick(number)) for number in (2, 3)] == [None, None]
    rig.cycle(4, answered=False)
    assert rig.axis.miss(rig.tick(5)) == "axis1: no usable reading for 4 cycles (limit 3)"
    assert controller.dropouts == [0, 3]
    rig.axis.settle_all(5 + HORIZON)
    assert [record.observation for record in rig.records[1:3]] == [
        Dropout(number, rig.at(number), DropoutCause.MISSED, True) for number in (2, 3)
    ]
    assert [record.sync_handed_at for record in rig.records[1:3]] == [None] * 2
    assert [record.command for record in rig.records[1:3]] == [None] * 2


def test_a_row_whose_sync_is_unsure_is_uncertain() -> None:
    rig = Rig()
    rig.begin(1)
    rig.log.marks[-1].sure = False
    rig.answer(1)
    rig.axis.collect()
    rig.cycle(2)
    rig.axis.settle_all(2 + HORIZON)
    assert [record.observation.certain for record in rig.records] == [False, True]
    assert rig.axis.uncertain == 1


def test_a_lost_reading_is_known_to_be_lost_after_the_horizon() -> None:
    rig = Rig()
    rig.drive.sends = False
    for number in range(1, HORIZON + 2):
        rig.cycle(number, answered=number != 1)
        assert (len(rig.records) > 0) is (number == HORIZON + 1)
    assert rig.records[0].observation == Dropout(1, rig.at(1), DropoutCause.LOST, True)
    assert [record.sequence for record in rig.records] == list(range(1, HORIZON + 1)), (
        "the newest may be amended"
    )
