"""H-infinity synthesis: the paper's numbers, properties on random plants, and what each failure says."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from servobench.design.current.current_design import rule_weights
from servobench.design.errors import InfeasibleDesign, SingularPlant
from servobench.design.hinf import synthesis
from servobench.design.hinf.feasibility import evaluated
from servobench.design.hinf.mixed_sensitivity import (
    GeneralisedPlant,
    Weight,
    Weights,
    axis_plant,
    error_weight,
    mixed_sensitivity,
)
from servobench.design.hinf.riccati import NoRiccatiSolution, RiccatiSolution, stabilising_solution
from servobench.design.hinf.synthesis import gamma_min, synthesise, verified_norm
from servobench.design.papers.azaiz2007 import MOTOR
from servobench.design.statespace import StateSpace, state_space, zpk
from tests.draws import few_of
from tests.unit.design.hinf_plants import badly_scaled, random_plant, stiff_plant, with_weak_control

PLANTS = {
    axis: mixed_sensitivity(axis_plant(0.6, L), rule_weights(MOTOR, axis))
    for axis, L in (("q", 2.8e-3), ("d", 1.4e-3))
}


@pytest.mark.parametrize(
    ("axis", "gain", "poles"),
    [
        ("q", 49.7026, [0.01174, 2470.6, 2470.6, 2.717e6]),
        ("d", 2.7364, [0.0040, 1258.4, 1258.4, 1.155e7]),
    ],
)
def test_the_paper_s_controllers(axis: str, gain: float, poles: list[float]) -> None:
    """(68), (70), (71): printed to five figures, the slow pole of K_d to two."""
    form = zpk(synthesise(PLANTS[axis], 1.0).controller)
    assert form.gain == pytest.approx(gain, rel=2e-5)
    assert np.abs(form.poles) == pytest.approx(poles, rel=1.1e-2)
    assert np.abs(form.zeros[:2]) == pytest.approx([214.2857 if axis == "q" else 428.571, 5e4], rel=1e-5)


def test_the_paper_s_riccati_figures() -> None:
    """Section 3.3: the modes of E_x - W_x X and of E_y - W_y Y, and Y = 0."""
    # (44) to (46), the latter's pole read as 271.35e4
    printed = Weights(
        Weight(1 / 1.51, 177.3493, 0.0117), Weight(25.0, 1e3, 5e4), Weight(1e4, 135.68, 271.35e4)
    )
    found = synthesise(mixed_sensitivity(axis_plant(0.6, 2.8e-3), printed), 1.0)
    modes = sorted(np.abs(found.state_feedback_modes))
    assert modes[-2:] == pytest.approx([2807.3204, 2.7173e6], rel=2e-4)
    assert modes[:2] == pytest.approx([abs(complex(167.4581, 65.6802))] * 2, rel=2e-3)
    assert sorted(-found.observer_modes.real) == pytest.approx([0.0117, 214.2857, 5e4, 271.35e4], rel=1e-6)
    assert np.abs(found.Y).max() < 1e-9


def test_gamma_min_of_badly_scaled_plants() -> None:
    """Poles from 1e-2 to 3e6 rad/s; figures of an independent bisection with another library."""
    assert gamma_min(PLANTS["q"]) == pytest.approx(0.9517608, rel=1e-6)
    assert gamma_min(PLANTS["d"]) == pytest.approx(0.6463218, rel=1e-6)


@pytest.mark.long
@pytest.mark.parametrize("seed", few_of(range(40), 8))
def test_the_controller_holds_what_its_gamma_promises(seed: int) -> None:
    plant = random_plant(seed)
    least = gamma_min(plant)
    gamma = 1.05 * least + 1e-6
    found = synthesise(plant, gamma)
    assert verified_norm(plant, found.controller) < gamma * (1.0 + 1e-7)
    if least > 1e-3:
        with pytest.raises(InfeasibleDesign, match="gamma_min is"):
            synthesise(plant, 0.999 * least)


@pytest.mark.parametrize("seed", few_of(range(12), 4))
def test_every_parameter_below_gamma_gives_a_controller(seed: int) -> None:
    """Theorem 2, with a constant and with a dynamic Phi, and the direct gain D22 undone."""
    plant = random_plant(seed)
    gamma = 1.5 * gamma_min(plant) + 0.1
    found = synthesise(plant, gamma)
    m2, p2 = plant.controls, plant.measurements
    constant = state_space([], [], [], 0.6 * gamma * np.eye(m2, p2))
    lag = StateSpace(np.array([[-3.0]]), np.ones((1, p2)), np.ones((m2, 1)), np.zeros((m2, p2)))
    for parameter in (constant, lag.scaled(gamma / np.sqrt(m2 * p2))):
        controller = found.with_parameter(parameter)
        assert verified_norm(plant, controller) < gamma * (1.0 + 1e-6)
    with pytest.raises(ValueError, match="below gamma"):
        found.with_parameter(constant.scaled(2.0))


def _plant(
    A: list[list[float]], B: list[list[float]], C: list[list[float]], D: list[list[float]]
) -> GeneralisedPlant:
    return GeneralisedPlant(state_space(A, B, C, D), 1, 1)


@pytest.mark.parametrize(
    ("assumption", "plant"),
    [
        # x1 = 1/(s - 1) w, which no control moves
        ("A1", _plant([[1.0]], [[1.0, 0.0]], [[1.0], [0.0], [1.0]], [[0.0, 0.0], [0.0, 1.0], [1.0, 0.0]])),
        # an unstable mode that no measurement shows
        ("A1", _plant([[1.0]], [[1.0, 1.0]], [[1.0], [0.0], [0.0]], [[0.0, 0.0], [0.0, 1.0], [1.0, 0.0]])),
        # no weight on the control at high frequency
        ("A2", _plant([[-1.0]], [[1.0, 1.0]], [[1.0], [0.0], [1.0]], [[0.0, 0.0], [0.0, 0.0], [1.0, 0.0]])),
        # no disturbance in the measurement
        ("A2", _plant([[-1.0]], [[1.0, 1.0]], [[1.0], [0.0], [1.0]], [[0.0, 0.0], [0.0, 1.0], [0.0, 0.0]])),
        # an integrator that no error sees
        ("A3", _plant([[0.0]], [[1.0, 1.0]], [[0.0], [0.0], [1.0]], [[0.0, 0.0], [0.0, 1.0], [1.0, 0.0]])),
        # an integrator that no disturbance excites
        ("A4", _plant([[0.0]], [[0.0, 1.0]], [[1.0], [0.0], [1.0]], [[0.0, 0.0], [0.0, 1.0], [1.0, 0.0]])),
    ],
)
def test_each_broken_assumption_is_named_with_a_remedy(assumption: str, plant: GeneralisedPlant) -> None:
    with pytest.raises(SingularPlant) as raised:
        gamma_min(plant)
    assert raised.value.assumption == assumption
    assert raised.value.remedy in str(raised.value)


@pytest.mark.parametrize("seed", few_of(range(1000, 1015), 4))
def test_units_of_states_and_of_time_change_nothing(seed: int) -> None:
    """Sixteen decades between the states' sizes, eight between the rates."""
    assert gamma_min(badly_scaled(seed)) == pytest.approx(gamma_min(random_plant(seed)), rel=1e-8)


# by the same theorem in 50 digits, another program
STIFF = {
    1000: 0.723206895,
    1001: 2.54167443,
    1002: 2.13620542,
    1003: 0.573731803,
    1004: 2.25761203,
    1005: 2.12543647,
    1006: 2.52752775,
    1007: 0.804606491,
    1008: 2.09660095,
    1009: 3.93226189,
    1010: 1.0458678,
    1011: 1.5764232,
}


@pytest.mark.parametrize("seed", few_of([*STIFF], 4))
def test_modes_eight_decades_apart(seed: int) -> None:
    plant = stiff_plant(seed)
    assert gamma_min(plant) == pytest.approx(STIFF[seed], rel=1e-6)
    gamma = 1.02 * STIFF[seed]
    assert verified_norm(plant, synthesise(plant, gamma).controller) < gamma * (1.0 + 1e-6)


@pytest.mark.parametrize("seed", few_of([100, 101, 104, 106, 109], 2))
def test_a_limit_where_eigenvalues_meet_on_the_axis_is_not_halved(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """X or Y exists no more below the limit, and is finite at it; halving would need 33 steps for 1e-10."""
    tried = set()

    def counted(problem: Any, gamma: float, thorough: bool = True) -> Any:
        tried.add(gamma)
        return evaluated(problem, gamma, thorough)

    monkeypatch.setattr(synthesis, "evaluated", counted)
    least = gamma_min(stiff_plant(seed))
    assert len(tried) <= 26
    assert max(gamma for gamma in tried if gamma < least) > least * (1.0 - 1e-10)


def test_a_riccati_equation_by_hand() -> None:
    """X = 1/3 of -2 X - 3 X^2 + 1; with W = -2 the eigenvalues of H are +-j, which met at 0."""
    one = np.ones((1, 1), dtype=np.longdouble)
    solution = stabilising_solution(-one, 3 * one, one, np.ones((1, 1)))
    assert isinstance(solution, RiccatiSolution)
    assert float(solution.X[0, 0]) == pytest.approx(1.0 / 3.0, rel=1e-15)
    assert solution.closed_loop == pytest.approx([-2.0])
    missing = stabilising_solution(-one, -2 * one, one, np.ones((1, 1)))
    assert isinstance(missing, NoRiccatiSolution)
    assert (abs(missing.centre), missing.half_gap) == pytest.approx((0.0, 1.0), abs=1e-12)


@pytest.mark.parametrize("seed", few_of([1000, 1001, 1002, 1003, 1007, 1010, 1011, 1014], 3))
def test_a_nearly_singular_plant_keeps_its_promise(seed: int) -> None:
    """D12 a hundred thousandth of its size."""
    plant = with_weak_control(random_plant(seed), 1e-5)
    gamma = 1.02 * gamma_min(plant)
    assert verified_norm(plant, synthesise(plant, gamma).controller) < gamma * (1.0 + 1e-6)


def test_a_plant_that_rounding_makes_singular_is_refused_by_name() -> None:
    with pytest.raises(SingularPlant, match="larger direct weight") as raised:
        gamma_min(with_weak_control(random_plant(1005), 1e-5))
    assert raised.value.assumption == "A2 or A3"


def test_a_slow_weight_beside_a_fast_one_is_no_integrator() -> None:
    """A static error of 1e-12 puts w1's pole eighteen decades below w3's."""
    rules = rule_weights(MOTOR, "d")
    plants = [
        mixed_sensitivity(
            axis_plant(0.6, 1.4e-3), replace(rules, error=error_weight(50.0, 1.7, static_error))
        )
        for static_error in (1e-6, 1e-8, 1e-10, 1e-12)
    ]
    least = [gamma_min(plant) for plant in plants]
    assert least[1:] == pytest.approx([least[0]] * 3, rel=3e-6)


@pytest.mark.parametrize(("controls", "measurements"), [(0, 1), (3, 1), (1, 0), (1, 2)])
def test_a_plant_without_one_of_its_signals_is_none(controls: int, measurements: int) -> None:
    system = state_space([[-1.0]], [[1.0, 1.0, 1.0]], [[1.0], [1.0]], np.zeros((2, 3)))
    with pytest.raises(
        ValueError, match=f"{controls} controls of 3 inputs, {measurements} measurements of 2"
    ):
        GeneralisedPlant(system, controls, measurements)
    GeneralisedPlant(system, 2, 1)


def test_a_sampled_plant_is_refused() -> None:
    system = state_space([[0.5]], [[1.0, 1.0]], [[1.0], [1.0]], np.zeros((2, 2)), period_s=1e-3)
    with pytest.raises(ValueError, match="continuous plant"):
        GeneralisedPlant(system, 1, 1)
