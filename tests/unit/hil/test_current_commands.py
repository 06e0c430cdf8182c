"""``hil design current`` and ``hil design hinf``: what their options ask for, and what comes of a design."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from servobench.design.errors import DesignError
from servobench.design.hinf import synthesis
from servobench.design.hinf.reduction import Method
from servobench.design.statespace import state_space
from servobench.drivers.bounded_file import NamedBy
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.hil.cli import app
from servobench.hil.configuration.controller_files import load_current_controller
from servobench.hil.configuration.design_files import load_weights
from servobench.hil.configuration.motor_file import load_motor
from servobench.hil.studies.current import design as studies
from servobench.hil.studies.current import pictures
from servobench.hil.studies.current.design import CurrentRequest
from tests.told import ROOT

EXAMPLES = ROOT / "examples"
MOTOR = EXAMPLES / "motors" / "azaiz2007.toml"
K_D, K_Q = (EXAMPLES / "controllers" / f"azaiz2007-k{axis}.toml" for axis in "dq")
FIGURES: dict[str, Any] = {
    "axis": "q",
    "closed_loop_norm": 0.9,
    "gamma": 1.0,
    "structure": "full",
    "robust": {"coupled": {"speed_rad_s": 300.0, "certified": True}},
}


def hil(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, ["design", *map(str, arguments)])


def refusal(result: Result) -> str:
    assert (result.exit_code, result.stdout) == (2, "")
    return result.stderr.removeprefix("hil: error: ").rstrip("\n")


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The requests; a design that is made up answers them."""
    requests: list[Any] = []
    result = SimpleNamespace(figures=FIGURES, chosen="the chosen")

    def design(request: CurrentRequest) -> Any:
        requests.append(request)
        return result

    def draw(chosen: str, path: Path) -> None:
        path.write_text(f"picture of {chosen}\n")

    monkeypatch.setattr(studies, "design_current", design)
    monkeypatch.setattr(studies, "controller_text", lambda done, axis: f"{axis} of {done.chosen}\n")
    monkeypatch.setattr(pictures, "draw_bounds", draw)
    return requests


def test_a_controller_is_asked_for_by_the_rules_where_nothing_else_is_said(asked: list[Any]) -> None:
    assert hil("current", MOTOR, "--axis", "q").exit_code == 0
    motor = load_motor(MOTOR).parameters
    plain: dict[str, Any] = dict.fromkeys(
        ("weights", "gamma", "gamma_factor", "order", "rate_hz", "modulus_margin", "other", "speed_max_rad_s")
    )
    assert asked == [
        CurrentRequest(
            motor=motor, axis="q", structure="full", method=Method.TRUNCATE, delay_samples=1, discrete=False,
            decoupling_factor=1.0, advance_periods=None, **plain,
        )
    ]  # fmt: skip


def test_the_options_of_a_controller_are_its_request(asked: list[Any]) -> None:
    weights = EXAMPLES / "weights" / "azaiz2007-q.toml"
    hil(
        "current", MOTOR, "--axis", "d", "--weights", weights, "--gamma-factor", "1.25", "--structure",
        "pi+pole", "--reduce", "2", "--reduce-by", "paper", "--sample-rate-hz", "16000", "--delay-samples",
        "2", "--discrete", "--modulus-margin", "0.5", "--other", K_Q, "--speed-rpm", "600",
        "--decoupling-factor", "0.75", "--advance-periods", "1.5",
    )  # fmt: skip
    (request,) = asked
    other = request.other
    assert request == CurrentRequest(
        motor=load_motor(MOTOR).parameters, axis="d", weights=load_weights(weights), gamma=None,
        gamma_factor=1.25, structure="pi+pole", order=2, method=Method.PAPER, rate_hz=16_000.0,
        delay_samples=2, discrete=True, modulus_margin=0.5, other=other, decoupling_factor=0.75,
        speed_max_rad_s=600.0 * RAD_S_PER_RPM, advance_periods=1.5,
    )  # fmt: skip
    loaded = load_current_controller(K_Q, NamedBy("K_q", "", ""), "q")
    assert np.array_equal(other.controller.A, loaded.continuous().A)
    assert other.crossover_rad_s == (loaded.prewarp_rad_s if loaded.kind == "continuous" else 0.0)
    hil("current", MOTOR, "--axis", "q", "--gamma", "1.5", "--other", K_D)
    assert asked[1].gamma == 1.5
    assert np.array_equal(
        asked[1].other.controller.A, load_current_controller(K_D, NamedBy("K_d", "", ""), "d").continuous().A
    )


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (
            ("--gamma", "1", "--gamma-factor", "2"),
            "--gamma-factor: found 2.0, expected either --gamma or --gamma-factor",
        ),
        (("--discrete",), "--discrete: found True, expected --sample-rate-hz with it"),
    ],
)
def test_options_that_contradict_each_other_are_refused(
    asked: list[Any], options: tuple[str, ...], said: str
) -> None:
    assert refusal(hil("current", MOTOR, "--axis", "q", *options)) == said
    assert asked == []


def test_the_other_axis_controller_is_of_the_other_axis(asked: list[Any]) -> None:
    for axis, own, other in (("q", K_Q, "d"), ("d", K_D, "q")):
        told = refusal(hil("current", MOTOR, "--axis", axis, "--other", own))
        assert told == f"--other: found 'a controller for the {axis} axis', expected one for the {other} axis"
    assert asked == []


def test_a_design_that_cannot_be_had_is_told_with_its_axis(
    asked: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(_request: Any) -> Any:
        raise DesignError("no norm is small enough")

    monkeypatch.setattr(studies, "design_current", fails)
    assert refusal(hil("current", MOTOR, "--axis", "d")) == "axis d: no norm is small enough"
    assert asked == []


def test_a_design_is_printed_written_and_drawn(asked: list[Any], tmp_path: Path) -> None:
    out, picture = tmp_path / "k.toml", tmp_path / "k.png"
    told = hil("current", MOTOR, "--axis", "d", "--out", out, "--picture", picture)
    assert told.stdout.splitlines() == [
        f"{'axis':<28} q",
        f"{'closed_loop_norm':<28} 0.9",
        f"{'gamma':<28} 1",
        f"{'structure':<28} full",
        "robust",
        "  coupled",
        f"    {'speed_rad_s':<28} 300",
        f"    {'certified':<28} True",
        "",
        "Both axes stay stable at 300 rad/s over +-50 % of r, L_d and L_q.",
    ]
    assert told.stderr == f"written {out}\nwritten {picture}\n"
    assert (out.read_text(), picture.read_text()) == ("d of the chosen\n", "picture of the chosen\n")
    plain = hil("current", MOTOR, "--axis", "d", "--json")
    assert (json.loads(plain.stdout), plain.stderr, len(asked)) == (FIGURES, "", 2)


# ---- hinf ---------------------------------------------------------------------------------------------

PLANT = "A = [[-1.0]]\nB = [[1.0, 1.0]]\nC = [[1.0], [1.0]]\nD = [[0.0, 0.0], [0.0, 0.0]]\n"
CONTROLLER = state_space([[-1.5, 2.0], [0.0, -3.25]], [[1.0], [0.0]], [[0.125, 1e-7]], [[0.0]])


@pytest.fixture
def plant(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Of a least norm of 2, whose synthesis gives the norm that was asked for."""

    def synthesise(_plant: Any, gamma: float) -> Any:
        return SimpleNamespace(controller=CONTROLLER, gamma=gamma)

    monkeypatch.setattr(synthesis, "gamma_min", lambda _plant: 2.0)
    monkeypatch.setattr(synthesis, "synthesise", synthesise)
    monkeypatch.setattr(synthesis, "verified_norm", lambda _plant, found: found.D[0, 0] + 1.75)
    path = tmp_path / "plant.toml"
    path.write_text(f"{PLANT}controls = 1\nmeasurements = 1\n")
    return path


def test_the_central_controller_is_printed_row_by_row(plant: Path) -> None:
    assert hil("hinf", plant, "--gamma-factor", "1.5").stdout.splitlines() == [
        f"{'gamma_min':<28} 2",
        f"{'gamma':<28} 3",
        f"{'closed_loop_norm':<28} 1.75",
        "A   -1.5  2",
        "    0  -3.25",
        "B   1",
        "    0",
        "C   0.125  1e-07",
        "D   0",
    ]


@pytest.mark.parametrize(
    ("options", "gamma"), [((), 2.2), (("--gamma", "2.5"), 2.5), (("--gamma-factor", "1"), 2.0)]
)
def test_a_norm_is_stated_or_in_proportion_to_the_least(
    plant: Path, options: tuple[str, ...], gamma: float
) -> None:
    assert json.loads(hil("hinf", plant, *options, "--json").stdout) == {
        "gamma_min": 2.0,
        "gamma": pytest.approx(gamma),
        "closed_loop_norm": 1.75,
        "controller": {
            "A": [[-1.5, 2.0], [0.0, -3.25]],
            "B": [[1.0], [0.0]],
            "C": [[0.125, 1e-7]],
            "D": [[0.0]],
        },
    }


def test_a_synthesis_that_fails_is_told_with_its_file(plant: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(_plant: Any) -> float:
        raise DesignError("not stabilisable")

    monkeypatch.setattr(synthesis, "gamma_min", fails)
    assert refusal(hil("hinf", plant)) == f"{plant}: not stabilisable"
