"""What a fault plan breaks in a drive and its machine, beside closed forms; and what the drive then does."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from servobench import run
from servobench.design.mechanism import Coupling, Mechanism
from servobench.design.motor import Heat
from servobench.drivers.errors import DriveInFault
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Instant
from servobench.hil.configuration.bench_file import Bench
from servobench.virtual_bus.drive.firmware import Firmware, FirmwareParameters, InnerControl
from servobench.virtual_bus.drive.power_stage import Chopper, Protection, Supply, Trip
from tests.motors import LING
from tests.oracle.test_power_stage import HEAVY, RESISTOR_TABLE, SUPPLY, stopped
from tests.scenario.processes import EXAMPLES

FREE = replace(LING, viscous_friction_nm_s=0.0, coulomb_friction_nm=0.0)
J = FREE.inertia_kg_m2
RATED_RAD_S = 157.08


def turning(
    motor: Any = FREE, speed_rad_s: float = 0.0, **parameters: Any
) -> tuple[Firmware, Callable[[float], None]]:
    """A drive whose shaft turns; and what brings it to a time, s."""
    firmware = Firmware(motor, FirmwareParameters(**{"brake_torque_nm": 0.0, **parameters}))
    firmware.start(Instant(0))
    firmware.inner.speed_rad_s = firmware.inner.load_speed_rad_s = speed_rad_s

    def go_to(time_s: float) -> None:
        firmware.advance_to(Instant(round(time_s * NS_PER_S)))

    return firmware, go_to


def test_a_dragging_brake_takes_the_speed_evenly_and_then_holds() -> None:
    firmware, go_to = turning(speed_rad_s=100.0)
    firmware.damage.drag_brake(0.5)
    go_to(0.1)
    assert firmware.inner.speed_rad_s == pytest.approx(100.0 - 0.5 / J * 0.1, rel=1e-9)
    firmware.inner.load_nm = -0.4
    go_to(2.0)
    assert firmware.inner.speed_rad_s == 0.0, "a load below its torque is held"
    firmware.damage.drag_brake(0.0)
    go_to(2.1)
    assert firmware.inner.speed_rad_s == pytest.approx(0.4 / J * 0.1, rel=1e-3)


@pytest.mark.parametrize(("share", "play_rad"), [(1.0, 0.0), (0.25, 0.0), (0.04, 0.0), (1.0, 0.02)])
def test_a_loose_coupling_swings_as_slowly_as_its_stiffness_and_play_say(
    share: float, play_rad: float
) -> None:
    """Without play at sqrt(k (1/J_m + 1/J_l)); with it both masses fly through the play twice a period."""
    coupling = Coupling(0.25 * J, 0.75 * J, 500.0, 0.0)
    firmware, go_to = turning(replace(FREE, mechanism=Mechanism(coupling=coupling)))
    inner = firmware.inner
    firmware.damage.loosen_coupling(share, play_rad)
    inner.load_speed_rad_s, inner.speed_rad_s = 1.0, -3.0  # no speed of both together; 4 rad/s of the twist
    spring_s = math.tau / math.sqrt(share * 500.0 / (0.25 * 0.75 * J))
    # From the middle of the play, where the twist's speed is its largest, w A.
    period_s = spring_s + 2.0 * play_rad / 4.0
    crossings, before, step_s = [], inner.twist_rad, 1.0 / inner.rate_hz
    for tick in range(1, round(12.0 * period_s / step_s)):
        go_to(tick * step_s + 1e-9)
        if before < 0.0 <= inner.twist_rad:
            crossings.append((tick - inner.twist_rad / (inner.twist_rad - before)) * step_s)
        before = inner.twist_rad
    found_s = (crossings[-1] - crossings[0]) / (len(crossings) - 1)
    assert found_s == pytest.approx(period_s, rel=1e-3)


@pytest.mark.parametrize("speed_rad_s", [3.0, -250.0])
def test_a_dirty_encoder_loses_the_counts_of_its_dirt_and_no_other(speed_rad_s: float) -> None:
    firmware, go_to = turning(speed_rad_s=speed_rad_s)
    go_to(0.1)
    firmware.damage.soil_encoder(0.25, 0.30)
    seconds = 7.0 * math.tau / abs(speed_rad_s)
    go_to(0.1 + seconds)
    firmware.damage.soil_encoder(0.0, 0.0)
    inner = firmware.inner

    def passed(turns: float) -> float:
        return math.floor(turns) * 0.05 + min(max(turns - math.floor(turns) - 0.25, 0.0), 0.05)

    ends = [speed_rad_s * time_s / math.tau for time_s in (0.1, 0.1 + seconds)]
    lost = 65_536 * (passed(ends[1]) - passed(ends[0]))
    tick = 65_536 * abs(speed_rad_s) / inner.rate_hz / math.tau
    assert abs(inner.counts_lost) == pytest.approx(7 * 0.05 * 65_536, abs=3)
    assert inner.counts_lost == pytest.approx(lost, abs=tick + 3)
    go_to(2.0 + seconds)
    true = math.floor((inner.turns + inner.angle_rad / math.tau) * 65_536)
    assert true - inner.count == inner.counts_lost, "clean again: nothing more is lost, nothing comes back"


def test_a_hot_winding_takes_more_from_the_source_and_hot_magnets_make_less_torque() -> None:
    """IEC 60034-1: (235 + 150) / (235 + 20) of the resistance; the flux falls by 0.12 % a kelvin."""
    heats: dict[bool, float] = {}
    speeds: dict[bool, float] = {}
    for hot in (False, True):
        for brake_nm in (0.0, 100.0):
            supply = Supply(LING.dc_bus_voltage_v, 0.5, 1e-3, feeds_back=True)
            held: dict[str, Any] = {
                "supply": supply,
                "brake_torque_nm": brake_nm,
                "brake_open_s": 10.0 if brake_nm else 0.0,
            }
            firmware, go_to = turning(replace(FREE, inertia_kg_m2=1.0), **held)
            go_to(0.01)
            if hot:
                firmware.damage.heat_motor((235.0 + 150.0) / 255.0, 1.0 - 0.0012 * 80.0, 150.0)
            firmware.control(InnerControl.TORQUE)
            firmware.demand_torque(2.0)
            go_to(0.1)
            begun_j, begun_rad_s = firmware.inner.supplied_j, firmware.inner.speed_rad_s
            go_to(1.1)
            if brake_nm:
                heats[hot] = firmware.inner.supplied_j - begun_j
            else:
                speeds[hot] = firmware.inner.speed_rad_s - begun_rad_s
            assert firmware.inner.torque_measured_nm == pytest.approx(2.0, rel=1e-3), "as the drive believes"
    assert heats[True] / heats[False] == pytest.approx(385.0 / 255.0, rel=1e-3)
    assert speeds[False] == pytest.approx(2.0, rel=2e-3)
    assert speeds[True] / speeds[False] == pytest.approx(1.0 - 0.0012 * 80.0, rel=1e-3)


def test_without_its_resistor_a_link_takes_all_that_braking_returns() -> None:
    motor = replace(HEAVY, resistance_ohm=1e-6, viscous_friction_nm_s=0.0, coulomb_friction_nm=0.0)
    supply = Supply(300.0, 0.5, 1e-3, chopper=Chopper(40.0, on_v=380.0, off_v=360.0))
    firmware, go_to = turning(motor, supply=supply)
    firmware.damage.open_chopper(True)
    firmware.control(InnerControl.SPEED)
    firmware.ramp_to_speed(RATED_RAD_S, 300.0)
    go_to(0.7)
    firmware.ramp_to_speed(0.0, 300.0)
    shaft_j = 0.5 * motor.inertia_kg_m2 * RATED_RAD_S**2
    peak_v = 0.0
    for millisecond in range(700, 1800):
        go_to(millisecond / 1000.0)
        peak_v = max(peak_v, firmware.inner.link_v)
    assert peak_v == pytest.approx(math.sqrt(300.0**2 + 2.0 * shaft_j / 1e-3), rel=1e-3)
    assert firmware.inner.chopped_j == 0.0
    firmware.damage.open_chopper(False)
    go_to(2.5)
    assert firmware.inner.link_v <= 360.0


@pytest.mark.parametrize(("winding_c", "trip"), [(139.0, Trip.NONE), (141.0, Trip.MOTOR_HOT)])
def test_a_sensor_tells_the_winding_of_the_file_and_again_after_a_fault(winding_c: float, trip: Trip) -> None:
    motor = replace(LING, heat=Heat(1.4, 0.95, winding_c))
    firmware = Firmware(motor, FirmwareParameters(protection=Protection(winding_max_c=140.0)))
    firmware.start(Instant(0))
    firmware.advance_to(Instant(10 * NS_PER_MS))
    assert firmware.inner.trip == trip
    firmware.damage.heat_motor(1.2, 0.9, 139.5)
    firmware.damage.heat_motor(1.0, 1.0)
    assert firmware.inner.winding_c == winding_c


CHOPPED = {"supply": {**SUPPLY, "chopper": RESISTOR_TABLE}, "protection": {"over_voltage_v": 400.0}}


def constant(like: dict[str, Any], plan: dict[str, Any]) -> Bench:
    bench = Bench.load(EXAMPLES / "ling2012.toml")
    return bench.changed({"faults": plan, "verdict": {}, "drive.axis1.simulation.like": like})


@pytest.mark.parametrize(
    ("bench", "code"),
    [
        (stopped(CHOPPED).changed({"faults": {"chopper_off": [{"at_s": 1.0, "duration_s": 9.0}]}}), "3210h"),
        (
            constant(
                {"protection": {"winding_max_c": 140.0}},
                {"hot_motor": [{"at_s": 0.6, "duration_s": 0.1, "winding_c": 150.0, "magnet_c": 100.0}]},
            ),
            "4310h",
        ),
        (
            constant(
                {"protection": {"missing_counts_max": 50}},
                {"dirty_encoder": [{"at_s": 0.6, "duration_s": 9.0, "from_deg": 90.0, "to_deg": 90.5}]},
            ),
            "7305h",
        ),
    ],
    ids=["chopper_off", "hot_motor", "dirty_encoder"],
)
def test_the_drives_own_protection_finds_it(bench: Bench, code: str) -> None:
    with pytest.raises(DriveInFault, match=code):
        run(bench)


def test_a_protection_that_is_wide_enough_lets_it_pass() -> None:
    like = {"protection": {"winding_max_c": 155.0, "missing_counts_max": 200}}
    plan = {
        "hot_motor": [{"at_s": 0.6, "duration_s": 0.1, "winding_c": 150.0, "magnet_c": 100.0}],
        "dirty_encoder": [{"at_s": 0.6, "duration_s": 0.1, "from_deg": 90.0, "to_deg": 90.5}],
    }
    assert run(constant(like, plan)).verdict.completed


@pytest.mark.parametrize("torque_nm", [0.05, 0.35])
def test_a_plan_brakes_and_heats_by_its_figures(torque_nm: float) -> None:
    """At a steady speed a drag asks for its own torque more, and weaker magnets for more of the whole."""
    plan = {
        "dragging_brake": [{"at_s": 1.3, "duration_s": 0.3, "torque_nm": torque_nm}],
        "hot_motor": [{"at_s": 2.0, "duration_s": 0.3, "winding_c": 140.0, "magnet_c": 100.0}],
    }
    table = run(constant({}, plan).changed({"bench.duration_s": 2.6})).table
    at_s = np.asarray(table["sampled_at"]) / NS_PER_S
    told_nm = np.asarray(table["torque_nm"])

    def mean_nm(begin_s: float, end_s: float) -> float:
        return float(np.nanmean(told_nm[(begin_s <= at_s) & (at_s < end_s)]))

    free_nm = mean_nm(1.2, 1.3)
    assert mean_nm(1.5, 1.6) - free_nm == pytest.approx(torque_nm, abs=0.01)
    assert mean_nm(1.9, 2.0) == pytest.approx(free_nm, abs=0.01)
    assert mean_nm(2.2, 2.3) * (1.0 - 0.0012 * 80.0) == pytest.approx(free_nm, rel=0.01)
    assert mean_nm(2.5, 2.6) == pytest.approx(free_nm, abs=0.01)
