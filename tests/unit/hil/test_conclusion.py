"""What is gathered of a run: how it ended, and which EMCYs its plan names, and when."""

from typing import Any

import pytest

from servobench.drivers.canopen.nmt import Emergency
from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant
from servobench.hil.configuration.config import LoopConfig
from servobench.hil.execution.conclusion import Conclusion, named_emergencies
from servobench.hil.loop.loop import LoopOutcome
from servobench.hil.verdict.verdict import VerdictKind
from servobench.virtual_bus.faults.fates import RecordedFaults
from servobench.virtual_bus.faults.fault_log import KINDS, FaultEntry
from servobench.virtual_bus.faults.fault_plan import FaultPlan
from servobench.virtual_bus.faults.kinds.bus_off import BusOff
from servobench.virtual_bus.faults.kinds.drive_fault import DriveFailure, DriveFault
from servobench.virtual_bus.hosting.injection import Faults
from tests.fates import keys

SECOND = Duration(NS_PER_S)
ONCE = keys(at_s=1.0)
WINDOW = keys(probability_per_s=0.5, from_s=1.0, until_s=1e-9 * (2 * NS_PER_S))


def explained(faults: Faults, at_ms: float, code: int = 0x2310, node: int = 1) -> bool:
    emergency = Emergency(node, code, 3, b"", Instant(0))
    elapsed = Duration(round(at_ms * NS_PER_MS))
    return any(named.explains(emergency, elapsed) for named in named_emergencies(faults))


def plan(occasion: dict[str, Any] = ONCE, nodes: tuple[int, ...] = (1,)) -> FaultPlan:
    return FaultPlan(
        node_faults=(
            BusOff(nodes=nodes, **occasion),
            DriveFault(nodes=nodes, **occasion, fault="over_current"),
        )
    )


@pytest.mark.parametrize(
    ("occasion", "at_ms", "expected"),
    [
        (ONCE, 999.9, False),
        (ONCE, 1000.0, True),
        (ONCE, 1099.9, True),
        (ONCE, 1100.0, False),
        (WINDOW, 999.9, False),
        (WINDOW, 1500.0, True),
        (WINDOW, 2099.9, True),
        (WINDOW, 2100.0, False),
        (keys(every_s=1.0), 1e6, True),
    ],
)
def test_an_emcy_is_named_within_the_window_of_its_fault(
    occasion: dict[str, Any], at_ms: float, expected: bool
) -> None:
    assert explained(plan(occasion), at_ms) is expected


def test_it_is_of_that_node_and_has_that_code() -> None:
    assert not explained(plan(), 1001, code=0x4310)
    assert not explained(plan(), 1001, node=2)
    assert explained(plan(nodes=()), 1001, node=2), "no node named: each drive"


def test_an_encoder_s_loss_is_told_when_it_is_noticed() -> None:
    lost = DriveFault(
        **ONCE,
        fault="encoder_loss",
        detected_after_ms=1e-6 * (200 * NS_PER_MS),
        duration_s=1e-9 * SECOND,
    )
    found = [explained(FaultPlan(node_faults=(lost,)), at_ms, 0x7305) for at_ms in (1150, 1200, 1299, 1300)]
    assert found == [False, True, True, False]


def test_a_recorded_fault_names_its_own_emcy() -> None:
    place = list(DriveFailure).index(DriveFailure.ENCODER_LOSS)
    after = 200 * NS_PER_MS
    entry = FaultEntry(NS_PER_S, place, after, 0, 0, 0, KINDS.index("drive_fault"), 1)
    recorded = RecordedFaults((entry,))
    assert [explained(recorded, at_ms, 0x7305) for at_ms in (1150, 1200, 1299, 1300)] == [
        False,
        True,
        True,
        False,
    ]
    assert not explained(recorded, 1201, 0x7305, node=2)
    assert not explained(RecordedFaults(()), 1201)


SETTINGS = LoopConfig(period_us=1000, decide_after_us=700, deadline_us=2000, horizon_periods=20)


@pytest.mark.parametrize(("late_ms", "completed"), [(0.2, True), (20.9, True), (21.1, False), (4000, False)])
def test_a_host_that_comes_back_later_than_readings_are_waited_for_has_not_seen_the_end(
    late_ms: float, completed: bool
) -> None:
    """Counted from the last tick: SYNCs of others have their own period, and an hour of them drifts by ms."""
    last = Instant(3600 * NS_PER_S)
    loop = LoopOutcome(10, 0, Instant(0), last, Instant(last + round(late_ms * NS_PER_MS)), False)
    conclusion = Conclusion(["axis1"], None, 10)
    conclusion.ended(loop, "", SETTINGS.period, SETTINGS.horizon, bus_load_percent=50.0)
    conclusion.came_to_its_end()
    found = conclusion.outcome
    assert (found.completed, found.bus_load_percent) == (completed, 50.0)
    assert ("came back" in found.reason) is not completed


def test_a_run_of_which_no_end_was_told_was_ended_by_a_defect() -> None:
    conclusion = Conclusion(["axis1"], None, 10)
    loop = LoopOutcome(10, 0, Instant(0), Instant(9 * NS_PER_MS), Instant(10 * NS_PER_MS), False)
    causes = [conclusion.outcome.cause]
    conclusion.ended(loop, "", SETTINGS.period, SETTINGS.horizon)
    causes.append(conclusion.outcome.cause)
    assert not conclusion.outcome.completed
    conclusion.failed(BadInput("bench.toml", "", 1, "2"))
    causes.append(conclusion.outcome.cause)
    assert causes == [VerdictKind.DEFECT, VerdictKind.DEFECT, VerdictKind.BAD_INPUT]
