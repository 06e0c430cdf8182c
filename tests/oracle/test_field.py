"""Least current and weakened field of the simulated drive beside optima by scipy and closed forms."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

from servobench import run
from servobench.design.field import (
    largest_torque,
    least_currents,
    weakened_speed,
    weakened_torque_limit,
)
from servobench.design.motor import PmsmParameters
from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import NS_PER_S, Instant
from servobench.hil.configuration.bench_file import Bench
from servobench.hil.configuration.motor_file import LING2012, load_motor
from servobench.virtual_bus.drive.firmware import Firmware, FirmwareParameters, InnerControl
from servobench.virtual_bus.drive.mechanism import FieldOptions
from tests.scenario.processes import EXAMPLES

AZAIZ = load_motor(EXAMPLES / "motors" / "azaiz2007.toml").parameters
"""L_q = 2 L_d."""
MOTORS = {
    "azaiz2007": AZAIZ,
    "reversed": replace(AZAIZ, inductance_d_h=0.0028, inductance_q_h=0.0014),
    "strong": replace(AZAIZ, inductance_d_h=0.002, inductance_q_h=0.012, current_max_a=40.0),
    "ling2012": replace(LING2012.parameters, viscous_friction_nm_s=0.0),
}
LEAST = FieldOptions(least_current=True)
WEAKENING = FieldOptions(voltage_share=0.95)
BOTH = FieldOptions(least_current=True, voltage_share=0.95)


def torque_of(motor: PmsmParameters, current: "np.ndarray[tuple[int], np.dtype[np.float64]]") -> float:
    """Torque by the fluxes."""
    flux_d = motor.flux_linkage_wb + motor.inductance_d_h * current[0]
    flux_q = motor.inductance_q_h * current[1]
    return float(motor.torque_factor * motor.pole_pairs * (flux_d * current[1] - flux_q * current[0]))


def spun(motor: PmsmParameters, speed_rad_s: float, torque_nm: float, field: FieldOptions) -> Firmware:
    """A shaft that was brought to that speed within 0.3 s and keeps it, whatever pulls at it."""
    firmware = Firmware(replace(motor, inertia_kg_m2=1e7), FirmwareParameters(field=field))
    firmware.start(Instant(0))
    firmware.control(InnerControl.TORQUE)
    firmware.limit(1e3, motor.current_max_a, math.inf)
    firmware.demand_torque(torque_nm)
    for step in range(1, 301):
        firmware.inner.speed_rad_s = step / 300.0 * speed_rad_s
        firmware.advance_to(Instant(step * NS_PER_S // 1000))
    firmware.advance_to(Instant(round(0.6 * NS_PER_S)))
    return firmware


@pytest.mark.parametrize("name", ["azaiz2007", "reversed", "strong"])
@pytest.mark.parametrize("share", [0.1, 0.5, 0.99, -0.5])
def test_a_torque_flows_by_the_least_current(name: str, share: float) -> None:
    motor = MOTORS[name]
    torque_nm = share * largest_torque(motor)
    inner = spun(motor, 1.0, torque_nm, LEAST).inner
    told = minimize(
        lambda x: float(x @ x),
        np.array([-1.0, torque_nm / motor.torque_constant_nm_a]),
        constraints={"type": "eq", "fun": lambda x: torque_of(motor, x) - torque_nm},
        method="SLSQP",
        options={"ftol": 1e-10},
    )
    assert told.success
    found = np.array([inner.current_d_a, inner.current_q_a])
    assert torque_of(motor, found) == pytest.approx(torque_nm, rel=2e-3)
    assert float(np.hypot(*found)) == pytest.approx(float(np.hypot(*told.x)), rel=2e-3)
    assert found == pytest.approx(told.x, abs=0.02 * motor.current_max_a)
    plain = spun(motor, 1.0, 0.3 * torque_nm, FieldOptions()).inner
    assert abs(plain.current_d_a) < 0.01 * motor.current_max_a


@pytest.mark.parametrize("name", ["azaiz2007", "reversed", "strong"])
def test_the_table_and_the_largest_torque_are_optima(name: str) -> None:
    motor = MOTORS[name]
    angles = np.linspace(-math.pi, math.pi, 200_001)
    circle = motor.current_max_a * np.array([np.cos(angles), np.sin(angles)])
    best = max(torque_of(motor, point) for point in circle.T[::20])
    assert largest_torque(motor) == pytest.approx(best, rel=1e-6)
    for share in (0.0, 0.3, 1.0):
        point = np.array(least_currents(motor, share * best))
        assert torque_of(motor, point) == pytest.approx(share * best, rel=1e-5, abs=1e-9)


def optimum(motor: PmsmParameters, speed_rad_s: float, volts: float) -> float:
    """The largest torque inside the circle of currents and that of voltages, of millions of currents."""
    omega = motor.pole_pairs * speed_rad_s
    angle, size = np.meshgrid(np.linspace(0.0, math.pi, 3001), np.linspace(0.0, motor.current_max_a, 1601))
    i_d, i_q = size * np.cos(angle), size * np.sin(angle)
    v_d = motor.resistance_ohm * i_d - omega * motor.inductance_q_h * i_q
    v_q = motor.resistance_ohm * i_q + omega * (motor.inductance_d_h * i_d + motor.flux_linkage_wb)
    flux = motor.flux_linkage_wb + (motor.inductance_d_h - motor.inductance_q_h) * i_d
    torque = motor.torque_factor * motor.pole_pairs * flux * i_q
    return float(np.max(np.where(v_d**2 + v_q**2 <= volts**2, torque, 0.0)))


@pytest.mark.parametrize("name", MOTORS)
@pytest.mark.parametrize("share", [0.8, 1.1, 1.19])
@pytest.mark.parametrize("way", [1.0, -1.0])
def test_above_the_base_speed_torque_is_the_largest_inside_both_circles(
    name: str, share: float, way: float
) -> None:
    motor = MOTORS[name]
    no_load = motor.voltage_max_v / (motor.pole_pairs * motor.flux_linkage_wb)
    speed = share * no_load
    inner = spun(motor, way * speed, way * 1.2 * largest_torque(motor), BOTH).inner
    made = torque_of(motor, np.array([inner.current_d_a, inner.current_q_a]))
    told = optimum(motor, speed, 0.95 * motor.voltage_max_v)
    assert way * made == pytest.approx(told, rel=0.02, abs=0.01 * largest_torque(motor))
    volts = math.hypot(inner.voltage_d_v, inner.voltage_q_v)
    assert volts <= 0.96 * motor.voltage_max_v
    drawn = weakened_torque_limit(
        replace(motor, dc_bus_voltage_v=0.95 * motor.dc_bus_voltage_v), np.array([speed])
    )
    assert float(drawn[0]) == pytest.approx(told, rel=4e-3, abs=2e-3 * largest_torque(motor))


@pytest.mark.parametrize("share", [1.05, 1.3, 1.6])
def test_without_load_the_d_current_is_that_of_the_closed_form(share: float) -> None:
    """|omega (phi + L_d i_d)| = V: what the magnet has too much, as a current."""
    motor = MOTORS["ling2012"]
    omega = share * motor.voltage_max_v / motor.flux_linkage_wb
    inner = spun(motor, omega / motor.pole_pairs, 0.0, WEAKENING).inner
    volts = 0.95 * motor.voltage_max_v
    # R i_d in quadrature
    told = (volts / omega - motor.flux_linkage_wb) / motor.inductance_d_h
    assert inner.current_d_a == pytest.approx(told, rel=0.02)
    assert abs(inner.current_q_a) < 0.02 * motor.current_max_a


def test_no_step_turns_the_field_by_more_than_a_quarter_of_a_radian() -> None:
    motor = replace(MOTORS["ling2012"], rated_speed_rad_s=100.0, pole_pairs=8)
    steps_s = {}
    for speed_rad_s in (50.0, 600.0):
        steps_s[speed_rad_s] = spun(motor, speed_rad_s, 0.0, WEAKENING).inner.step_s
        assert steps_s[speed_rad_s] * motor.pole_pairs * speed_rad_s <= 0.25
    assert steps_s[600.0] < steps_s[50.0]


def test_a_shaft_runs_up_beyond_its_speed_without_load_and_back() -> None:
    motor = replace(MOTORS["ling2012"], inertia_kg_m2=2e-3)
    no_load = motor.voltage_max_v / (motor.pole_pairs * motor.flux_linkage_wb)
    reached = {}
    for field in (FieldOptions(), WEAKENING):
        firmware = Firmware(motor, FirmwareParameters(field=field))
        firmware.start(Instant(0))
        firmware.control(InnerControl.SPEED)
        firmware.ramp_to_speed(1.5 * no_load, 800.0)
        firmware.advance_to(Instant(3 * NS_PER_S))
        reached[field] = firmware.speed_rad_s
        firmware.ramp_to_speed(0.0, 800.0)
        firmware.advance_to(Instant(6 * NS_PER_S))
        assert abs(firmware.speed_rad_s) < 1.0
        assert firmware.inner.weaker_a == 0.0
    assert reached[FieldOptions()] < 1.02 * no_load
    assert reached[WEAKENING] == pytest.approx(1.5 * no_load, rel=1e-3)


def test_the_largest_speed_has_all_the_current_against_the_magnet() -> None:
    motor = replace(MOTORS["ling2012"], current_max_a=6.0)
    omega = motor.pole_pairs * weakened_speed(motor)
    left_wb = motor.flux_linkage_wb - motor.inductance_d_h * 6.0
    assert omega * left_wb == pytest.approx(motor.voltage_max_v)


FIELD = {"least_current": True, "weakening": True}


def test_a_bench_may_ask_for_a_speed_beyond_the_back_emf_only_of_a_drive_that_weakens() -> None:
    key = "drive.axis1.limits.speed_max_rpm"
    bench = Bench.load(EXAMPLES / "ling2012.toml").changed({key: 6000.0})
    with pytest.raises(BadInput, match="back-EMF takes 300 V"):
        _ = bench.config
    weakens = bench.changed({"drive.axis1.simulation.like": {"field": FIELD}})
    assert run(weakens).verdict.completed
    with pytest.raises(BadInput, match="as far as Ling2012's field is weakened"):
        _ = weakens.changed({key: 60_000.0}).config


def test_a_salient_motor_takes_less_current_by_its_drive() -> None:
    motor = MOTORS["strong"]
    plain, least = (spun(motor, 1.0, 10.0, field).inner for field in (FieldOptions(), LEAST))
    amplitudes = [math.hypot(inner.current_d_a, inner.current_q_a) for inner in (plain, least)]
    assert amplitudes[1] < 0.9 * amplitudes[0]
