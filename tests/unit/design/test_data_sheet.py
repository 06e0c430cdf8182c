"""A data sheet's figures in dq parameters, against three phases summed up in time."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from servobench.design.data_sheet import DataSheet, at_temperature, of_phase
from servobench.design.motor import (
    CONVENTIONS,
    PmsmParameters,
    Transform,
    emf_constant,
    figure,
    motor_figures,
    phase_emf_constant,
    speed_limit,
    torque_limit,
)

_ANGLES = np.linspace(0.0, 2.0 * np.pi, 7200, endpoint=False)
_SHIFTS = np.array([0.0, -2.0 * np.pi / 3.0, 2.0 * np.pi / 3.0])
_KRPM = 1000.0 * math.pi / 30.0


def _emf(constant: float, speed: float) -> NDArray[np.float64]:
    """Back-EMF (3, k) of a star's phases in V over one electrical turn."""
    return np.asarray(constant * speed * np.cos(_ANGLES + _SHIFTS[:, None]))


def _sine_torque(constant: float, rms: float) -> float:
    """Mean torque of sinusoidal currents in phase with the EMF: power over speed."""
    currents = math.sqrt(2.0) * rms * np.cos(_ANGLES + _SHIFTS[:, None])
    return float((_emf(constant, 1.0) * currents).sum(axis=0).mean())


def _six_step_torque(constant: float) -> float:
    """Mean torque of 1 A led, at each instant, through the two phases with the largest EMF between them."""
    emf = _emf(constant, 1.0)
    return float((emf.max(axis=0) - emf.min(axis=0)).mean())


_MEASURED: dict[str, Callable[[float], float]] = {
    "kt_nm_arms": lambda c: _sine_torque(c, 1.0),
    "kt_nm_apk": lambda c: _sine_torque(c, math.sqrt(0.5)),
    "kt_nm_adc": _six_step_torque,
    "ke_line_vrms_krpm": lambda c: float(np.std(_emf(c, _KRPM)[0] - _emf(c, _KRPM)[1])),
    "ke_line_vpk_krpm": lambda c: float(np.ptp(_emf(c, _KRPM)[0] - _emf(c, _KRPM)[1]) / 2.0),
    "ke_phase_vrms_krpm": lambda c: float(np.std(_emf(c, _KRPM)[0])),
    "ke_phase_vpk_krpm": lambda c: float(np.max(_emf(c, _KRPM)[0])),
    "kv_rpm_vdc": lambda c: 30.0 / math.pi / _six_step_torque(c),  # torque per ampere = volts per rad/s
    "kv_rpm_vpk": lambda c: 30.0 / math.pi / float(np.ptp(_emf(c, 1.0)[0] - _emf(c, 1.0)[1]) / 2.0),
}


@pytest.mark.parametrize("name", CONVENTIONS)
def test_each_convention_is_that_of_three_phases_summed_up_in_time(name: str) -> None:
    assert set(_MEASURED) == set(CONVENTIONS)
    for constant in (0.017, 0.31, 4.0):
        measured = _MEASURED[name](constant)
        assert figure(name, constant) == pytest.approx(measured, rel=1e-5)
        assert emf_constant(name, measured) == pytest.approx(constant, rel=1e-5)


def test_a_winding_between_terminals_and_in_delta() -> None:
    # Two terminals of a delta see one phase beside two in series.
    leg = 3.7
    line = 1.0 / (1.0 / leg + 1.0 / (2.0 * leg))
    star = of_phase(leg, between_terminals=False, delta=True)
    assert of_phase(line, between_terminals=True, delta=True) == pytest.approx(star)
    assert of_phase(2.0 * star, between_terminals=True, delta=False) == pytest.approx(star)
    assert of_phase(star, between_terminals=False, delta=False) == star


def test_copper_at_100_kelvin_above() -> None:
    # IEC 60034-1: (235 + 120)/(235 + 20)
    assert at_temperature(1.0, 20.0, 120.0) == pytest.approx(355.0 / 255.0)


SHEET = DataSheet(
    name="made up", pole_pairs=5, resistance_ohm=0.9, inductance_d_h=2.7e-3, inductance_q_h=2.7e-3,
    flux={"kt_nm_arms": 0.8}, inertia_kg_m2=1.2e-4, rated_torque_nm=2.4, rated_current_a=math.sqrt(2.0) * 3.1,
    rated_speed_rad_s=300.0, peak_current_a=18.0, dc_bus_voltage_v=325.0,
)  # fmt: skip


def test_a_sheet_that_agrees_with_itself_has_nothing_to_tell() -> None:
    constant = SHEET.emf_constant_v_s
    full = replace(
        SHEET,
        flux={name: figure(name, constant) for name in CONVENTIONS},
        peak_torque_nm=1.4 * constant * 18.0,
        electrical_time_s=3e-3,
        mechanical_time_s=0.9 * 1.2e-4 / (1.5 * constant**2),
    )
    assert list(full.contradictions()) == []
    assert full.motor().torque_constant_nm_a == pytest.approx(0.8 / math.sqrt(2.0))


def test_without_a_peak_current_the_peak_torque_is_the_limit() -> None:
    sheet = replace(SHEET, peak_current_a=None, peak_torque_nm=7.2)
    assert sheet.motor().current_max_a == pytest.approx(7.2 / (0.8 / math.sqrt(2.0)))


@pytest.mark.parametrize(("given", "meant"), [
    ("ke_line_vrms_krpm", "ke_line_vpk_krpm"),
    ("ke_line_vpk_krpm", "ke_line_vrms_krpm"),
    ("ke_phase_vrms_krpm", "ke_line_vrms_krpm"),
    ("ke_line_vrms_krpm", "ke_phase_vpk_krpm"),
])  # fmt: skip
def test_a_figure_in_the_wrong_convention_is_told_with_the_right_one(given: str, meant: str) -> None:
    value = figure(meant, SHEET.emf_constant_v_s)
    wrong = replace(SHEET, flux={"kt_nm_arms": 0.8, given: value})
    (found,) = wrong.contradictions()
    assert given in found.figures
    assert f"{meant} = {value:g}" in found.explanation


def test_a_peak_current_entered_as_rms_is_told() -> None:
    (found,) = replace(SHEET, rated_current_a=2.0 * 3.1).contradictions()
    assert "the current is a peak value" in found.explanation
    (found,) = replace(SHEET, rated_current_a=3.1).contradictions()
    assert "the current is an rms value" in found.explanation


def test_a_line_resistance_entered_as_a_phase_is_told_by_the_time_constant() -> None:
    (found,) = replace(SHEET, resistance_ohm=1.8, electrical_time_s=3e-3).contradictions()
    assert "between terminals" in found.explanation


def test_a_speed_beyond_the_voltage_is_told() -> None:
    (found,) = replace(SHEET, dc_bus_voltage_v=48.0).contradictions()
    assert "back-EMF" in found.difference


def _motor(transform: Transform) -> PmsmParameters:
    motor = SHEET.motor()
    if transform is Transform.AMPLITUDE_INVARIANT:
        return motor
    scale = math.sqrt(1.5)
    return replace(motor, transform=transform, flux_linkage_wb=motor.flux_linkage_wb * scale,
                   current_max_a=motor.current_max_a * scale)  # fmt: skip


def test_both_transforms_have_the_same_figures() -> None:
    one, other = (motor_figures(_motor(transform)) for transform in Transform)
    assert one == pytest.approx(other)
    assert phase_emf_constant(_motor(Transform.POWER_INVARIANT)) == pytest.approx(SHEET.emf_constant_v_s)
    assert one["kt_nm_arms"] == pytest.approx(0.8)


def test_the_torque_limit_is_the_largest_current_that_the_circles_allow() -> None:
    motor = _motor(Transform.AMPLITUDE_INVARIANT)
    currents = np.linspace(0.0, motor.current_max_a, 20_001)
    for speed in (0.0, 50.0, 200.0, 280.0, 330.0, speed_limit(motor, 0.0) * 0.999):
        omega = motor.pole_pairs * speed
        d = -omega * motor.inductance_q_h * currents
        q = motor.resistance_ohm * currents + omega * motor.flux_linkage_wb
        allowed = currents[np.hypot(d, q) <= motor.voltage_max_v]
        expected = motor.torque_constant_nm_a * allowed.max()
        assert float(torque_limit(motor, np.array([speed]))[0]) == pytest.approx(expected, abs=2e-3)
    assert float(torque_limit(motor, np.array([1.01 * speed_limit(motor, 0.0)]))[0]) == 0.0


# Measured by a chip maker's tool: Microchip's published motorBench report on the Hurst 300 has every figure
# in several conventions.
HURST300 = DataSheet(
    name="Hurst300", pole_pairs=5, resistance_ohm=of_phase(0.984474, between_terminals=True, delta=False),
    inductance_d_h=337.615e-6, inductance_q_h=322.487e-6, flux={"ke_line_vrms_krpm": 4.753},
    inertia_kg_m2=18.006e-6, rated_torque_nm=0.251807, rated_current_a=4.530, rated_speed_rad_s=381.599,
    peak_current_a=4.530, dc_bus_voltage_v=math.sqrt(3.0) * 14.2,
    electrical_time_s=670.512e-6, mechanical_time_s=4.303e-3,
)  # fmt: skip


def test_a_published_motor_has_its_published_figures() -> None:
    assert list(HURST300.contradictions()) == []
    motor = HURST300.motor()
    assert motor.flux_linkage_wb == pytest.approx(7.412e-3, rel=1e-3)
    assert motor.torque_max_nm == pytest.approx(0.251807, rel=1e-3)
    figures = motor_figures(motor)
    assert figures["motor_constant_nm_sqrt_w"] == pytest.approx(64.690e-3, rel=1e-3)
    assert figures["tau_mechanical_ms"] == pytest.approx(4.303, rel=1e-3)


def test_speeds_at_a_torque_are_told_in_turns_a_minute() -> None:
    motor = HURST300.motor()
    figures = motor_figures(motor)
    for key, torque_nm in (("rated", motor.rated_torque_nm), ("peak", motor.torque_max_nm)):
        turns = figures[f"base_speed_{key}_torque_rpm"] / 60.0
        assert turns * 2.0 * math.pi == pytest.approx(speed_limit(motor, torque_nm), rel=1e-12)
        assert torque_limit(motor, np.array([turns * 2.0 * math.pi]))[0] == pytest.approx(torque_nm, rel=1e-3)


@pytest.mark.parametrize("wrong", ["ke_line_vpk_krpm", "ke_phase_vrms_krpm", "ke_phase_vpk_krpm"])
def test_a_published_motor_in_the_wrong_convention_is_refused(wrong: str) -> None:
    assert list(replace(HURST300, flux={wrong: 4.753}).contradictions())


def test_the_shape_of_a_trapezoidal_sheet() -> None:
    # A published sheet: 0.49 N m/A, 51 V per 1000 r/min, 2.2 N m at 4.52 A. Equal in SI units (51 V per
    # 104.7 rad/s is 0.487 V s), so they are a six-step drive's, not rms.
    flux = {"kt_nm_arms": 0.49, "ke_line_vrms_krpm": 51.0}
    (found,) = replace(SHEET, flux=flux, rated_current_a=None).contradictions()
    assert "from the first follows ke_line_vrms_krpm = 29.6" in found.difference
    six_step = replace(SHEET, flux={"kt_nm_adc": 0.49, "ke_line_vpk_krpm": 51.0}, rated_current_a=None)
    assert list(six_step.contradictions()) == []
