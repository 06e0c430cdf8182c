"""The steps from a motor and weights to a current controller: what each is given, and which comes out."""

from types import SimpleNamespace
from typing import Any

import pytest

from servobench.hil.studies.current import design as studies
from tests.unit.hil.made_analyses import MARGINS
from tests.unit.hil.test_current_studies import MOTOR, OTHER, request


class Steps:
    """Of a design: what came to what."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.asked: list[Any] = []
        answers: dict[str, Any] = {
            "rule_weights": lambda _motor, axis: f"rules of {axis}",
            "axis_plant": lambda *values: values,
            "axis_gamma_min": lambda *_: 0.8,
            "design_axis": lambda _, axis, weights, gamma: self.design(f"{axis}, {weights}, {gamma:g}"),
            "tune": lambda _, weights, structure, rate: (f"{structure.value} at {rate:g}", weights),
            "describe": lambda _plant, _weights, tuned, least: self.design(f"{tuned}, {least:g}"),
            "reduced_design": lambda design, order, _: self.design(f"{design.name}, order {order}"),
            "design_figures": lambda chosen, reduced: {
                "of": chosen.name,
                "reduced": reduced and reduced.name,
            },
            "robust_figures": self._noting("its box"),
            "sampled_design": self._noting(("K", "sampled")),
        }
        for name, answer in answers.items():
            monkeypatch.setattr(studies, name, answer)

    def _noting(self, answer: Any) -> Any:
        def asked(*given: Any) -> Any:
            self.asked.append(given)
            return answer

        return asked

    @staticmethod
    def design(name: str) -> Any:
        return SimpleNamespace(name=name, closed_loop_norm=0.9, margins=MARGINS, controller=f"K of {name}")


@pytest.fixture
def steps(monkeypatch: pytest.MonkeyPatch) -> Steps:
    return Steps(monkeypatch)


def test_a_full_design_is_looked_at_in_its_box(steps: Steps) -> None:
    done = studies.design_current(request(rate_hz=None))
    assert done.full is done.chosen
    assert done.figures == {
        "of": "q, rules of q, 1",
        "reduced": None,
        "axis": "q",
        "structure": "full",
        "gamma": 1.0,
        "gamma_full_order": 0.9,
        "robust": "its box",
    }
    assert done.sampled is None
    ((motor, axis, chosen, other, speed),) = steps.asked
    assert (motor, axis, chosen, speed) == (MOTOR, "q", done.full, MOTOR.rated_speed_rad_s)
    assert other.controller == "K of d, rules of d, 1, order 3"
    assert other.crossover_rad_s == MARGINS.phase_margin_rad_s


def test_a_structure_is_tuned_reduced_and_sampled(steps: Steps) -> None:
    asked = request(
        axis="d", structure="pi", order=2, weights="mine", gamma=1.5, other=OTHER, speed_max_rad_s=99.0
    )
    done: Any = studies.design_current(asked)
    assert done.full.name == "d, mine, 1.5"
    assert done.chosen.name == "pi at 30, 0.8, order 2"
    assert (done.figures["of"], done.figures["reduced"]) == ("pi at 30, 0.8", "pi at 30, 0.8, order 2")
    assert (done.sampled, done.figures["sampled"], done.figures["structure"]) == ("K", "sampled", "pi")
    robust, sampled = steps.asked
    assert robust == (MOTOR, "d", done.chosen, OTHER, 99.0)
    assert sampled == (asked, 1.5, done.chosen, OTHER, 99.0)


def test_by_the_rules_the_other_axis_of_d_is_q(steps: Steps) -> None:
    studies.design_current(request(axis="d", rate_hz=None))
    assert steps.asked[0][3].controller == "K of q, rules of q, 1, order 3"
