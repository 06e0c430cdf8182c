"""Iron that saturates, and a hot motor, beside scipy on the gradient of an energy, and balances of energy."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from servobench import run
from servobench.design.iron import Iron, iron_of
from servobench.design.motor import Heat, PmsmParameters
from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import NS_PER_S, Instant
from servobench.hil.configuration.bench_file import Bench
from servobench.hil.configuration.motor_file import LING2012
from servobench.virtual_bus.drive.firmware import Firmware, FirmwareParameters, InnerControl
from servobench.virtual_bus.drive.power_stage import Supply
from tests.plant import Plant
from tests.scenario.processes import EXAMPLES

LING = LING2012.parameters
SALIENT = replace(
    LING, name="salient", inductance_d_h=0.005, inductance_q_h=0.012, current_max_a=30.0, resistance_ohm=0.8
)
MOTORS = {"ling2012": LING, "salient": SALIENT}


def saturated(motor: PmsmParameters, share: float = 0.9, linear_to_a: float | None = None) -> PmsmParameters:
    iron = iron_of(
        motor.inductance_d_h,
        motor.inductance_q_h,
        motor.flux_linkage_wb,
        linear_to_a=2.0 * motor.rated_current_a if linear_to_a is None else linear_to_a,
        at_a=motor.current_max_a,
        torque_share=share,
    )
    return replace(motor, iron=iron)


def energy(motor: PmsmParameters, iron: Iron, flux_d: float, flux_q: float) -> float:
    """W of the module's page, in a form of its own: the magnet's term completes the square."""
    d, q = motor.inductance_d_h, motor.inductance_q_h
    over = max(0.0, flux_d**2 + flux_q**2 - iron.knee_wb2)
    return (flux_d - motor.flux_linkage_wb) ** 2 / (2 * d) + flux_q**2 / (2 * q) + iron.strength * over**3 / 6


def gradient(motor: PmsmParameters, iron: Iron, flux_d: float, flux_q: float) -> tuple[float, float]:
    step = 1e-6 * motor.flux_linkage_wb
    return (
        (energy(motor, iron, flux_d + step, flux_q) - energy(motor, iron, flux_d - step, flux_q))
        / (2 * step),
        (energy(motor, iron, flux_d, flux_q + step) - energy(motor, iron, flux_d, flux_q - step))
        / (2 * step),
    )


@pytest.mark.parametrize("name", MOTORS)
@pytest.mark.parametrize("share", [0.98, 0.9, 0.82])
def test_torque_is_linear_to_twice_the_rated_current_and_the_share_at_the_largest(
    name: str, share: float
) -> None:
    motor = saturated(MOTORS[name], share)
    assert motor.iron is not None
    for current, wanted in (
        (0.5 * motor.rated_current_a, 1.0),
        (1.999 * motor.rated_current_a, 1.0),
        (motor.current_max_a, share),
    ):
        flux_d, flux_q = motor.iron.fluxes(0.0, current)
        assert gradient(motor, motor.iron, flux_d, flux_q) == pytest.approx((0.0, current), abs=1e-6)
        torque = motor.torque_factor * motor.pole_pairs * flux_d * current
        assert torque / (motor.torque_constant_nm_a * current) == pytest.approx(wanted, rel=1e-9)


@pytest.mark.parametrize("name", MOTORS)
def test_currents_of_a_turning_shaft_are_those_of_scipy(name: str) -> None:
    """A constant voltage in the rotor's frame, the shaft at a speed; the fluxes are integrated."""
    motor = replace(saturated(MOTORS[name]), inertia_kg_m2=1e9, viscous_friction_nm_s=0.0)
    iron = motor.iron
    assert iron is not None
    speed, volts = 60.0, (-30.0, 120.0)
    plant = Plant(motor, 1 / 16_000)
    plant.spin(speed)

    def slopes(_t: float, flux: "np.ndarray[tuple[int], np.dtype[np.float64]]") -> list[float]:
        i_d, i_q = gradient(motor, iron, float(flux[0]), float(flux[1]))
        omega = motor.pole_pairs * speed
        return [
            volts[0] - motor.resistance_ohm * i_d + omega * flux[1],
            volts[1] - motor.resistance_ohm * i_q - omega * flux[0],
        ]

    begins = [motor.flux_linkage_wb, 0.0]
    times = np.arange(1, 161) / 16_000
    told = solve_ivp(slopes, (0.0, times[-1]), begins, "DOP853", times, rtol=1e-10, atol=1e-12)
    currents = np.array([gradient(motor, iron, *flux) for flux in told.y.T])
    found = []
    for _ in times:
        plant.advance(*volts, stator_fixed=False)
        found.append((plant.current_d_a, plant.current_q_a))
    largest = float(np.max(np.hypot(*currents.T)))
    assert largest > 3.0 * motor.rated_current_a, "far beyond the knee"
    assert np.max(np.abs(np.array(found) - currents)) < 1e-4 * largest


def started(motor: PmsmParameters, parameters: FirmwareParameters) -> Firmware:
    firmware = Firmware(motor, parameters)
    firmware.start(Instant(0))
    return firmware


def at(firmware: Firmware, time_s: float) -> None:
    firmware.advance_to(Instant(round(time_s * NS_PER_S)))


def stored_j(firmware: Firmware, motor: PmsmParameters, farad: float) -> float:
    inner, iron = firmware.inner, motor.iron
    assert iron is not None
    field = energy(motor, iron, *iron.fluxes(inner.current_d_a, inner.current_q_a))
    shaft = 0.5 * motor.inertia_kg_m2 * inner.speed_rad_s**2
    return motor.torque_factor * field + shaft + 0.5 * farad * inner.link_v**2


@pytest.mark.parametrize("name", MOTORS)
def test_no_energy_is_made_or_lost_from_source_to_shaft(name: str) -> None:
    farad = 2e-3
    motor = replace(
        saturated(MOTORS[name]), resistance_ohm=1e-6, viscous_friction_nm_s=0.0, inertia_kg_m2=0.01
    )
    firmware = started(motor, FirmwareParameters(supply=Supply(300.0, 0.5, farad)))
    inner = firmware.inner
    firmware.control(InnerControl.SPEED)
    begun_j, peak_a = stored_j(firmware, motor, farad), 0.0
    for target_rad_s, milliseconds in ((120.0, range(600)), (-60.0, range(600, 1200))):
        firmware.ramp_to_speed(target_rad_s, 1200.0)
        for millisecond in milliseconds:
            at(firmware, millisecond / 1000.0)
            peak_a = max(peak_a, math.hypot(inner.current_d_a, inner.current_q_a))
            balance_j = stored_j(firmware, motor, farad) - inner.supplied_j - begun_j
            assert abs(balance_j) < 2e-4 * 0.5 * motor.inertia_kg_m2 * 120.0**2
    assert peak_a > 2.2 * motor.rated_current_a


def test_the_torque_told_is_what_the_drive_believes_and_the_torque_made_is_less() -> None:
    """Current loops of 400 Hz: those of 800 Hz have two and a half times their gain there, and ring."""
    motor = replace(saturated(LING), inertia_kg_m2=1e6)
    firmware = started(motor, FirmwareParameters(current_bandwidth_hz=400.0))
    firmware.control(InnerControl.TORQUE)
    firmware.demand_torque(motor.torque_max_nm)
    at(firmware, 0.1)
    inner = firmware.inner
    assert inner.torque_measured_nm == pytest.approx(motor.torque_max_nm, rel=1e-3)
    made_nm = (inner.speed_rad_s - 0.0) * motor.inertia_kg_m2
    at(firmware, 0.2)
    made_nm = (inner.speed_rad_s * motor.inertia_kg_m2 - made_nm) / 0.1
    assert made_nm == pytest.approx(0.9 * motor.torque_max_nm, rel=1e-3)


def test_current_that_flows_down_after_the_power_stage_is_off_leaves_the_magnet_alone() -> None:
    firmware = started(replace(saturated(LING), inertia_kg_m2=1e6), FirmwareParameters())
    firmware.control(InnerControl.TORQUE)
    firmware.demand_torque(LING.torque_max_nm)
    at(firmware, 0.05)
    firmware.control(InnerControl.OFF)
    at(firmware, 0.1)
    assert (firmware.inner.current_d_a, firmware.inner.current_q_a) == (0.0, 0.0)


def test_a_hot_motor_has_more_resistance_and_less_flux_than_its_drive_believes() -> None:
    heat = Heat(resistance_factor=355.0 / 255.0, flux_factor=1.0 - 0.0012 * 60.0)
    motor = replace(LING, heat=heat, inertia_kg_m2=1e6)
    firmware = started(motor, FirmwareParameters())
    firmware.control(InnerControl.TORQUE)
    firmware.demand_torque(4.0)
    at(firmware, 1.0)
    inner = firmware.inner
    assert inner.torque_measured_nm == pytest.approx(4.0, rel=1e-3)
    assert inner.speed_rad_s * motor.inertia_kg_m2 == pytest.approx(4.0 * heat.flux_factor, rel=0.01)
    amperes = 4.0 / LING.torque_constant_nm_a
    assert inner.voltage_q_v == pytest.approx(
        LING.resistance_ohm * heat.resistance_factor * amperes, rel=1e-3
    )
    free = replace(LING, heat=heat, viscous_friction_nm_s=0.0)
    turning = started(free, FirmwareParameters())
    turning.control(InnerControl.TORQUE)
    turning.limit(10.0, 15.0, math.inf)
    turning.demand_torque(0.5)
    at(turning, 3.0)
    no_load = LING.voltage_max_v / (LING.pole_pairs * LING.flux_linkage_wb)
    assert turning.speed_rad_s == pytest.approx(no_load / heat.flux_factor, rel=0.01)


@pytest.mark.parametrize("factor", [1.6, 0.4])
def test_bearings_that_are_cold_or_warm_ask_for_their_torque(factor: float) -> None:
    """The drive feels it, and reckons with that of the sheet."""
    motor = replace(LING, heat=Heat(1.0, 1.0, 20.0, factor))
    firmware = started(motor, FirmwareParameters())
    firmware.control(InnerControl.SPEED)
    firmware.ramp_to_speed(100.0, 1000.0)
    told = []
    for tick in range(1600):
        at(firmware, 1.4 + tick / 16_000)
        told.append(firmware.inner.torque_measured_nm)
    expected = factor * LING.viscous_friction_nm_s * 100.0
    assert sum(told) / len(told) == pytest.approx(expected, rel=0.02)


SATURATION = {"torque_percent": 90.0}
TEMPERATURE = {"winding_c": 120.0, "magnet_c": 80.0}


def test_a_bench_turns_a_hot_motor_that_saturates() -> None:
    key = "drive.axis1.simulation.motor"
    bench = Bench.load(EXAMPLES / "ling2012.toml")
    motor = {**LING2012.tables, "saturation": SATURATION, "temperature": TEMPERATURE}
    hot = bench.changed({key: motor})
    turned = hot.config.drive["axis1"].simulation.motor
    assert turned is not None
    parameters = turned.parameters
    assert parameters.heat is not None
    assert parameters.heat.resistance_factor == pytest.approx(355.0 / 255.0)
    assert parameters.heat.flux_factor == pytest.approx(1.0 - 0.0012 * 60.0)
    assert run(hot).verdict.completed
    assert run(hot).digest != run(bench).digest


@pytest.mark.parametrize(
    ("table", "key", "expected"),
    [
        ({"torque_percent": 40.0}, "saturation", "torque_percent above"),
        ({"torque_percent": 90.0, "linear_to_a": 15.0}, "saturation", "linear_to_a below current_max_a = 15"),
        ({"torque_percent": 100.0}, "saturation.torque_percent", "a value < 100"),
    ],
)
def test_iron_that_cannot_be_is_refused_by_its_key(table: dict[str, float], key: str, expected: str) -> None:
    motor = {**LING2012.tables, "saturation": table}
    bench = Bench.load(EXAMPLES / "ling2012.toml").changed({"drive.axis1.simulation.motor": motor})
    with pytest.raises(BadInput) as caught:
        _ = bench.config
    assert caught.value.key == f"drive.axis1.simulation.motor.{key}"
    assert caught.value.expected.startswith(expected)


def test_a_drive_that_believes_in_another_motor() -> None:
    """Inductances of half the true ones, 10 % more flux: the torque told is 10 % too large."""
    believed = {**LING2012.tables}
    believed["motor"] = {**believed["motor"], "flux_linkage_wb": 1.1 * LING.flux_linkage_wb}
    bench = Bench.load(EXAMPLES / "ling2012.toml").changed({"drive.axis1.simulation.believes": believed})
    assert run(bench).verdict.completed
    firmware = started(
        replace(LING, flux_linkage_wb=1.1 * LING.flux_linkage_wb),
        FirmwareParameters(machine=replace(LING, inertia_kg_m2=1e6)),
    )
    firmware.control(InnerControl.TORQUE)
    firmware.demand_torque(4.0)
    at(firmware, 1.0)
    assert firmware.inner.torque_measured_nm == pytest.approx(4.0, rel=1e-3)
    assert firmware.inner.speed_rad_s * 1e6 == pytest.approx(4.0 / 1.1, rel=0.01)
    believed["motor"] = {**believed["motor"], "pole_pairs": 3}
    with pytest.raises(BadInput, match=r"believes\.motor\.pole_pairs: found 3, expected 4"):
        _ = bench.changed({"drive.axis1.simulation.believes": believed}).config
