"""What commissioning works out of samples, against motions that are known exactly."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from servobench.hil.commissioning.excitation import frequency_response, lines_hz, step_lag
from servobench.hil.commissioning.exercise import Recording, smooth_speed
from servobench.hil.commissioning.findings import ReadingsLost, refuse_losses
from servobench.hil.commissioning.identify import (
    Mechanics,
    NotIdentifiable,
    identify_mechanics,
    plain_ratio,
    ratio_of,
    slope_error,
)
from servobench.hil.commissioning.plots import torque_by_angle
from servobench.hil.reviewing.network_meter import runs_of
from tests.draws import examples_of, few_of

Array = NDArray[Any]
J, B, T_C, T_0 = 8e-4, 2e-3, 0.05, 0.01
PERIOD_S = 1e-3


def spin(torque: Array, speed: float) -> Array:
    """Positions of a shaft that turns one way, by the exact answer to a torque held over each period."""
    position = np.zeros(len(torque))
    sign = math.copysign(1.0, speed)
    for k in range(1, len(torque)):
        steady = (torque[k] - T_C * sign - T_0) / B
        fade = math.exp(-B * PERIOD_S / J)
        position[k] = position[k - 1] + steady * PERIOD_S + (speed - steady) * (1.0 - fade) * J / B
        speed = steady + (speed - steady) * fade
    return position


def record(direction: float, rest_s: float = 0.4) -> tuple[Array, Array, Array]:
    """Up with a strong torque, on with a weak one, then coasting; always the same way."""
    pieces = [0.5] * 200 + [0.15] * 300 + [0.0] * round(rest_s / PERIOD_S)
    torque = direction * np.array(pieces)
    position = spin(torque, direction * 5.0)
    time = PERIOD_S * np.arange(len(torque))
    assert np.all(direction * np.diff(position) > 0.0), "friction changes its sign with the speed"
    return time, position, torque


def test_inertia_and_friction_of_a_known_shaft() -> None:
    found = identify_mechanics([record(1.0), record(-1.0)], 0.1)
    assert found.inertia_kg_m2 == pytest.approx(J, rel=0.01)
    assert found.viscous_friction_nm_s == pytest.approx(B, rel=0.02)
    assert found.coulomb_friction_nm == pytest.approx(T_C, rel=0.02)
    assert found.offset_nm == pytest.approx(T_0, rel=0.05)
    assert found.friction_nm(-10.0) == pytest.approx(-(T_C + 10.0 * B), rel=0.02)
    assert found.friction_nm(0.0) == 0.0


def shifted(made: tuple[Array, Array, Array], shift_s: float) -> tuple[Array, Array, Array]:
    """The same motion, seen so much later: with respect to it the torque acted earlier."""
    time, position, torque = made
    return time, np.interp(time - shift_s, time, position), torque


def test_a_torque_that_is_taken_for_later_than_it_acted_is_no_friction() -> None:
    records = [shifted(record(direction), 0.3 * PERIOD_S) for direction in (1.0, -1.0)]
    blind = identify_mechanics(records, 0.1, held_s=0.0)
    found = identify_mechanics(records, 0.1, held_s=0.0, with_shift=True)
    assert found.torque_shift_s == pytest.approx(0.3 * PERIOD_S, abs=2e-6)
    assert found.viscous_friction_nm_s == pytest.approx(B, rel=1e-3)
    off = abs(found.viscous_friction_nm_s - B)
    assert abs(blind.viscous_friction_nm_s - B) > 4.0 * off, "or the shift would need no column"


def test_a_lost_reading_takes_half_of_each_neighbour() -> None:
    """Torques of a saw: the mean of the neighbours is exact, the next one alone would be a step off."""
    time, position, torque = record(1.0)
    whole = identify_mechanics([record(1.0), record(-1.0)], 0.1, held_s=0.0)
    kept = np.arange(len(time)) % 20 != 7
    kept[:25] = kept[-25:] = True
    part = identify_mechanics(
        [tuple(each[kept] for each in record(direction)) for direction in (1.0, -1.0)], 0.1, held_s=0.0
    )
    assert part.inertia_kg_m2 == pytest.approx(whole.inertia_kg_m2, rel=2e-3)
    assert len(position) == len(torque)


def swinging(direction: float, period_s: float) -> tuple[Array, Array, Array]:
    """A torque that makes the speed swing by itself, sampled at instants that jitter by a tenth."""
    random = np.random.Generator(np.random.PCG64(7))
    time: Array = period_s * (np.arange(2000) + 0.1 * random.uniform(-1.0, 1.0, 2000))
    omega = 4.0 * math.pi
    speed = direction * (20.0 + 12.0 * np.sin(omega * time))
    position = direction * (20.0 * time - 12.0 / omega * np.cos(omega * time))
    acceleration = direction * 12.0 * omega * np.cos(omega * time)
    return time, position, J * acceleration + B * speed + direction * T_C + T_0


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_a_torque_that_changes_by_itself_is_joined_by_straight_lines(direction: float) -> None:
    records = [swinging(direction, PERIOD_S)]
    found = identify_mechanics(records, 0.1, with_offset=False)
    assert found.inertia_kg_m2 == pytest.approx(J, rel=1e-4)
    assert found.viscous_friction_nm_s == pytest.approx(B, rel=1e-3)
    assert found.coulomb_friction_nm == pytest.approx(T_C + direction * T_0, rel=1e-3)
    assert found.offset_nm == 0.0
    held = identify_mechanics(records, 0.1, with_offset=False, held_s=0.0)
    assert abs(held.viscous_friction_nm_s - B) > 0.01 * B, "or straight lines would make no difference"


@pytest.mark.parametrize(("missing", "windows"), [(0, 7), (3, 7), (4, 3)])
def test_a_window_bears_four_periods_without_a_sample(missing: int, windows: int) -> None:
    """Of five, those are left out that have both ends of the gap, behind 0.119 s: four of seven."""
    time: Array = PERIOD_S * np.delete(np.arange(251), range(120, 120 + missing))
    record = time, 30.0 * time + 2.0 * time**2, np.full(len(time), 0.1)
    with pytest.raises(NotIdentifiable, match=f"^{windows} usable windows of 0.1 s$"):
        identify_mechanics([record], 0.1)


def ripple(seed: int) -> list[tuple[Array, Array, Array]]:
    """Both ways, with a torque on the shaft that 6077h does not show and that lasts for half a window."""
    random = np.random.Generator(np.random.PCG64(seed))
    records = []
    for direction in (1.0, -1.0, 1.0, -1.0):
        time, _, torque = record(direction)
        noise = np.zeros(len(time))
        for k in range(1, len(noise)):
            noise[k] = 0.98 * noise[k - 1] + 4e-4 * random.normal()
        records.append((time, spin(torque + noise, direction * 5.0), torque))
    return records


@pytest.mark.long
def test_the_stated_uncertainty_holds_with_correlated_residuals() -> None:
    errors, stated = [], []
    for seed in few_of(range(40), 16):
        found = identify_mechanics(ripple(seed), 0.1, held_s=0.0)
        errors.append(
            [found.inertia_kg_m2 - J, found.viscous_friction_nm_s - B, found.coulomb_friction_nm - T_C]
        )
        stated.append([found.inertia_error, found.viscous_error, found.coulomb_error])
    error, width = np.array(errors), np.array(stated)
    held = np.mean(np.abs(error) <= width, axis=0)
    assert np.all(held >= 0.85), f"{held}: white residuals would make 0.5 to 0.6 of it"
    ratio = np.sqrt(np.mean(width**2, axis=0)) / (2.0 * np.sqrt(np.mean(error**2, axis=0)))
    assert np.all(ratio <= 1.5), ratio


def test_cogging_shows_against_the_angle() -> None:
    """A shaft held at constant speed by a torque that meets the sixth harmonic of a cogging torque."""
    time: Array = PERIOD_S * np.arange(8000)
    recordings = []
    for direction in (1.0, -1.0):
        position = direction * 20.0 * time
        torque = direction * (T_C + 20.0 * B) + T_0 + 0.004 * np.sin(6.0 * position)
        speed = np.gradient(position, time)
        recordings.append(Recording(time, position, speed, torque, np.zeros(0), 8000, 0, ()))
    known = Mechanics(J, B, T_C, T_0, 0.0, 0.0, 0.0, 0, 0.0)
    found = torque_by_angle(recordings, known)
    assert found.ripple_nm == pytest.approx(0.004, rel=0.05)
    assert found.forward_nm == pytest.approx(0.004 * np.sin(6.0 * found.angle_rad), abs=4e-4)
    assert found.backward_nm == pytest.approx(found.forward_nm, abs=4e-4)
    assert torque_by_angle([], known).ripple_nm is None


def test_the_uncertainty_of_a_slope_holds() -> None:
    random = np.random.Generator(np.random.PCG64(8))
    across: Array = np.cos(np.linspace(0.0, 18.0, 1500))
    held = 0
    for _ in range(100):
        noise = np.convolve(random.normal(size=1529), np.ones(30) / 30.0, "valid")
        along = 3.0 * across + noise
        held += abs(np.polyfit(across, along, 1)[0] - 3.0) <= 2.0 * slope_error(across, along)
    assert held >= 88


def test_losses_above_the_bound_end_a_step() -> None:
    refuse_losses(10, 100)
    with pytest.raises(ReadingsLost, match="11 of 100 readings were lost"):
        refuse_losses(11, 100)


@examples_of(15)
@given(seed=st.integers(0, 2**32 - 1))
def test_lost_samples_and_encoder_steps_hardly_matter(seed: int) -> None:
    random = np.random.Generator(np.random.PCG64(seed))
    step = math.tau / 4096
    records = []
    for direction in (1.0, -1.0):
        time, position, torque = record(direction)
        kept = random.random(len(time)) > 0.02
        records.append((time[kept], np.floor(position[kept] / step) * step, torque[kept]))
    found = identify_mechanics(records, 0.1)
    assert found.inertia_kg_m2 == pytest.approx(J, rel=0.02)
    assert found.viscous_friction_nm_s == pytest.approx(B, rel=0.05)
    assert found.coulomb_friction_nm == pytest.approx(T_C, rel=0.03)


def test_a_gap_in_the_samples_is_not_bridged() -> None:
    time, position, torque = record(1.0)
    keep = (time < 0.25) | (time > 0.45)
    spoilt = torque.copy()
    spoilt[~keep] = 99.0
    whole = identify_mechanics([(time[keep], position[keep], spoilt[keep])], 0.1, with_offset=False)
    assert whole.inertia_kg_m2 == pytest.approx(J, rel=0.05)


def test_a_shaft_that_stands_tells_nothing() -> None:
    time: Array = PERIOD_S * np.arange(1000)
    with pytest.raises(NotIdentifiable):
        identify_mechanics([(time, np.zeros(1000), np.full(1000, 0.01))], 0.1)


def test_a_constant_speed_does_not_tell_the_inertia() -> None:
    time: Array = PERIOD_S * np.arange(2000)
    with pytest.raises(NotIdentifiable):
        identify_mechanics([(time, 30.0 * time, np.full(2000, 0.1))], 0.1)


@pytest.mark.parametrize("factor", [1.0, -1.0, 0.1, 200.0])
def test_velocity_against_path_there_and_back(factor: float) -> None:
    time: Array = np.arange(0.0, 2.0, PERIOD_S)
    position = 1.0 - np.cos(math.pi * time)
    velocity = factor * math.pi * np.sin(math.pi * time)
    found = ratio_of([(time, velocity, position)])
    assert found.value == pytest.approx(factor, rel=2e-3)
    assert found.error < 0.02


def test_the_uncertainty_of_velocity_against_path_is_that_of_its_noise() -> None:
    """White noise in 606Ch, as of a coarse encoder: of 200 pairs of pulses k = 2 holds for some 95 %."""
    random = np.random.Generator(np.random.PCG64(88))
    time: Array = np.arange(0.0, 0.22, PERIOD_S)
    position = 0.25 * (1.0 - np.cos(math.pi * time / 0.22)) / 2.0
    velocity = 0.25 * math.pi / 0.44 * np.sin(math.pi * time / 0.22)
    held, stated, off = 0, [], []
    for _ in range(200):
        noisy = [velocity + random.normal(0.0, 1.0, len(time)) for _ in range(2)]
        found = ratio_of([(time, noisy[0], position), (time, -noisy[1], -position)])
        off.append(found.value - 1.0)
        stated.append(found.error * found.value)
        held += abs(off[-1]) <= stated[-1]
    assert 0.9 <= held / 200 <= 0.99
    assert np.mean(stated) == pytest.approx(2.0 * np.std(off), rel=0.15)


def test_velocity_against_no_path() -> None:
    time: Array = np.arange(0.0, 0.1, PERIOD_S)
    assert math.isnan(ratio_of([(time, np.zeros_like(time), np.zeros_like(time))]).value)


@pytest.mark.parametrize(
    ("ratio", "plain"),
    [(0.0998, 0.1), (4.02, 4.0), (59.5, 60.0), (6.2832, math.tau), (1.37, 1.37), (2.0e-4, 2.0e-4)],
)
def test_ratios_that_mean_something(ratio: float, plain: float) -> None:
    assert plain_ratio(ratio) == pytest.approx(plain, rel=1e-12)


def test_the_smoothed_speed_of_a_ramp_is_exact() -> None:
    time = np.sort(np.random.Generator(np.random.PCG64(1)).random(200))
    assert smooth_speed(time, 3.0 + 7.0 * time) == pytest.approx(np.full(200, 7.0))


def test_the_smoothed_speed_of_an_even_acceleration_is_exact_but_for_four_samples_at_each_end() -> None:
    time = np.linspace(0.0, 1.0, 50)
    speed = smooth_speed(time, 3.0 * time**2)
    inside = 6.0 * time[4:-4]
    assert speed == pytest.approx(np.concatenate([[inside[0]] * 4, inside, [inside[-1]] * 4]))


def test_of_a_few_samples_the_speed_is_the_difference_quotient() -> None:
    time = np.array([0.0, 1.0, 3.0])
    assert smooth_speed(time, 2.0 * time) == pytest.approx(np.full(3, 2.0))
    assert smooth_speed(time[:1], time[:1]) == pytest.approx([0.0])
    nine = np.arange(9.0)
    assert smooth_speed(nine, nine**2) == pytest.approx(np.full(9, 8.0)), "one line through all nine"


def test_runs_of_what_is_missing() -> None:
    gone = [True, False, True, True, False, False, True, True, False, True, True, True]
    assert runs_of(np.array(gone)) == (1, 2, 1)
    assert runs_of(np.zeros(2, dtype=bool)) == ()
    assert runs_of(np.zeros(0, dtype=bool)) == ()


def test_a_frequency_response_is_exact_on_its_lines() -> None:
    lines = lines_hz(2.0, 200.0, 12, 1.0)
    random = np.random.Generator(np.random.PCG64(3))
    phases = random.uniform(0.0, math.tau, len(lines))
    time: Array = PERIOD_S * np.arange(4200)
    transfer = 1.0 / (J * 1j * math.tau * lines + B)
    angle: Array = math.tau * np.outer(time, lines) + phases
    source: Array = np.sin(angle).sum(axis=1)
    output: Array = (np.abs(transfer) * np.sin(angle + np.angle(transfer))).sum(axis=1)
    found = frequency_response(time, source, output, lines, 1.0, PERIOD_S, 0.1)
    assert found.response == pytest.approx(transfer, rel=1e-6)
    assert found.coherence == pytest.approx(np.ones(len(lines)))
    noise = random.normal(0.0, 3.0 * output.std(), len(time))
    noisy = frequency_response(time, source, output + noise, lines, 1.0, PERIOD_S, 0.1)
    assert noisy.coherence.min() < 0.8, "what the input does not explain shows"


def test_a_frequency_response_needs_two_blocks() -> None:
    time: Array = PERIOD_S * np.arange(1500)
    with pytest.raises(ValueError, match="whole blocks"):
        frequency_response(time, time, time, np.array([2.0]), 1.0, PERIOD_S, 0.0)


def test_the_lag_of_a_known_step() -> None:
    random = np.random.Generator(np.random.PCG64(5))
    age = random.uniform(0.0, 2000.0, 1500)
    part = np.where(age > 230.0, 1.0 - np.exp(-(age - 230.0) / 120.0), 0.0)
    part += random.normal(0.0, 0.01, len(age))
    lost = random.random(len(age)) < 0.02
    part[lost] = 0.0
    lag = step_lag(age, part)
    assert lag.half_us == pytest.approx(230.0 + 120.0 * math.log(2.0), abs=10.0)
    assert lag.lag_us == pytest.approx(120.0, abs=20.0)
    assert lag.dead_us == pytest.approx(230.0, abs=15.0)
    assert lag.mean_us == pytest.approx(230.0 + 120.0, abs=10.0)


def test_a_loop_that_overshoots_is_behind_by_one_over_its_bandwidth() -> None:
    """An integrator of 1/alpha behind 94 us of dead time, the simulated drive's loop: stepped by Euler."""
    alpha, dead, step = math.tau * 800.0, 94, 1e-6
    answer = np.zeros(3000)
    for k in range(1, len(answer)):
        seen = answer[k - 1 - dead] if k > dead else 0.0
        answer[k] = answer[k - 1] + alpha * step * (1.0 - seen) if k > dead else 0.0
    # the demand is taken up after the dead time: the error that integrates is dead time old
    assert answer.max() > 1.005
    age = np.arange(3000.0)[::2]
    lag = step_lag(age, answer[::2])
    assert lag.mean_us == pytest.approx(1e6 / alpha, rel=0.02)
    assert lag.lag_us < 0.6e6 / alpha, "the rise alone would call it much faster"


def test_a_step_that_was_not_seen_to_rise() -> None:
    age = np.linspace(500.0, 900.0, 400)
    with pytest.raises(ValueError, match="does not pass"):
        step_lag(age, np.ones_like(age))
    with pytest.raises(ValueError, match="too few"):
        step_lag(age[:10], np.ones(10))
