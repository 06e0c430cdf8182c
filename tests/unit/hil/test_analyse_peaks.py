"""``hil analyse peaks``: a controller's file where readings and commands are lost."""

import json

import pytest
from typer.testing import CliRunner, Result

from servobench.hil.cli import app

FOLDER = "examples/controllers"


def analyse(controller: str, *options: str) -> Result:
    return CliRunner().invoke(app, ["analyse", "peaks", f"{FOLDER}/{controller}", *options])


@pytest.mark.long
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


def test_delays_of_a_range_bear_each_of_them_and_more() -> None:
    def row(*options: str) -> dict[str, float]:
        said = analyse("ling2012-fused.toml", "--losses-max", "0", *options, "--json")
        assert said.exit_code == 0, said.output
        figures = json.loads(said.stdout)
        asked = [float(each) for each in options[1].split(",")] if options else None
        assert figures["delay_ms"] == (asked and pytest.approx(asked))
        last: dict[str, float] = figures["peaks"][-1]
        return last

    varying = row("--delay-ms", "1,1.1")
    assert varying["peak_found_rad_s"] <= varying["peak_certified_rad_s"] < 1.02 * varying["peak_found_rad_s"]
    each = [row("--delay-ms", f"{one},{one}")["peak_found_rad_s"] for one in ("1", "1.1")]
    assert max(each) <= varying["peak_certified_rad_s"]
    assert each[1] == pytest.approx(row()["peak_found_rad_s"])


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        ("1,0.7", "LEAST,MOST in milliseconds"),
        ("0.7", "LEAST,MOST in milliseconds"),
        ("x,1", "LEAST,MOST in milliseconds"),
        ("-1,1", "LEAST,MOST in milliseconds"),
    ],
)
def test_what_is_no_range_of_delays_is_refused(typed: str, said: str) -> None:
    result = analyse("ling2012-fused.toml", f"--delay-ms={typed}")
    assert result.exit_code == 2
    assert said in " ".join(result.stderr.split())


def test_delays_on_both_sides_of_a_sample_are_not_certified_and_the_row_says_why() -> None:
    text = analyse("ling2012-hinf.toml", "--losses-max", "0", "--delay-ms", "0.7,1.2").stdout
    assert "expected no sample between the two" in " ".join(text.split())


@pytest.mark.parametrize("typed", ["130,70", "70", "0,100", "70,130,200", "x,1", "nan,nan", "70,inf"])
def test_what_is_no_range_of_inertias_is_refused(typed: str) -> None:
    result = analyse("ling2012-fused.toml", "--inertia-percent", typed)
    assert result.exit_code == 2
    said = " ".join(result.stderr.split())
    assert "--inertia-percent" in said
    assert "LEAST,MOST in percent" in said


def test_the_slowest_decay_is_bounded_over_the_same_sequences() -> None:
    said = analyse("ling2012-hinf.toml", "--losses-max", "2", "--decay", "--json")
    assert said.exit_code == 0, said.output
    none, one, two = json.loads(said.stdout)["peaks"]
    assert none["decay_certified_per_s"] > 1.5 * one["decay_certified_per_s"]
    for row in (none, one):
        assert 0.95 * row["decay_found_per_s"] < row["decay_certified_per_s"] <= row["decay_found_per_s"]
    assert "a pattern is known that destabilises the loop" in two["decay_not_certified"]


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
