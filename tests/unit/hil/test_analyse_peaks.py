"""``hil analyse peaks``: a controller's file where readings and commands are lost."""

import json

import pytest
from typer.testing import CliRunner, Result

from servobench.hil.cli import app

FOLDER = "examples/controllers"


def analyse(controller: str, *options: str) -> Result:
    return CliRunner().invoke(app, ["analyse", "peaks", f"{FOLDER}/{controller}", *options])


def test_each_number_of_losses_has_its_bound() -> None:
    result = analyse("ling2012-fused.toml", "--command-losses-max", "1", "--json")
    assert result.exit_code == 0, result.output
    figures = json.loads(result.stdout)
    assert (figures["controller"], figures["load_nm"]) == ("fused", 0.6)
    rows = figures["peaks"]
    lost = [(row["readings_lost_in_a_row"], row["commands_lost_in_a_row"]) for row in rows]
    assert lost == [(0, 0), (0, 1), (1, 0), (1, 1)]
    for row in rows:
        assert row["peak_found_rad_s"] <= row["peak_certified_rad_s"] < 1.01 * row["peak_found_rad_s"]
    found = [row["peak_found_rad_s"] for row in rows]
    assert found == sorted(found)


def test_a_range_of_inertias_holds_the_peaks_of_each_of_them() -> None:
    def row(inertias: str) -> tuple[float, float]:
        options = ("--losses-max", "0", "--inertia-percent", inertias, "--json")
        last = json.loads(analyse("ling2012-fused.toml", *options).stdout)["peaks"][-1]
        return last["peak_certified_rad_s"], last["peak_found_rad_s"]

    certified, found = row("70,130")
    assert found <= certified < 1.01 * found
    each = [row(f"{one},{one}")[1] for one in (70, 85, 100, 130)]
    assert max(each) <= certified
    assert each == sorted(each, reverse=True)
    assert max(each) > 0.99 * found


@pytest.mark.parametrize("typed", ["130,70", "70", "0,100", "70,130,200", "x,1", "nan,nan", "70,inf"])
def test_what_is_no_range_of_inertias_is_refused(typed: str) -> None:
    result = analyse("ling2012-fused.toml", "--inertia-percent", typed)
    assert result.exit_code == 2
    said = " ".join(result.stderr.split())
    assert "--inertia-percent" in said
    assert "LEAST,MOST in percent" in said


def test_peaks_are_those_of_the_load_that_is_asked_for() -> None:
    options = ("--losses-max", "0", "--json", "--load-nm")
    one, two = (
        json.loads(analyse("ling2012-predictor.toml", *options, load).stdout) for load in ("0.6", "1.2")
    )
    assert two["peaks"][0]["peak_found_rad_s"] == pytest.approx(2.0 * one["peaks"][0]["peak_found_rad_s"])


def test_where_nothing_is_proved_the_row_says_so() -> None:
    text = analyse("ling2012-hinf.toml", "--losses-max", "2").stdout
    assert "no norms were found" in text


def test_a_controller_without_a_design_is_refused() -> None:
    result = analyse("azaiz2007-speed.toml")
    assert result.exit_code == 2
    assert "one of state_feedback, predictor, fused, hinf" in " ".join(result.stderr.split())
