"""Current sensors and dead time of the simulated drive beside Clarke's and Park's transforms by numpy, and
beside the Fourier series of what dead time takes."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from servobench import run
from servobench.design.motor import PmsmParameters
from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import NS_PER_S, Instant
from servobench.hil.configuration.bench_file import Bench
from servobench.virtual_bus.drive.firmware import Firmware, FirmwareParameters, InnerControl
from servobench.virtual_bus.drive.power_stage import CurrentSensors, Inverter
from tests.draws import few_of
from tests.motors import AZAIZ, LING
from tests.scenario.processes import EXAMPLES

RATE_HZ = 16_000
THIRD = math.tau / 3.0
FloatArray = NDArray[np.float64]
PHASE_PER_DQ = {LING.name: math.sqrt(2.0 / 3.0), AZAIZ.name: 1.0}
"""A of a phase over A of d and q: LING is power-invariant, AZAIZ amplitude-invariant."""


def turning(motor: PmsmParameters, parameters: FirmwareParameters, speed_rad_s: float) -> Firmware:
    """A shaft of so much inertia that it turns on at that speed."""
    firmware = Firmware(replace(motor, inertia_kg_m2=1e6, viscous_friction_nm_s=0.0), parameters)
    firmware.start(Instant(0))
    firmware.inner.speed_rad_s = speed_rad_s
    firmware.control(InnerControl.TORQUE)
    return firmware


def stepped(firmware: Firmware, ticks: int, *names: str) -> FloatArray:
    """Numbers of the core after each of the next ticks."""
    rows = []
    for _ in range(ticks):
        firmware.advance_to(Instant(math.ceil((firmware.ticks + 1) * NS_PER_S / RATE_HZ)))
        rows.append([getattr(firmware.inner, name) for name in names])
    return np.array(rows).T


@pytest.mark.parametrize("motor", [LING, AZAIZ], ids=lambda motor: motor.name)
@pytest.mark.parametrize("seed", few_of(range(8), 3))
def test_currents_are_told_as_two_sensors_have_them(motor: PmsmParameters, seed: int) -> None:
    """Phase by phase, by matrices: within a rounding, but where that moves the converter's last bit."""
    rng = np.random.default_rng([45, seed])
    amplitude, counts = PHASE_PER_DQ[motor.name], 65_536
    gains, offsets = rng.uniform(-0.2, 0.2, 2), rng.uniform(-1.0, 1.0, 2)
    range_a, bits = float(rng.uniform(1.0, 20.0)), [None, 8, 12][seed % 3]
    share = (0.0, 0.4, 1.0)[seed % 3]
    gain_a, gain_b, offset_a, offset_b = (float(value) for value in (*gains, *offsets))
    sensors = CurrentSensors(range_a, bits, gain_a, gain_b, offset_a, offset_b, delay_s=share / RATE_HZ)
    firmware = turning(motor, FirmwareParameters(current_sensors=sensors), float(rng.uniform(-100.0, 100.0)))
    firmware.demand_torque(float(rng.uniform(-1.0, 1.0)) * motor.rated_torque_nm)
    names = ("current_d_a", "current_q_a", "angle_rad", "current_d_measured_a", "current_q_measured_a")
    i_d, i_q, angle, told_d, told_q = stepped(firmware, 800, *names)
    n = motor.pole_pairs
    a, b = (amplitude * (i_d * np.cos(n * angle - k) - i_q * np.sin(n * angle - k)) for k in (0.0, THIRD))
    a, b = (np.append(phase[0], phase[1:] - share * np.diff(phase)) for phase in (a, b))
    a, b = ((1 + gains[k]) * phase + offsets[k] for k, phase in enumerate((a, b)))
    a, b = (np.clip(phase, -range_a, range_a) for phase in (a, b))
    if bits is not None:
        step = 2.0 * range_a / 2**bits
        a, b = (step * np.floor(phase / step + 0.5) for phase in (a, b))
    phases = np.array([a, b, -a - b])
    seen = n * (np.floor(angle * counts / math.tau) + 0.5) * math.tau / counts
    expected_d = 2 / 3 / amplitude * sum(phases[k] * np.cos(seen - k * THIRD) for k in range(3))
    expected_q = -2 / 3 / amplitude * sum(phases[k] * np.sin(seen - k * THIRD) for k in range(3))
    off = np.hypot(told_d - expected_d, told_q - expected_q)[1:]  # of the first tick nothing was before
    assert np.mean(off < 1e-9) > 0.99
    assert off.max() < (1e-9 if bits is None else 3.0 * step)
    assert np.hypot(told_d - i_d, told_q - i_q).max() > 0.01


@pytest.mark.parametrize(
    ("sensors", "per_turn", "amplitude"),
    [
        (CurrentSensors(50.0, offset_a=0.1), 1, 0.1 / math.sqrt(3.0) * 2.0),
        (CurrentSensors(50.0, gain_error_a=0.05), 2, None),
    ],
)
def test_an_offset_pulls_once_an_electrical_turn_and_a_gain_twice(
    sensors: CurrentSensors, per_turn: int, amplitude: float | None
) -> None:
    """The ripple of the current itself: the loops make it follow what is told, slowly enough here."""
    turn_ticks = 16_000
    speed_rad_s = math.tau / LING.pole_pairs  # an electrical turn a second
    firmware = turning(LING, FirmwareParameters(current_sensors=sensors), speed_rad_s)
    firmware.demand_torque(1.0)
    stepped(firmware, 1000, "current_q_a")
    (i_q,) = stepped(firmware, turn_ticks, "current_q_a")
    spectrum = np.abs(np.fft.rfft(i_q - i_q.mean())) * 2 / turn_ticks
    assert np.argmax(spectrum) == per_turn
    if amplitude is not None:  # two sensors: a in alpha, a / sqrt(3) in beta
        assert spectrum[1] == pytest.approx(amplitude / PHASE_PER_DQ[LING.name], rel=0.01)


def test_noise_is_white_and_of_its_size_in_each_phase() -> None:
    sensors = CurrentSensors(50.0, noise_a_rms=0.2)
    firmware = Firmware(LING, FirmwareParameters(current_sensors=sensors))
    firmware.start(Instant(0))  # off and at rest: all that is told is noise
    told_d, told_q = stepped(firmware, 40_000, "current_d_measured_a", "current_q_measured_a")
    alpha, beta = told_d, told_q  # at the angle 0, but for half a count
    a = PHASE_PER_DQ[LING.name] * alpha
    b = PHASE_PER_DQ[LING.name] * (math.sqrt(3.0) * beta - alpha) / 2.0
    for phase in (a, b):
        assert np.std(phase) == pytest.approx(0.2, rel=0.02)
        assert abs(np.mean(phase)) < 4 * 0.2 / 200.0
        assert np.mean(phase**4) / np.mean(phase**2) ** 2 == pytest.approx(2.7, abs=0.1)  # four even ones
        for lag in (1, 2, 3, 64):
            assert abs(np.corrcoef(phase[lag:], phase[:-lag])[0, 1]) < 0.02
    assert abs(np.corrcoef(a, b)[0, 1]) < 0.02


def test_dead_time_takes_a_square_wave_from_each_phase() -> None:
    """Its fundamental is 4/pi of it; of the 5th and 7th a sixth harmonic is left in d and q."""
    dead_s, speed_rad_s = 2e-6, 20.0
    plain = turning(LING, FirmwareParameters(), speed_rad_s)
    struck = turning(LING, FirmwareParameters(inverter=Inverter(dead_s)), speed_rad_s)
    for firmware in (plain, struck):
        firmware.demand_torque(1.0)
        stepped(firmware, 2000, "voltage_q_v")
    turns = 10
    ticks = round(turns * RATE_HZ * math.tau / (speed_rad_s * LING.pole_pairs))
    (ideal_v,) = stepped(plain, ticks, "next_voltage_q_v")
    voltage_v, current_a = stepped(struck, ticks, "next_voltage_q_v", "current_q_a")
    lost_v = LING.dc_bus_voltage_v * dead_s * RATE_HZ / PHASE_PER_DQ[LING.name]
    assert voltage_v.mean() - ideal_v.mean() == pytest.approx(4.0 / math.pi * lost_v, rel=0.01)
    spectrum = np.abs(np.fft.rfft(current_a * np.hanning(ticks)))[5:]
    assert abs(np.argmax(spectrum) + 5 - 6 * turns) <= 1


def test_within_the_ripple_dead_time_is_a_resistance() -> None:
    """Each phase loses in proportion to its current: the link's share over the band, ohm."""
    dead_s, band_a, speed_rad_s = 2e-6, 100.0, 20.0
    plain = turning(LING, FirmwareParameters(), speed_rad_s)
    struck = turning(LING, FirmwareParameters(inverter=Inverter(dead_s, band_a)), speed_rad_s)
    for firmware in (plain, struck):
        firmware.demand_torque(1.0)
        stepped(firmware, 3000, "voltage_q_v")
    (ideal_v,) = stepped(plain, 1, "next_voltage_q_v")
    voltage_v, current_a = stepped(struck, 1, "next_voltage_q_v", "current_q_a")
    ohm = LING.dc_bus_voltage_v * dead_s * RATE_HZ / band_a
    assert voltage_v[0] - ideal_v[0] == pytest.approx(ohm * current_a[0], rel=0.01)


@pytest.mark.parametrize("share", [0.5, 0.9])
def test_the_largest_voltage_is_the_share_that_the_drive_uses(share: float) -> None:
    firmware = turning(LING, FirmwareParameters(inverter=Inverter(output_share=share)), 0.0)
    firmware.demand_torque(LING.torque_max_nm)
    v_d, v_q = stepped(firmware, 20, "next_voltage_d_v", "next_voltage_q_v")
    assert np.hypot(v_d, v_q).max() == pytest.approx(share * LING.voltage_max_v, rel=1e-12)


def test_a_sensor_that_tells_too_much_makes_too_little_torque() -> None:
    """Both phases 10 % too large: 6077h tells what was asked, the shaft has a tenth less."""
    table = {"range_a": 20.0, "gain_error_a_percent": 10.0, "gain_error_b_percent": 10.0}
    sensors = CurrentSensors(20.0, None, 0.1, 0.1)
    firmware = turning(LING, FirmwareParameters(current_sensors=sensors), 10.0)
    firmware.demand_torque(1.0)
    stepped(firmware, 2000, "current_q_a")
    told_nm, current_a = stepped(firmware, 1, "torque_measured_nm", "current_q_a")
    assert told_nm[0] == pytest.approx(1.0, rel=1e-3)
    assert LING.torque_constant_nm_a * current_a[0] == pytest.approx(1.0 / 1.1, rel=1e-3)
    bench = Bench.load(EXAMPLES / "ling2012.toml")
    assert run(bench.changed({"drive.axis1.simulation.like": {"current_sensor": table}})).verdict.passed


@pytest.mark.parametrize(
    ("like", "key"),
    [
        ({"inverter": {"dead_time_us": 6.0}}, "inverter.dead_time_us"),
        ({"inverter": {"output_percent": 0.0}}, "inverter.output_percent"),
        ({"current_sensor": {"bits": 12}}, "current_sensor.range_a"),
        ({"current_sensor": {"range_a": 5.0, "bits": 2}}, "current_sensor.bits"),
    ],
)
def test_what_a_power_stage_cannot_be_is_refused_by_its_key(like: dict[str, Any], key: str) -> None:
    with pytest.raises(BadInput, match=key):
        run(Bench.load(EXAMPLES / "ling2012.toml").changed({"drive.axis1.simulation.like": like}))
