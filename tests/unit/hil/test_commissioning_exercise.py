"""An exercise of commissioning: the limits that its axis gets, and what is done around its cycles."""

import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import pytest

from servobench.drivers.errors import LimitExceeded
from servobench.drivers.exchange import Command, SentCommand, SpeedCommand
from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.drivers.wire.frame_port import EchoBasis
from servobench.hil.commissioning import exercise
from servobench.hil.commissioning.exercise import EnergyMeter, Exerciser, speed_limits, torque_limits
from servobench.hil.commissioning.request import Nameplate, motion_limits
from servobench.hil.execution.drive_session import DriveSession
from servobench.hil.loop.pace import CALIBRATION_SYNCS
from servobench.hil.loop.protocol import Context, Controller, SetPoint, TorqueSetPoint
from servobench.hil.loop.safety import SafetyGuard
from servobench.hil.loop.scenario import LevelStep, Quantity
from servobench.hil.loop.syncs import SyncLog
from servobench.hil.machine.stopping import Interrupted
from tests.unit.hil.loop_fakes import PERIOD, SYNC_LATENCY, TIMING, FakeBus, FakeDrive

LIMITS = motion_limits(Nameplate(), 2.0, 3000.0)
"""1 N m, which is half of the rated torque; 100 N m/s."""


class Asked(Controller):
    """A controller that asks for the same in each cycle."""

    def __init__(self, torque_nm: float = 0.0) -> None:
        self.torque_nm = torque_nm
        self.references: list[float] = []

    def output(self, context: Context) -> SetPoint:
        self.references.append(context.reference_rad_s)
        return TorqueSetPoint(self.torque_nm)


class Port(FakeDrive):
    """A drive as an exercise sees it, which notes what it is asked for."""

    def __init__(self, notes: list[str], quantity: Quantity = Quantity.TORQUE) -> None:
        super().__init__(lambda _sequence: 250_000)
        self.drive = SimpleNamespace(name="drive", rated_torque_nm=1.0)
        self.quantity = quantity
        self.commanded_rad: float | None = None
        self.speeds: list[float] = []
        self._notes = notes

    def begin(self) -> None:
        self._notes.append("begin")

    def end(self) -> None:
        self._notes.append("end")

    def take_readings(self) -> list[Any]:
        self._notes.append("take readings")
        return super().take_readings()

    def write(self, command: Command) -> SentCommand | None:
        self._notes.append("command")
        if isinstance(command, SpeedCommand):
            self.speeds.append(command.speed_rad_s)
            return None
        return super().write(command)


class Bench:
    """An exerciser on a made-up bus."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, quantity: Quantity = Quantity.TORQUE) -> None:
        self.notes: list[str] = []
        self.port = Port(self.notes, quantity)
        self.bus = FakeBus([self.port])
        self.stop_asked = False
        log = SyncLog(SYNC_LATENCY, PERIOD, EchoBasis.BUS)
        self.bus.on_sync_echo = log.came
        monkeypatch.setattr(exercise, "sync_log", lambda *_: log)
        self._note(monkeypatch, self.bus, "send_sync", "SYNC")
        network = SimpleNamespace(frame_pump=self.bus, clock=self.bus, pump=self._settle)
        drives: Any = DriveSession.__new__(DriveSession)
        drives._world = SimpleNamespace(clock=self.bus)
        drives.guard = SimpleNamespace(
            attending=lambda _chore: self._attend,
            arm=lambda _syncs, period, *_: self.notes.append(f"arm, {period} ns"),
            calm=lambda: self.notes.append("calm"),
        )
        self.exerciser = Exerciser(
            cast(Any, network), cast(Any, self.port), TIMING, LIMITS, lambda: self.stop_asked,
            self._check_stop, EnergyMeter(), drives,
        )  # fmt: skip

    def _note(self, monkeypatch: pytest.MonkeyPatch, owner: object, name: str, text: str) -> None:
        inner: Callable[..., Any] = getattr(owner, name)

        def noted(*arguments: Any) -> Any:
            self.notes.append(text)
            return inner(*arguments)

        monkeypatch.setattr(owner, name, noted)

    def _attend(self, now: Instant) -> Instant:
        self.notes.append("attend")
        return now

    def _settle(self, until: Instant) -> None:
        self.notes.append(f"wait {(until - self.bus.now()) / NS_PER_MS:g} ms")
        self.bus.pump(until)

    def _check_stop(self) -> None:
        self.notes.append("check stop")
        if self.stop_asked:
            raise Interrupted("ended by a test")


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Bench:
    return Bench(monkeypatch)


def test_the_torque_is_held_within_its_limit_and_slope() -> None:
    guard = SafetyGuard(torque_limits(LIMITS, 1e-3, True), 1e-3)
    asked = [guard.limit(50.0) for _ in range(12)]
    assert asked == pytest.approx([min(1.0, 0.1 * k) for k in range(1, 13)])
    assert [guard.limit(-50.0) for _ in range(21)][-1] == -1.0


def test_a_speed_set_point_is_held_within_the_speed_limit_and_a_tenth_of_a_second_s_slope() -> None:
    guard = SafetyGuard(speed_limits(LIMITS, 1e-3, True), 1e-3)
    asked = [guard.limit(1e6) for _ in range(120)]
    assert asked[0] == pytest.approx(LIMITS.speed_rad_s / 100.0)
    assert asked[-1] == LIMITS.speed_rad_s


def test_the_shaft_may_overshoot_its_speed_by_three_tenths() -> None:
    for limits_of in (torque_limits, speed_limits):
        guard = SafetyGuard(limits_of(LIMITS, 1e-3, True), 1e-3)
        for sign in (1.0, -1.0):
            assert guard.check_speed(sign * 1.299 * LIMITS.speed_rad_s) is None
            assert guard.check_speed(sign * 1.301 * LIMITS.speed_rad_s) is not None
        unguarded = SafetyGuard(limits_of(LIMITS, 1e-3, False), 1e-3)
        assert unguarded.check_speed(1e9) is None, "the unit of the speed is not known to be right"


@pytest.mark.parametrize(("period_ms", "borne"), [(1, 100), (2, 50), (20, 10)])
def test_a_tenth_of_a_second_without_reading_is_borne_or_ten_cycles(period_ms: int, borne: int) -> None:
    guard = SafetyGuard(torque_limits(LIMITS, 1e-3 * period_ms, True), 1e-3 * period_ms)
    assert [guard.miss_cycle() for _ in range(borne)] == [None] * borne
    assert guard.miss_cycle() is not None


def test_readings_of_before_are_let_go_and_the_bus_is_guarded_while_it_runs(bench: Bench) -> None:
    bench.exerciser.run(Asked(), 0.01)
    notes = bench.notes
    assert notes[:4] == ["wait 3 ms", "take readings", "begin", "arm, 1000000 ns"]
    assert notes.index("SYNC") > 3
    assert notes.count("SYNC") == CALIBRATION_SYNCS + 10
    assert "command" not in notes[: notes.index("SYNC")]
    assert notes.count("attend") == 10
    assert notes[-2:] == ["calm", "check stop"]


def test_the_clock_of_the_drive_is_learnt_before_the_first_command(bench: Bench) -> None:
    recording = bench.exerciser.run(Asked(0.5), 0.02, [LevelStep(0.01, 3.0)])
    assert bench.notes[: bench.notes.index("command")].count("SYNC") == CALIBRATION_SYNCS + 1
    assert recording.cycles == 20
    sent = [command.torque_nm for command in bench.port.commands]
    assert sent[:6] == pytest.approx([0.1, 0.2, 0.3, 0.4, 0.5, 0.5])


def test_speeds_follow_their_reference_for_the_whole_time(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, Quantity.SPEED)
    recording = bench.exerciser.run_speeds(0.02, [LevelStep(0.01, 0.5)])
    assert recording.cycles == 20
    assert (bench.port.speeds[:9], bench.port.speeds[-9:]) == ([0.0] * 9, [0.5] * 9)
    assert bench.port.commands == [], "and no torque"


def test_a_reference_reaches_the_controller(bench: Bench) -> None:
    controller = Asked()
    bench.exerciser.run(controller, 0.02, [LevelStep(0.01, 3.0)])
    assert controller.references[:9] == [0.0] * 9
    assert controller.references[-9:] == [3.0] * 9
    assert len(controller.references) == 20


def test_the_speed_is_guarded_unless_its_unit_is_unknown(bench: Bench) -> None:
    bench.port.velocity_rad_s = 2.0 * LIMITS.speed_rad_s
    bench.exerciser.run(Asked(), 0.01, guard_speed=False)
    with pytest.raises(LimitExceeded, match="speed"):
        bench.exerciser.run(Asked(), 0.01)


def test_it_ends_when_its_controller_is_done(bench: Bench) -> None:
    left = iter(range(1000))
    recording = bench.exerciser.run(Asked(), 1.0, done=lambda: next(left) >= 7)
    assert recording.cycles == 7


def test_a_stop_request_ends_it_and_is_passed_on(bench: Bench) -> None:
    bench.stop_asked = True
    with pytest.raises(Interrupted, match="ended by a test"):
        bench.exerciser.run(Asked(), 1.0)
    assert "command" not in bench.notes


def test_the_readings_are_told_in_the_units_of_the_loop(bench: Bench) -> None:
    bench.port.velocity_rad_s = 2.0
    recording = bench.exerciser.run(Asked(), 0.01)
    assert set(recording.velocity) == {2.0}
    assert math.isclose(recording.time[1] - recording.time[0], 1e-3, rel_tol=1e-6)
