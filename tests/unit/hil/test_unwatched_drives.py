"""Drives without a heartbeat consumer: guarded by remote frames; without that, not moved unless asked."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast
from unittest.mock import ANY

import pytest

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.objects import SettingRefused
from servobench.drivers.cia402.drive_setup import DriveSettings
from servobench.drivers.cia402.profile import State
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.cia402.supervision import Release
from servobench.drivers.errors import PeerFault
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant
from servobench.drivers.wire.adapters import parse_bus_spec
from servobench.hil.commissioning.findings import StepVerdict
from servobench.hil.commissioning.report import Commissioned
from servobench.hil.execution.world import World, WorldPlan, open_world
from servobench.hil.write_lists import RIG
from servobench.virtual_bus.device.canopen_device import CanopenDevice
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from servobench.virtual_bus.drive.unknown_drive import unknown_drive
from servobench.virtual_bus.frame import Frame
from tests.motors import LING
from tests.scenario.test_commissioning_host_gaps import SEED, commissioned

pytestmark = pytest.mark.long

NO_CONSUMER = ("1016",)
NEITHER = ("1016", "100C", "100D")
CYCLE = Duration(NS_PER_MS)


def verdicts(result: Commissioned) -> dict[str, StepVerdict]:
    return {record.name: record.verdict for record in result.records}


def test_a_drive_without_heartbeat_consumer_is_commissioned_under_life_guarding(tmp_path: Path) -> None:
    fast = {"mechanics": 500}
    result, still = commissioned(tmp_path, fast, lacks=(*NO_CONSUMER, "1029"))
    assert result.passed, [(record.name, record.reason) for record in result.records]
    (proof,) = (record for record in result.records if record.name == "watchdog")
    assert 100 < proof.outcome.figures["reaction_ms"] <= 150 + 10
    before, after = still.stood["mechanics"]
    assert before > 10.0, "it turned when the host stood still"
    assert after < 0.5
    assert (0x701, True) in still.kinds
    assert result.left.restoration is not None
    assert result.left.restoration.complete


def test_without_any_watch_it_is_named_before_anything_turns(tmp_path: Path) -> None:
    result, still = commissioned(tmp_path, {}, lacks=NEITHER)
    assert not result.passed
    last = result.records[-1]
    assert last.name == "setup"
    assert "no 1016h, and cannot be guarded" in last.reason
    assert "--unwatched" in last.reason
    assert max(speed for speed, _ in still.fastest.values()) < 0.01


def test_unwatched_it_turns_slowly_and_not_far(tmp_path: Path) -> None:
    result, still = commissioned(tmp_path, {}, lacks=NEITHER, unwatched=True)
    found = verdicts(result)
    assert result.error is None
    assert found["mechanics"] is found["delays"] is found["suggest"] is StepVerdict.DONE
    assert found["response"] is StepVerdict.LEFT_OUT
    _, truth = unknown_drive(SEED)
    assert result.findings.mechanics is not None
    assert result.findings.mechanics.inertia_kg_m2 == pytest.approx(truth.motor.inertia_kg_m2, rel=0.05)
    allowed_rad_s = 0.5 * truth.motor.rated_speed_rad_s
    assert max(speed for speed, _ in still.fastest.values()) < 0.2 * 1.3 * allowed_rad_s
    assert (0x701, True) not in still.kinds, "nothing is guarded that cannot be"
    faults = [fault for record in result.records for fault in record.outcome.faults]
    assert any("does not notice that its host is gone" in fault for fault in faults)


def test_unwatched_somebody_has_to_say_that_he_stands_by(tmp_path: Path) -> None:
    """At a terminal an empty answer is no yes."""
    result, still = commissioned(
        tmp_path, {}, lambda _world, _still, _idle: None, lacks=NEITHER, unwatched=True
    )
    proof = next(record for record in result.records if record.name == "watchdog")
    assert "nobody stands by" in proof.reason
    assert max(speed for speed, _ in still.fastest.values()) < 0.01


class Deaf:
    """A simulated drive whose CAN controller takes no remote frames, as many do."""

    def __init__(self, servo: SimulatedServo) -> None:
        self._servo = servo

    def __getattr__(self, name: str) -> Any:
        return getattr(self._servo, name)

    def receive(self, frame: Frame, now: Instant) -> Sequence[Frame]:
        """As the drive, but for remote frames."""
        return () if frame.remote else self._servo.receive(frame, now)


class Lab:
    """A drive of the client's own, on a simulated bus."""

    def __init__(self, world: World, servo: SimulatedServo) -> None:
        self.world, self.servo = world, servo
        self.network = CanopenNetwork(world.link, world.clock, writes=RIG)
        self.drive = ServoDrive(self.network, 1)
        self.drive.connect(self.soon())

    def soon(self) -> Instant:
        return self.network.deadline_after(Duration(NS_PER_S))

    def cycles(self, count: int) -> None:
        """SYNCs, readings, and the look at the drive."""
        for _ in range(count):
            self.network.send_sync()
            self.network.pump(self.network.deadline_after(CYCLE))
            self.drive.take_readings()
            self.drive.check()

    def held(self, index: int) -> int:
        return int(self.servo.dictionary.variable(index).value)


@contextmanager
def lab(lacks: Sequence[str], *, deaf: bool = False) -> Iterator[Lab]:
    servo = SimulatedServo(1, LING, DriveParameters(lacks=tuple(lacks)))
    device = cast(CanopenDevice, Deaf(servo) if deaf else servo)
    with open_world(WorldPlan(parse_bus_spec("simulated"), 1_000_000, False, None, 0), [device]) as world:
        yield Lab(world, servo)


@pytest.mark.parametrize("lacks", [("1016",), ("1017",), ("1016", "1017")], ids=str)
def test_a_guarded_drive_runs_and_is_let_go(lacks: tuple[str, ...]) -> None:
    with lab(lacks) as bench:
        (note, *_) = bench.drive.configure(DriveSettings(CYCLE))
        assert "node guarding" in note
        bench.drive.enable(bench.soon())
        bench.cycles(2000)
        assert bench.drive.release() == Release(True, State.SWITCH_ON_DISABLED, rested_at=ANY, unwatched="")
        assert bench.held(0x100D) == 0 or "1016" not in lacks
        sent = bench.world.link.sent_frames
        bench.network.produce_heartbeat(Duration(0))
        bench.network.pump(bench.soon())
        assert bench.world.link.sent_frames == sent, "nobody is asked any more"


@pytest.mark.parametrize("lacks", [("1016",), ("1017",), ("1016", "1017")], ids=str)
def test_a_guarded_drive_stops_without_its_host_and_a_lost_one_is_missed(lacks: tuple[str, ...]) -> None:
    with lab(lacks) as bench:
        bench.drive.configure(DriveSettings(CYCLE))
        bench.drive.enable(bench.soon())
        bench.cycles(100)
        bench.world.clock.sleep_until(bench.soon())
        assert bench.servo.drive.power.state is not State.OPERATION_ENABLED
        with pytest.raises(PeerFault):
            bench.cycles(100)


def test_a_drive_that_answers_no_remote_frames_is_not_guarded_and_left_as_it_was() -> None:
    with lab(NO_CONSUMER, deaf=True) as bench:
        with pytest.raises(SettingRefused, match="no 1016h, and cannot be guarded"):
            bench.drive.configure(DriveSettings(CYCLE))
        assert (bench.held(0x100C), bench.held(0x100D)) == (30, 0)
        notes = bench.drive.configure(DriveSettings(CYCLE, unwatched=True))
        assert any("does not notice that the host is gone" in note for note in notes)
        assert bench.held(0x1017) == 50, "its own heartbeat goes on"
