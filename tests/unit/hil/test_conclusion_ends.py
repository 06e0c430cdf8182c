"""The end of a run, drive by drive: how each was left, what it had said, and what ended the run."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import pytest

from servobench.drivers.canopen.nmt import Emergency
from servobench.drivers.cia402.follow_watch import FollowWatch
from servobench.drivers.cia402.profile import State
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.cia402.supervision import Release
from servobench.drivers.errors import BadInput, DriveInFault, NoAnswer, PeerFault
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Instant
from servobench.hil.configuration.config import LoopConfig
from servobench.hil.execution.conclusion import Conclusion
from servobench.hil.loop.loop import LoopOutcome
from servobench.hil.recording.logger_process import RecordingFailed
from servobench.hil.verdict.verdict import DriveEnd, VerdictKind
from tests.unit.hil.test_conclusion import SETTINGS, plan


class Drive:
    """A drive as it is found after the last cycle."""

    def __init__(self, log: list[str], name: str, state: State | None = State.OPERATION_ENABLED) -> None:
        self.name, self.node_id = name, int(name[-1])
        self.identity: object = "somebody"
        self.plan: object = "a plan"
        self.fault: PeerFault | None = None
        self.supervision = SimpleNamespace(end=lambda: log.append(f"{name} unsupervised"))
        self.control = SimpleNamespace(
            read_state=self.read_state,
            title=f"{name} (node {self.node_id})",
            evidence=lambda: "statusword 0008h",
            make=(0, ""),
        )
        self.network = SimpleNamespace(emergencies=list[Emergency]())
        self.follow = FollowWatch()
        self._log, self._state = log, state

    def read_state(self) -> State | None:
        self._log.append(f"{self.name} asked")
        return self._state

    def check(self) -> None:
        self._log.append(f"{self.name} checked")
        if self.fault is not None:
            raise self.fault


def drives(*made: Drive) -> list[ServoDrive]:
    return [cast(ServoDrive, drive) for drive in made]


def test_all_are_checked_before_commands_cease_and_any_is_asked() -> None:
    log: list[str] = []
    conclusion = Conclusion(["axis1", "axis2"], None, 10)
    conclusion.look_at(drives(Drive(log, "axis1"), Drive(log, "axis2")))
    assert log == [
        *("axis1 checked", "axis2 checked"),
        *("axis1 unsupervised", "axis2 unsupervised"),
        *("axis1 asked", "axis2 asked"),
    ]
    assert conclusion.outcome.drives == (
        DriveEnd("axis1", after_last_cycle="operation enabled"),
        DriveEnd("axis2", after_last_cycle="operation enabled"),
    )


@pytest.mark.parametrize(("state", "told"), [(State.FAULT, "fault"), (None, "unknown")])
def test_one_that_is_enabled_no_more_is_told_with_its_state(state: State | None, told: str) -> None:
    conclusion = Conclusion(["axis1", "axis2"], None, 10)
    with pytest.raises(DriveInFault) as caught:
        conclusion.look_at(drives(Drive([], "axis1", state), Drive([], "axis2")))
    expected = DriveInFault(
        "axis1 (node 1) was not enabled any more after the last cycle", "statusword 0008h"
    )
    assert str(caught.value) == str(expected)
    assert conclusion.outcome.drives == (DriveEnd("axis1", after_last_cycle=told), DriveEnd("axis2"))


def test_one_that_complained_is_not_asked() -> None:
    log: list[str] = []
    drive = Drive(log, "axis1")
    drive.fault = NoAnswer("it is silent")
    with pytest.raises(NoAnswer):
        Conclusion(["axis1"], None, 10).look_at(drives(drive))
    assert log == ["axis1 checked"]


Change = Callable[[Drive], object]


@pytest.mark.parametrize(
    ("lacks", "release", "end"),
    [
        (
            "",
            Release(True, State.SWITCH_ON_DISABLED, "", None, "1016h differs"),
            DriveEnd("axis1", None, "switch on disabled", True, "", "1016h differs"),
        ),
        ("", Release(False, None, "it turns"), DriveEnd("axis1", None, "unknown", False, "it turns")),
        ("plan", Release(True, State.FAULT), DriveEnd("axis1", None, "fault", None)),
        ("plan", Release(False, State.FAULT), DriveEnd("axis1", None, "fault", False)),
        ("identity", Release(True, None, "never connected"), DriveEnd("axis1", evidence="never connected")),
    ],
)
def test_how_each_was_left_is_kept(lacks: str, release: Release, end: DriveEnd) -> None:
    """Of one that was not configured nobody knows the unit of speed; one that never answered has no state."""
    drive = Drive([], "axis1")
    if lacks:
        setattr(drive, lacks, None)
    conclusion = Conclusion(["axis1"], None, 10)
    conclusion.released(cast(ServoDrive, drive), release)
    assert conclusion.outcome.drives == (end,)


def emergency(at_ms: float, node: int = 1, code: int = 0x2310) -> Emergency:
    return Emergency(node, code, 0x02, bytes(5), Instant(round(at_ms * NS_PER_MS)))


TEXT = emergency(0).told(0, "")


@pytest.mark.parametrize(
    ("emergencies", "zero_ms", "told"),
    [
        ([emergency(499.9)], 0, []),
        ([emergency(500)], 0, [f"axis1: {TEXT} at 0.500 s"]),
        ([emergency(1500)], 1000, [f"axis1: {TEXT} at 0.500 s"]),
        ([emergency(1500)], None, [f"axis1: {TEXT}"]),
        ([emergency(1500, node=2), emergency(1600, code=0)], 0, []),
        # the plan names over-currents of node 1 from 1.0 s on, for 0.1 s
        ([emergency(1050), emergency(1100)], 0, [f"axis1: {TEXT} at 1.100 s"]),
        ([emergency(1050)], None, [f"axis1: {TEXT}"]),
    ],
)
def test_what_a_drive_said_is_told_unless_the_plan_made_it(
    emergencies: list[Emergency], zero_ms: int | None, told: list[str]
) -> None:
    drive = Drive([], "axis1")
    drive.network.emergencies += emergencies
    conclusion = Conclusion(["axis1"], plan(), 10)
    zero = None if zero_ms is None else Instant(zero_ms * NS_PER_MS)
    conclusion.told(cast(ServoDrive, drive), Instant(500 * NS_PER_MS), zero)
    assert conclusion.outcome.emergencies == tuple(told)


def ended(late_ms: float, interrupted: bool = False, **settings: Any) -> tuple[bool, str, VerdictKind | None]:
    """Whether it was completed, and why not, of a run whose host came back so late after its last tick."""
    config = LoopConfig.model_validate(SETTINGS.model_dump() | settings)
    last = Instant(NS_PER_S)
    loop = LoopOutcome(10, 0, Instant(0), last, Instant(last + round(late_ms * NS_PER_MS)), interrupted)
    conclusion = Conclusion(["axis1"], None, 10)
    conclusion.ended(loop, "SIGTERM", config.period, config.horizon)
    conclusion.came_to_its_end()
    outcome = conclusion.outcome
    return outcome.completed, outcome.reason, outcome.cause


def test_a_run_is_cut_short_by_who_asks_for_it_or_by_a_host_that_was_away() -> None:
    """After the last cycle of 1 ms readings are waited for during 20 of them."""
    whole = (True, "", VerdictKind.CUT_SHORT)
    assert ended(0.0) == ended(21.0) == whole
    away = "the host was away at the end, and came back 21 ms after the last cycle"
    assert ended(22.0) == (False, away, VerdictKind.CUT_SHORT)
    assert ended(22.0, horizon_periods=21) == whole
    assert ended(0.0, interrupted=True) == (False, "SIGTERM", VerdictKind.INTERRUPTED)
    assert ended(400.0, interrupted=True) == (False, "SIGTERM", VerdictKind.INTERRUPTED)


def test_an_error_is_noted_and_the_recording_closed_before_it_passes_on() -> None:
    log: list[str] = []
    conclusion = Conclusion(["axis1"], None, 10)

    def close() -> None:
        log.append(conclusion.outcome.reason)
        raise RecordingFailed("the disk is full")

    def fail() -> None:
        with conclusion.explaining(close):
            raise BadInput("bench.toml", "a", 1, "2")

    with pytest.raises(BadInput) as caught:
        fail()
    assert log == [str(caught.value)]
    assert conclusion.outcome.cause is VerdictKind.BAD_INPUT


def test_a_defect_closes_the_recording_too_and_is_told_as_one() -> None:
    log: list[VerdictKind | None] = []
    conclusion = Conclusion(["axis1"], None, 10)

    def fail() -> None:
        with conclusion.explaining(lambda: log.append(conclusion.outcome.cause)):
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert log == [VerdictKind.DEFECT]
    assert conclusion.outcome.reason == "it ended by a defect of this program"
    with conclusion.explaining(lambda: log.append(None)):
        pass
    assert len(log) == 1, "what goes well closes nothing"
