"""The resonance of a coupling by the frequency response: by the exact motion of two masses, and by drives."""

import math
from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm

from servobench.design.mechanism import Coupling, Mechanism
from servobench.hil.commissioning.excitation import (
    FrequencyResponse,
    closer_lines_hz,
    frequency_response,
    multisine,
    resonance_of,
)
from servobench.hil.commissioning.findings import StepVerdict
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from servobench.virtual_bus.drive.unknown_drive import unknown_drive
from tests.commissioning import unknown_world
from tests.draws import few_of

Array = NDArray[Any]
PERIOD_S = 1e-3
BLOCKS = 6
J = 1e-3


def coupling(inertia: float, resonance_hz: float, ratio: float, backlash: float = 0.0) -> Coupling:
    load = inertia * ratio / (1.0 + ratio)
    stiffness = load * (math.tau * resonance_hz) ** 2 / (1.0 + ratio)
    return Coupling(inertia - load, load, stiffness, 0.02, backlash)


def exact_response(shaft: Coupling, lines: Array, noise: float) -> FrequencyResponse:
    """By the matrix exponential, with a torque held over each period and a noise on the speed, rad/s rms."""
    k, d, motor, load = shaft.stiffness_nm_rad, shaft.damping_nm_s, shaft.motor_kg_m2, shaft.load_kg_m2
    system = np.zeros((4, 4))  # twist, speed of motor and load, torque
    system[0, 1:3] = 1.0, -1.0
    system[1] = -k / motor, -d / motor, d / motor, 1.0 / motor
    system[2, :3] = k / load, d / load, -d / load
    step = expm(PERIOD_S * system)
    value = multisine(lines, 0.1, seed=1)
    state, torque, speed = np.zeros(4), [], []
    for cycle in range(1000 * (BLOCKS + 1)):
        state[3] = value(cycle * PERIOD_S)
        torque.append(state[3])
        speed.append(state[1])
        state = step @ state
    random = np.random.Generator(np.random.PCG64(7))
    told = np.array(speed) + noise * random.standard_normal(len(speed))
    time: Array = PERIOD_S * np.arange(len(speed))
    return frequency_response(time, np.array(torque), told, lines, 1.0, PERIOD_S, 1.0)


@pytest.mark.parametrize("ratio", few_of([4.0, 0.5], 1))
@pytest.mark.parametrize("resonance_hz", [30.0, 90.0, 250.0])
@pytest.mark.parametrize("off", [0.92, 1.08])
def test_two_masses_are_found_between_lines_that_are_not_centred(
    off: float, resonance_hz: float, ratio: float
) -> None:
    shaft = coupling(J, resonance_hz, ratio)
    lines = closer_lines_hz(off * resonance_hz, 1.0, 400.0)
    found = resonance_of(exact_response(shaft, lines, 0.02), PERIOD_S)
    assert found is not None
    assert found.frequency_hz == pytest.approx(shaft.resonance_hz, rel=0.01)
    assert found.damping_ratio == pytest.approx(0.02, rel=0.5)


def test_a_rigid_shaft_has_none() -> None:
    lines = closer_lines_hz(90.0, 1.0, 400.0)
    shaft = coupling(J, 2000.0, 0.01)
    assert resonance_of(exact_response(shaft, lines, 0.02), PERIOD_S) is None


def test_lines_without_coherence_say_nothing() -> None:
    lines = closer_lines_hz(90.0, 1.0, 400.0)
    assert resonance_of(exact_response(coupling(J, 90.0, 2.0), lines, 1e3), PERIOD_S) is None


@pytest.mark.parametrize(("highest", "last"), [(400.0, 116.0), (100.0, 99.0)])
def test_the_lines_of_a_closer_look_end_where_they_cannot_be_excited(highest: float, last: float) -> None:
    lines = closer_lines_hz(90.0, 1.0, highest)
    assert (lines[0], lines[-1]) == (68.0, last)
    assert len(lines) == 20


def test_a_closer_look_has_as_many_lines_at_every_frequency() -> None:
    """Twice as far apart as whole hertz, the lines near 37 Hz were too few for a fit."""
    for near_hz in range(37, 300):
        lines = closer_lines_hz(float(near_hz), 1.0, 400.0)
        assert len(lines) == 20
        assert np.all(np.diff(lines) >= 1.0)


SEED = 7
NOT_RESTED_ON = ("stop_proof", "torque_constant", "voltage_constant")
"""Steps that take their time, and whose figures the response does not need."""


@pytest.mark.long
@pytest.mark.parametrize(("resonance_hz", "ratio"), few_of([(140.0, 1.0), (45.0, 3.0), (230.0, 2.0)], 1))
def test_a_commissioning_finds_the_resonance_and_a_controller_that_bears_it(
    resonance_hz: float, ratio: float, tmp_path: Path
) -> None:
    motor = unknown_drive(SEED)[1].motor
    shaft = coupling(motor.inertia_kg_m2, resonance_hz, ratio)
    drive = DriveParameters(machine=replace(motor, mechanism=Mechanism(coupling=shaft)))
    _truth, result, _spy = unknown_world(SEED, tmp_path, drive=drive, period_us=2000, without=NOT_RESTED_ON)
    assert [record.name for record in result.records if record.verdict is not StepVerdict.DONE] == []
    steps = {record.name: record.outcome for record in result.records}
    assert steps["response"].figures["resonance_hz"] == pytest.approx(shaft.resonance_hz, rel=0.03)
    assert steps["suggest"].lines[0].startswith("the resonance at ")


@pytest.mark.long
@pytest.mark.parametrize("seed", few_of([8], 0))
def test_a_resonance_between_incoherent_lines_is_told_where_both_looks_agree(
    seed: int, tmp_path: Path
) -> None:
    """Commands act at the next tick of the drive, some a tick later than others: no play does this."""
    motor = unknown_drive(seed)[1].motor
    shaft = coupling(motor.inertia_kg_m2, 205.0, 0.577)
    drive = DriveParameters(machine=replace(motor, mechanism=Mechanism(coupling=shaft)))
    without = ("turn", *NOT_RESTED_ON)
    _truth, result, _spy = unknown_world(seed, tmp_path, drive=drive, last_step="response", without=without)
    outcome = result.records[-1].outcome
    assert outcome.figures["resonance_hz"] == pytest.approx(shaft.resonance_hz, rel=0.03)
    assert any("do not act at even instants" in line for line in outcome.lines), outcome.lines


@pytest.mark.long
@pytest.mark.parametrize("draw", few_of(range(4), 1))
def test_play_is_told_as_play(draw: int, tmp_path: Path) -> None:
    """Masses between stops move without rule: a billionth of the play makes another motion."""
    random = Random(draw)
    motor = unknown_drive(SEED)[1].motor
    play_rad = 10.0 ** random.uniform(-3.0, -1.5)
    shaft = coupling(motor.inertia_kg_m2, random.uniform(100.0, 180.0), 2.0, backlash=play_rad)
    drive = DriveParameters(machine=replace(motor, mechanism=Mechanism(coupling=shaft)))
    _truth, result, _spy = unknown_world(
        SEED, tmp_path, drive=drive, period_us=2000, last_step="response", without=NOT_RESTED_ON
    )
    response = next(record for record in result.records if record.name == "response")
    assert response.verdict is StepVerdict.DONE, response.reason
    assert "resonance_hz" not in response.outcome.figures
    assert any("play" in line for line in response.outcome.lines), response.outcome.lines
