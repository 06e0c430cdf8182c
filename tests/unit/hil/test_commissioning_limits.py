"""The host's limits around an exercise: each is crossed by a hair, and kept by a hair."""

import itertools
import math
from dataclasses import replace
from pathlib import Path
from typing import cast

import pytest

from servobench.drivers.errors import BadInput, BenchError, LimitExceeded
from servobench.drivers.exchange import Command
from servobench.drivers.timebase import NS_PER_S, Instant
from servobench.hil.commissioning.drive_port import DrivePort
from servobench.hil.commissioning.excitation import Pulse, SpeedGuide, TimedTorque
from servobench.hil.commissioning.exercise import (
    BLIND_MAX_S,
    EnergyMeter,
    Watched,
    speed_limits,
    torque_limits,
)
from servobench.hil.commissioning.identify import Mechanics
from servobench.hil.commissioning.request import (
    CommissionRequest,
    MotionLimits,
    Nameplate,
    load_nameplate,
    motion_limits,
)
from servobench.hil.loop.protocol import Context, Controller, SetPoint, TorqueSetPoint
from servobench.hil.loop.samples import StateEstimate
from tests.unit.hil.cycles import advance, torque_of

PERIOD_NS = 1_000_000
LIMITS = MotionLimits(
    torque_nm=1.0,
    torque_slew_nm_s=50.0,
    speed_rad_s=100.0,
    power_w=50.0,
    energy_j=5.0,
    acceleration_rad_s2=1000.0,
    travel_rad=10.0,
    following_rad=0.5,
)
SHAFT = Mechanics(1e-3, 1e-3, 0.05, 0.0, 0.0, 0.0, 0.0, 10, 0.0)


class Port:
    """Stands in for a drive in a position mode."""

    def __init__(self, commanded_rad: float | None = None) -> None:
        self.commanded_rad = commanded_rad


class Still(Controller):
    """A controller that asks for nothing."""

    def output(self, _context: Context) -> SetPoint:
        return TorqueSetPoint(0.0)


def watched(
    limits: MotionLimits = LIMITS, commanded_rad: float | None = None, energy: EnergyMeter | None = None
) -> Watched:
    return Watched(Still(), limits, cast(DrivePort, Port(commanded_rad)), energy or EnergyMeter())


def estimate(cycle: int, position_rad: float, torque_nm: float = 0.0) -> StateEstimate:
    return StateEstimate(position_rad, 0.0, torque_nm, Instant(cycle * PERIOD_NS), cycle)


def drive_along(watch: Watched, positions: list[float], torque_nm: float = 0.0) -> None:
    for cycle, position in enumerate(positions, start=1):
        torque_of(watch, estimate(cycle, position, torque_nm))


def test_travel() -> None:
    drive_along(watched(), [3.0 - 0.01 * k for k in range(1000)])
    with pytest.raises(LimitExceeded, match="turned"):
        drive_along(watched(), [3.0 - 0.01 * k for k in range(1010)])
    drive_along(watched(replace(LIMITS, travel_rad=math.inf)), [0.01 * k for k in range(2000)])


def test_speed_by_position() -> None:
    drive_along(watched(replace(LIMITS, travel_rad=math.inf)), [0.19 * k for k in range(20)])
    with pytest.raises(LimitExceeded, match="speed by position"):
        drive_along(watched(replace(LIMITS, travel_rad=math.inf)), [0.20 * k for k in range(20)])


def test_power_and_energy() -> None:
    drive_along(watched(), [0.06 * k for k in range(80)], torque_nm=1.0)
    with pytest.raises(LimitExceeded, match="power"):
        drive_along(watched(), [0.07 * k for k in range(80)], torque_nm=1.0)
    with pytest.raises(LimitExceeded, match="work"):
        drive_along(watched(), [0.06 * k for k in range(90)], torque_nm=-1.0)


@pytest.mark.parametrize(("step_rad", "kept"), [(0.06, True), (0.07, False)])
def test_the_power_of_a_drive_that_tells_no_torque_is_that_of_its_commands(
    step_rad: float, kept: bool
) -> None:
    watch = watched()

    def turn() -> None:
        for cycle in range(1, 60):
            silent = estimate(cycle, step_rad * cycle, math.nan)
            torque_of(watch, silent)
            advance(watch, silent, 1.0)

    if kept:
        turn()
        return
    with pytest.raises(LimitExceeded, match="power"):
        turn()


def test_before_a_drive_without_torque_was_commanded_it_has_done_no_work() -> None:
    energy = EnergyMeter()
    drive_along(watched(energy=energy), [0.0, 0.06], torque_nm=math.nan)
    assert energy.spent_j == 0.0


def test_a_drive_that_is_given_speeds_and_tells_no_torque_is_held_by_its_path() -> None:
    energy = EnergyMeter()
    watch = watched(energy=energy)
    for cycle in range(1, 20):
        silent = estimate(cycle, 0.06 * cycle, math.nan)
        torque_of(watch, silent)
        advance(watch, silent, math.nan)
    assert energy.spent_j == 0.0


def test_the_energy_of_a_step_is_that_of_all_its_exercises() -> None:
    step = EnergyMeter()
    drive_along(watched(energy=step), [0.06 * k for k in range(60)], torque_nm=1.0)
    assert step.spent_j == pytest.approx(0.06 * 59)
    with pytest.raises(LimitExceeded, match="work"):
        drive_along(watched(energy=step), [0.06 * k for k in range(60)], torque_nm=1.0)


def test_following_error() -> None:
    drive_along(watched(commanded_rad=1.0), [0.55, 0.56])
    with pytest.raises(LimitExceeded, match="following error"):
        drive_along(watched(commanded_rad=1.0), [0.45, 0.46])
    for position in (0.25, 1.75):
        with pytest.raises(LimitExceeded, match=r"following error: 0\.1194 turns .* limit of 0\.07958 turns"):
            drive_along(watched(commanded_rad=1.0), [position])


def test_the_inner_controller_is_asked_and_told() -> None:
    told = []

    class Noted(Still):
        def output(self, context: Context) -> SetPoint:
            return TorqueSetPoint(context.estimate.position_rad + context.reference_rad_s)

        def update(self, _context: Context, command: Command) -> None:
            told.append(command.torque_nm)

    watch = Watched(Noted(), LIMITS, cast(DrivePort, Port()), EnergyMeter())
    assert torque_of(watch, estimate(1, 0.25), 0.5) == 0.75
    advance(watch, estimate(1, 0.25), 0.125)
    assert told == [0.125]


def test_what_is_just_at_a_limit_is_allowed() -> None:
    """In binary fractions, that the limits are met exactly."""
    exact = replace(LIMITS, travel_rad=8.0, following_rad=0.5, energy_j=2.0, power_w=1e9)
    moved(8.0, NS_PER_S, 0.0, exact)
    with pytest.raises(LimitExceeded, match="turned"):
        moved(8.0078125, NS_PER_S, 0.0, exact)
    with pytest.raises(LimitExceeded, match="following"):
        drive_along(watched(exact, commanded_rad=1.0), [0.5, 0.4990234375])
    for position in (0.5, 1.5):
        drive_along(watched(exact, commanded_rad=1.0), [position])
    drive_along(watched(exact), [0.03125 * k for k in range(65)], torque_nm=1.0)
    with pytest.raises(LimitExceeded, match="work"):
        drive_along(watched(exact), [0.03125 * k for k in range(66)], torque_nm=1.0)


def moved(path_rad: float, passed_ns: int, torque_nm: float, limits: MotionLimits) -> None:
    """One move between two samples."""
    watch = watched(limits)
    torque_of(watch, StateEstimate(0.0, 0.0, torque_nm, Instant(1), 1))
    torque_of(watch, StateEstimate(path_rad, 0.0, torque_nm, Instant(1 + passed_ns), 2))


def test_power_and_speed_have_their_margins() -> None:
    """Of 1.3 for the power, and of 1.5 on top for the speed, whose positions are rounded."""
    limits = replace(LIMITS, energy_j=1e9, power_w=100.0, speed_rad_s=100.0, travel_rad=math.inf)
    second = NS_PER_S
    for sign in (1.0, -1.0):
        moved(sign * 130.0, second, 1.0, limits)
        with pytest.raises(LimitExceeded, match="power"):
            moved(sign * 130.1, second, 1.0, limits)
        with pytest.raises(LimitExceeded, match="power"):
            moved(130.1, second, sign * 1.0, limits)
        moved(sign * 194.9, second, 0.0, limits)
        with pytest.raises(LimitExceeded, match="speed by position"):
            moved(sign * 195.1, second, 0.0, limits)
    edge = 1.5 * 1.3 * 100.0
    moved(edge, second, 0.0, limits)


def test_a_small_path_is_no_speed() -> None:
    """A count or two of a coarse encoder in a microsecond."""
    moved(0.05, 1000, 0.0, LIMITS)
    with pytest.raises(LimitExceeded, match="speed by position"):
        moved(-0.051, 1000, 0.0, LIMITS)


def test_samples_without_time_between_them_are_no_speed_and_no_power() -> None:
    for passed_ns in (0, -1000):
        moved(1.0, passed_ns, 1.0, replace(LIMITS, power_w=0.5))
    with pytest.raises(LimitExceeded, match="speed by position"):
        moved(1.0, 1, 0.0, LIMITS)


def test_a_sample_is_counted_once() -> None:
    """A cycle without a new reading is estimated by the last one."""
    energy = EnergyMeter()
    watch = watched(replace(LIMITS, power_w=1e9), energy=energy)
    for cycle, position in ((1, 0.0), (2, 0.03125), (2, 0.5), (3, 0.5625)):
        torque_of(watch, estimate(cycle, position, 1.0))
    assert energy.spent_j == 0.03125 + 0.0625


def test_nothing_is_judged_before_the_first_sample() -> None:
    watch = watched()
    torque_of(watch, StateEstimate(1e9, 0.0, 0.0, Instant(0), 0))
    drive_along(watch, [5.0, 5.0])


def test_limits_come_from_the_nameplate_and_are_cautious_without_one() -> None:
    found = motion_limits(Nameplate(), 2.0, 3000.0)
    assert found.speed_rad_s == pytest.approx(0.5 * 3000.0 * math.tau / 60.0)
    assert found.torque_nm == pytest.approx(1.0)
    assert found.travel_rad == math.inf
    told = Nameplate.model_validate(
        {"rating": {"speed_rpm": 1000.0}, "limits": {"torque_max_percent": 10.0, "turns_max": 2.0}}
    )
    found = motion_limits(told, 2.0, 3000.0)
    assert found.speed_rad_s == pytest.approx(500.0 * math.tau / 60.0)
    assert found.torque_nm == pytest.approx(0.2)
    assert found.travel_rad == pytest.approx(2.0 * math.tau)


def test_every_limit_that_the_nameplate_sets_and_each_default() -> None:
    found = motion_limits(Nameplate(), 2.0, 3000.0)
    speed = 0.5 * 3000.0 * math.tau / 60.0
    assert found.torque_slew_nm_s == pytest.approx(100.0), "the rated torque in 20 ms"
    assert found.power_w == pytest.approx(2.0 * speed)
    assert found.energy_j == pytest.approx(3.0 * 2.0 * speed)
    assert found.following_rad == pytest.approx(math.pi)
    assert Nameplate().limits.temperature_max_c == 80.0
    limits = {
        "speed_max_rpm": 60.0,
        "power_max_w": 7.0,
        "energy_max_j": 8.0,
        "following_error_max_turns": 2.0,
    }
    found = motion_limits(Nameplate.model_validate({"limits": limits}), 2.0, None)
    assert found.speed_rad_s == pytest.approx(math.tau)
    assert (found.power_w, found.energy_j) == (7.0, 8.0)
    assert found.following_rad == pytest.approx(2.0 * math.tau)


def test_the_nameplate_s_speed_comes_before_the_drive_s_and_1000_rpm_before_none() -> None:
    told = Nameplate.model_validate({"rating": {"speed_rpm": 600.0}})
    assert motion_limits(told, 2.0, 3000.0).speed_rad_s == pytest.approx(10.0 * math.pi)
    assert motion_limits(Nameplate(), 2.0, None).speed_rad_s == pytest.approx(500.0 * math.tau / 60.0)


@pytest.mark.parametrize(
    "key",
    ["torque_max_percent", "power_max_w", "energy_max_j", "turns_max", "following_error_max_turns",
     "temperature_max_c"],
)  # fmt: skip
def test_a_limit_of_nothing_or_less_is_refused(key: str) -> None:
    for value in (0.0, -1.0):
        with pytest.raises(ValueError, match=key):
            Nameplate.model_validate({"limits": {key: value}})
    assert Nameplate.model_validate({"limits": {key: 0.5}})


def test_three_times_the_rated_torque_is_the_most() -> None:
    assert Nameplate.model_validate({"limits": {"torque_max_percent": 300.0}})
    with pytest.raises(ValueError, match="torque_max_percent"):
        Nameplate.model_validate({"limits": {"torque_max_percent": 301.0}})


@pytest.mark.parametrize(("timeout_ms", "heartbeat_ms"), [(150, 50), (3, 1), (1, 1), (100, 33)])
def test_three_heartbeats_fit_into_their_time_out(timeout_ms: int, heartbeat_ms: int) -> None:
    request = CommissionRequest("hub:x", 1, Path("out"), heartbeat_timeout_ms=timeout_ms)
    assert request.heartbeat_ms == heartbeat_ms


def test_a_nameplate_with_a_wrong_key_is_refused_with_its_name(tmp_path: Path) -> None:
    path = tmp_path / "plate.toml"
    path.write_text("[rating]\ntorque_mnm = 200\n")
    with pytest.raises(BenchError, match=r"rating\.torque_mnm") as caught:
        load_nameplate(path)
    assert caught.value.exit_status == 2
    with pytest.raises(BadInput, match="--motor"):
        load_nameplate(tmp_path / "absent.toml")


@pytest.mark.parametrize("guard_speed", [True, False])
def test_each_quantity_has_its_own_limits(guard_speed: bool) -> None:
    shaft = pytest.approx(130.0) if guard_speed else math.inf
    blind = round(BLIND_MAX_S / 1e-3)
    torques = torque_limits(LIMITS, 1e-3, guard_speed)
    assert (torques.torque_max_nm, torques.torque_slew_max_nm_s) == (1.0, 50.0)
    assert (torques.speed_max_rad_s, torques.dropouts_consecutive_max) == (shaft, blind)
    speeds = speed_limits(LIMITS, 1e-3, guard_speed)
    assert (speeds.set_point_max_rad_s, speeds.acceleration_max_rad_s2) == (100.0, 1000.0)
    assert (speeds.speed_max_rad_s, speeds.dropouts_consecutive_max) == (shaft, blind)


# ---- what excites the shaft -------------------------------------------------------------------------------


def test_a_pulse_rises_slowly_holds_and_ends_at_rest() -> None:
    pulse = Pulse(1.0, 1.0, near_rad=0.02, far_rad=0.3, period_s=1e-3)
    position = speed = 0.0
    torques = []
    for cycle in range(1, 4000):
        torque = torque_of(pulse, estimate(cycle, position))
        torques.append(torque)
        drive = torque - math.copysign(0.2, speed) if speed else max(0.0, torque - 0.2)
        stops = speed > 0.0 and torque < 0.2 and speed + drive * 1.0 < 0.0
        speed = 0.0 if stops else speed + drive * 1.0
        position += speed * 1e-3
        if pulse.done():
            break
    assert pulse.moved
    assert pulse.done()
    assert max(b - a for a, b in itertools.pairwise(torques)) <= 1e-3 + 1e-12, "by ramp only"
    assert max(torques) < 0.5, "no more than it takes"
    assert torques[-1] == 0.0


def test_a_pulse_gives_up_at_its_peak() -> None:
    pulse = Pulse(-0.3, 1.0, near_rad=0.02, far_rad=0.3, period_s=1e-3)
    torques = [torque_of(pulse, estimate(cycle, 1.0)) for cycle in range(1, 1000)]
    assert min(torques) == pytest.approx(-0.301, abs=2e-3)
    assert not pulse.moved
    assert pulse.done()


def test_a_guide_lets_the_shaft_coast_without_a_jolt_afterwards() -> None:
    guide = SpeedGuide(SHAFT, 1e-3, free=lambda time: 0.01 <= time < 0.02)
    torques = []
    for cycle in range(1, 31):
        now = StateEstimate(0.0, 20.0, 0.0, Instant(cycle * PERIOD_NS), cycle)
        torque = torque_of(guide, now, 20.0 if cycle <= 15 else 0.0)
        advance(guide, now, torque)
        torques.append(torque)
    assert torques[10:20] == [0.0] * 10
    assert abs(torques[20]) < 1.5 * SHAFT.inertia_kg_m2 * 40.0 * 20.0, "the reference jumped meanwhile"


def test_a_profile_follows_its_own_cycles() -> None:
    profile = TimedTorque(lambda time: 2.0 * time, 1e-3)
    for cycle in range(5):
        assert torque_of(profile, estimate(1, 0.0)) == pytest.approx(2e-3 * cycle)
        advance(profile, estimate(1, 0.0), 0.0)
