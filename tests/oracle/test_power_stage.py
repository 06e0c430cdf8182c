"""The simulated drive's DC link and protection beside closed forms and the balance of energy."""

import math
from dataclasses import replace

import pytest

from servobench import run
from servobench.design.motor import PmsmParameters
from servobench.drivers.cia402.profile import State, Status
from servobench.drivers.errors import DriveInFault
from servobench.drivers.timebase import NS_PER_S, Instant
from servobench.hil.configuration.bench_file import Bench
from servobench.hil.configuration.motor_file import LING2012
from servobench.virtual_bus.drive.firmware import Firmware, FirmwareParameters, InnerControl
from servobench.virtual_bus.drive.power_stage import Chopper, Overload, Protection, StageHeat, Supply, Trip
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from tests.scenario.processes import EXAMPLES
from tests.unit.virtual_bus.servo_bench import ENABLE, ServoBench

RESISTOR = Chopper(40.0, on_v=380.0, off_v=360.0)
HEAVY = replace(LING2012.parameters, inertia_kg_m2=11 * LING2012.parameters.inertia_kg_m2)
LOSSLESS = replace(HEAVY, resistance_ohm=1e-6, viscous_friction_nm_s=0.0, coulomb_friction_nm=0.0)
RATED_RAD_S = 157.08


def started(motor: PmsmParameters, supply: Supply | None, protection: Protection | None = None) -> Firmware:
    firmware = Firmware(motor, FirmwareParameters(supply=supply, protection=protection))
    firmware.start(Instant(0))
    return firmware


def at(firmware: Firmware, time_s: float) -> None:
    firmware.advance_to(Instant(round(time_s * NS_PER_S)))


def stored_j(firmware: Firmware, motor: PmsmParameters, capacitance_f: float) -> float:
    """Shaft, windings and capacitor."""
    inner = firmware.inner
    field_j = motor.inductance_d_h * inner.current_d_a**2 + motor.inductance_q_h * inner.current_q_a**2
    shaft_j = motor.inertia_kg_m2 * inner.speed_rad_s**2
    return 0.5 * (shaft_j + motor.torque_factor * field_j + capacitance_f * inner.link_v**2)


@pytest.mark.parametrize(("ohm", "farad"), [(0.1, 1e-3), (0.5, 1e-3), (0.05, 2e-4), (5.0, 4.7e-3)])
def test_a_dip_and_its_end_charge_the_link_as_a_resistor_does(ohm: float, farad: float) -> None:
    firmware = started(LING2012.parameters, Supply(300.0, ohm, farad, feeds_back=True))
    at(firmware, 0.01)
    inner = firmware.inner
    inner.source_v = 150.0
    begun_s = inner.ticks / inner.rate_hz
    for part in (0.5, 1.0, 3.0):
        at(firmware, begun_s + part * ohm * farad + 1e-9)
        passed_s = inner.ticks / inner.rate_hz - begun_s
        told_v = 150.0 + 150.0 * math.exp(-passed_s / (ohm * farad))
        assert inner.link_v == pytest.approx(told_v, rel=3e-4)


def test_a_rectifier_blocks_and_what_the_logic_takes_empties_the_capacitor() -> None:
    firmware = started(LING2012.parameters, Supply(300.0, 0.5, 1e-3, idle_w=10.0))
    firmware.inner.source_v = 0.0
    at(firmware, 2.0)
    assert firmware.inner.link_v == pytest.approx(math.sqrt(300.0**2 - 2.0 * 10.0 * 2.0 / 1e-3), rel=1e-9)
    assert firmware.inner.supplied_j == 0.0


@pytest.mark.parametrize("chopper", [None, RESISTOR])
def test_no_energy_is_made_or_lost_from_source_to_shaft(chopper: Chopper | None) -> None:
    farad = 1e-3
    firmware = started(LOSSLESS, Supply(300.0, 0.5, farad, chopper=chopper))
    inner = firmware.inner
    firmware.control(InnerControl.SPEED)
    begun_j = stored_j(firmware, LOSSLESS, farad)
    peak_v = 0.0
    for target_rad_s, milliseconds in ((RATED_RAD_S, range(700)), (0.0, range(700, 1800))):
        firmware.ramp_to_speed(target_rad_s, 300.0)
        for millisecond in milliseconds:
            at(firmware, millisecond / 1000.0)
            peak_v = max(peak_v, inner.link_v)
            balance_j = stored_j(firmware, LOSSLESS, farad) + inner.chopped_j - inner.supplied_j - begun_j
            assert abs(balance_j) < 1e-4 * 0.5 * LOSSLESS.inertia_kg_m2 * RATED_RAD_S**2
    if chopper is None:  # all of the shaft's energy is in the capacitor
        shaft_j = 0.5 * LOSSLESS.inertia_kg_m2 * RATED_RAD_S**2
        assert peak_v == pytest.approx(math.sqrt(300.0**2 + 2.0 * shaft_j / farad), rel=1e-3)
    else:
        assert 379.0 <= peak_v < 381.0, "seen each millisecond"
        assert inner.chopped_j > 80.0


@pytest.mark.parametrize("trips", [False, True])
def test_an_overload_lasts_as_long_as_its_square_allows(trips: bool) -> None:
    motor = replace(LING2012.parameters, inertia_kg_m2=10.0)  # hardly turns meanwhile
    overload = Overload(2.0, 6.0, peak_time_s=0.5, trips=trips)
    firmware = started(motor, None, Protection(overload=overload))
    inner = firmware.inner
    amperes = 4.0 * math.sqrt(3.0)  # 4 A rms in the power-invariant transform
    firmware.control(InnerControl.TORQUE)
    firmware.demand_torque(motor.torque_constant_nm_a * amperes)
    full_s = 0.5 * (6.0**2 - 2.0**2) / (4.0**2 - 2.0**2)
    at(firmware, 0.78 * full_s)
    assert not inner.warning
    at(firmware, 0.82 * full_s)
    assert inner.warning
    assert not inner.limiting
    at(firmware, 0.998 * full_s)
    assert inner.current_q_a == pytest.approx(amperes, rel=1e-3)
    at(firmware, 1.003 * full_s)
    assert inner.trip == (Trip.OVERLOAD if trips else Trip.NONE)
    at(firmware, 1.1 * full_s)
    assert inner.current_q_a == pytest.approx(2.0 * math.sqrt(3.0), rel=1e-3)
    firmware.demand_torque(0.0)
    at(firmware, 1.1 * full_s + 0.2 * 0.5 * 32.0 / 4.0 + 0.02)  # down to clear_percent at 2^2 A^2
    firmware.demand_torque(motor.torque_constant_nm_a * amperes)
    at(firmware, 1.1 * full_s + 0.2 * 0.5 * 32.0 / 4.0 + 0.03)
    assert inner.current_q_a == pytest.approx(amperes, rel=1e-3), "free again"


def stopped(like: dict[str, object]) -> Bench:
    """A shaft of eleven times the inertia, brought from 1500 r/min to rest by its quick stop ramp."""
    bench = Bench.load(EXAMPLES / "ling2012.toml")
    return bench.changed(
        {
            "drive.axis1.motor.mechanics.inertia_kg_m2": HEAVY.inertia_kg_m2,
            "drive.axis1.controller": {
                "kind": "pid",
                "proportional_nm_s_rad": 1.0,
                "integral_nm_rad": 5.0,
            },
            "reference.axis1": [
                {"at_s": 0.2, "kind": "ramp", "speed_rpm": 1500.0, "over_s": 0.7},
                {"at_s": 1.1, "kind": "ramp", "speed_rpm": 0.0, "over_s": 0.7},
            ],
            "load": {},
            "faults": {},
            "verdict": {},
            "drive.axis1.simulation.like": like,
        }
    )


SUPPLY = {"voltage_v": 300.0, "resistance_ohm": 0.5, "capacitance_uf": 1000.0}
RESISTOR_TABLE = {"resistance_ohm": 40.0, "on_v": 380.0, "off_v": 360.0}


def test_braking_without_a_chopper_trips_the_drive_and_with_one_does_not() -> None:
    protection = {"over_voltage_v": 400.0}
    with pytest.raises(DriveInFault, match="3210h"):
        run(stopped({"supply": SUPPLY, "protection": protection}))
    kept = run(stopped({"supply": {**SUPPLY, "chopper": RESISTOR_TABLE}, "protection": protection}))
    assert kept.verdict.completed
    battery = {**SUPPLY, "feeds_back": True}
    assert run(stopped({"supply": battery, "protection": protection})).verdict.completed


@pytest.mark.parametrize(
    ("protection", "code"),
    [
        ({"under_voltage_v": 310.0}, "3220h"),
        ({"over_current_a_rms": 1.0}, "2310h"),
        (
            {
                "overload": {
                    "continuous_a_rms": 0.5,
                    "peak_a_rms": 1.0,
                    "peak_time_s": 0.1,
                    "reaction": "fault",
                }
            },
            "2350h",
        ),
        (
            {"stage": {"rise_k": 200.0, "at_a_rms": 1.0, "time_constant_s": 0.1, "max_c": 90.0}},
            "4210h",
        ),
    ],
)
def test_each_protection_ends_a_run_by_its_code(protection: dict[str, object], code: str) -> None:
    with pytest.raises(DriveInFault, match=code):
        run(stopped({"protection": protection}))


def emergencies(bench: ServoBench) -> list[int]:
    return [int.from_bytes(frame.data[:2], "little") for frame in bench.sent if frame.can_id == 0x81]


def test_a_trip_opens_at_once_and_comes_again_while_its_cause_lasts() -> None:
    bench = ServoBench(drive=DriveParameters(protection=Protection(under_voltage_v=310.0)))
    for time in (1, 2):
        bench.command(*ENABLE, torque_raw=500)
        bench.wait_ms(2)
        assert bench.shows(State.FAULT), "without a ramp"
        assert bench.servo.drive.firmware.inner.voltage_q_v == 0.0
        assert bench.read(0x603F, "H") == 0x3220
        assert emergencies(bench) == [0x3220, 0x0000] * (time - 1) + [0x3220]
        bench.rpdo(0x80)
        bench.wait_ms(2)
        assert bench.shows(State.SWITCH_ON_DISABLED)
        bench.rpdo(0x00)


def test_a_warning_is_bit_7_of_the_statusword() -> None:
    overload = Overload(0.5, 1.0, peak_time_s=0.02)
    bench = ServoBench(drive=DriveParameters(protection=Protection(overload=overload)))
    bench.command(*ENABLE, torque_raw=300)
    assert not bench.statusword & Status.WARNING
    bench.wait_ms(100)
    assert bench.statusword & Status.WARNING
    assert bench.statusword & Status.INTERNAL_LIMIT_ACTIVE, "the current is limited"


def no_load_speed(motor: PmsmParameters, volts: float) -> float:
    """rad/s at which the back-EMF takes the largest voltage of the link."""
    return motor.voltage_max_v * volts / motor.dc_bus_voltage_v / (motor.pole_pairs * motor.flux_linkage_wb)


@pytest.mark.parametrize("supply", [None, Supply(300.0, 0.01, 1e-3, feeds_back=True)])
def test_the_speed_that_a_motor_reaches_follows_its_source(supply: Supply | None) -> None:
    motor = replace(LING2012.parameters, viscous_friction_nm_s=0.0)
    firmware = started(motor, supply)
    firmware.control(InnerControl.SPEED)
    firmware.scale_supply(0.25)
    at(firmware, 0.01)
    firmware.ramp_to_speed(400.0, 2000.0)
    at(firmware, 2.0)
    assert firmware.speed_rad_s == pytest.approx(no_load_speed(motor, 75.0), rel=0.03)
    firmware.scale_supply(1.0)
    at(firmware, 4.0)
    assert firmware.speed_rad_s == pytest.approx(400.0, rel=1e-3)


STAGE = StageHeat(30.0, 45.0, 3.0, 0.4, 95.0, 85.0)
"""45 K above 30 degrees C for ever at 3 A rms."""
HELD = replace(LING2012.parameters, inertia_kg_m2=1e3)
RMS_A = math.sqrt(3.0)
"""Amplitude of 1 A rms in the power-invariant transform."""


def heated(stage: StageHeat, rms_a: float) -> Firmware:
    firmware = started(HELD, None, Protection(stage=stage))
    firmware.control(InnerControl.TORQUE)
    firmware.demand_torque(HELD.torque_constant_nm_a * RMS_A * rms_a)
    return firmware


def test_a_power_stage_warms_by_the_square_of_its_current_and_fails_above_its_limit() -> None:
    firmware = heated(STAGE, 4.0)
    settles_k = 45.0 * 16.0 / 9.0
    for time_s in (0.05, 0.3, 0.6):
        at(firmware, time_s)
        told_c = 30.0 + settles_k * (1.0 - math.exp(-time_s / 0.4))
        assert firmware.inner.stage_c == pytest.approx(told_c, abs=0.1)
    fails_s = 0.4 * math.log(settles_k / (30.0 + settles_k - 95.0))
    at(firmware, fails_s - 0.01)
    assert firmware.inner.trip == Trip.NONE
    at(firmware, fails_s + 0.01)
    assert firmware.inner.trip == Trip.STAGE_HOT
    firmware.control(InnerControl.OFF)
    for cold_c, trip in ((87.0, Trip.STAGE_HOT), (83.0, Trip.NONE)):
        at(firmware, fails_s + 0.01 + 0.4 * math.log(65.0 / (cold_c - 30.0)) + 0.004)
        firmware.inner.trip = Trip.NONE
        at(firmware, firmware.ticks / 16_000 + 0.001)
        assert firmware.inner.trip == trip, cold_c


def test_a_warm_power_stage_lets_less_current_through_until_it_warms_no_more() -> None:
    """It settles where the current that is let through keeps it as warm: a root of a parabola."""
    firmware = heated(replace(STAGE, derate_from_c=70.0), 6.0)
    at(firmware, 6.0)
    most = HELD.current_max_a / RMS_A  # A rms, at 70 degrees C, falls to 0 at 95
    a, b, c = 45.0 / 9.0, 25.0 / most, 30.0 - 95.0
    settles_a = (-b + math.sqrt(b * b - 4.0 * a * c)) / (2.0 * a)
    inner = firmware.inner
    assert inner.current_q_a / RMS_A == pytest.approx(settles_a, rel=0.01)
    assert inner.stage_c == pytest.approx(30.0 + a * settles_a**2, abs=0.1)
    assert inner.derated
    assert firmware.inner.trip == Trip.NONE


def test_an_overload_and_a_warm_stage_limit_together() -> None:
    """The lesser of both is in force."""
    overload = Overload(2.0, 6.0, peak_time_s=0.2)
    firmware = started(
        HELD, None, Protection(overload=overload, stage=replace(STAGE, rise_k=30.0, derate_from_c=60.0))
    )
    firmware.control(InnerControl.TORQUE)
    firmware.demand_torque(HELD.torque_constant_nm_a * RMS_A * 6.0)
    at(firmware, 0.3)
    assert firmware.inner.derated
    assert firmware.inner.current_q_a == pytest.approx(2.0 * RMS_A, rel=0.01)
    warm = replace(STAGE, rise_k=300.0, derate_from_c=60.0)
    hot = started(HELD, None, Protection(overload=overload, stage=warm))
    hot.control(InnerControl.TORQUE)
    hot.demand_torque(HELD.torque_constant_nm_a * RMS_A * 6.0)
    at(hot, 6.0)
    a, b = 300.0 / 9.0, 35.0 / 6.0
    settles_a = (math.sqrt(b * b + 4.0 * a * 65.0) - b) / (2.0 * a)
    assert settles_a < overload.continuous_a_rms
    assert hot.inner.current_q_a == pytest.approx(settles_a * RMS_A, rel=0.01)
