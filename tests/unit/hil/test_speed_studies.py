"""[Ling2012] from the command line: analysis and design of a speed feedback."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from servobench.hil.cli import app

pytestmark = pytest.mark.long

EXAMPLES = Path(__file__).parents[3] / "examples"
MOTOR = str(EXAMPLES / "motors" / "ling2012.toml")
GAIN = "0,-0.0212"
LOOP_KEYS = {
    "stable", "gamma_exact", "gamma_certified", "order", "delay_max_exact_s", "delay_max_certified_s",
    "step_peak_rad_s", "certificate",
}  # fmt: skip
SAMPLED_KEYS = {"certified", "refuted", "sequences", "sequence_certificate", "by_losses"}
WITHOUT_CURRENT_LOOP = str(2.875 / 0.0085 / math.tau)
"""R/L, Hz: the current of a drive that has none, as in the paper."""
DESIGN_KEYS = {"gain", "gamma", "delay_s", "method", "certificate", "gamma_exact"}
HAND_WRITTEN = "[network]\nperiod_us = 2000\nlosses_in_a_row_max = 1\ndelay_max_us = 1000\n"


def run(*arguments: str) -> tuple[int, str, str]:
    if "speed" in arguments[:2] and not {"--current-bandwidth-hz", "--bench"} & set(arguments):
        arguments = (*arguments, "--current-bandwidth-hz", WITHOUT_CURRENT_LOOP)
    result = CliRunner().invoke(app, list(arguments))
    return result.exit_code, result.stdout, result.stderr


def told(*arguments: str) -> dict[str, Any]:
    status, out, err = run(*arguments, "--json")
    assert status == 0, err
    found: dict[str, Any] = json.loads(out)
    return found


def test_analysis_of_the_printed_loop() -> None:
    found = told("analyse", "speed", MOTOR, "--gain", GAIN, "--delay-ms", "64", "--order", "0")
    assert set(found) >= LOOP_KEYS
    assert found["stable"] is True
    assert found["order"] == 0
    assert found["gamma_exact"] == pytest.approx(125.3141, rel=1e-6)
    assert found["gamma_certified"] == pytest.approx(135.668, rel=2e-5)
    assert found["delay_max_exact_s"] == pytest.approx(0.170369, abs=1e-6)
    assert found["delay_max_certified_s"] == pytest.approx(0.149206, abs=1e-6)
    assert found["step_peak_rad_s"] == pytest.approx(118.2951, rel=1e-5)
    assert set(found["certificate"]) == {"solver", "status", "min_margin"}
    assert found["certificate"]["min_margin"] > 0.0


def test_the_theorems_as_printed_say_what_order_0_does() -> None:
    asked = ("analyse", "speed", MOTOR, "--gain", GAIN, "--as-printed")
    printed = told(*asked, "--delay-ms", "64")["as_printed"]
    assert printed["theorem_3_1_stable"] is True
    assert printed["theorem_3_3_gamma"] == pytest.approx(135.668, rel=2e-5)
    assert printed["order_0_gamma"] == pytest.approx(135.668, rel=2e-5)
    stable = told(*asked, "--delay-ms", "155")["as_printed"]  # beyond what order 0 proves
    assert stable == {"theorem_3_1_stable": False, "theorem_3_3_gamma": None, "order_0_gamma": None}
    assert told(*asked, "--delay-ms", "200")["as_printed"] == stable  # not even stable
    assert "as_printed" not in told(*asked[:-1], "--delay-ms", "64")


def test_order_is_raised_until_it_is_close() -> None:
    found = told(
        "analyse",
        "speed",
        MOTOR,
        "--gain",
        GAIN,
        "--delay-ms",
        "64",
        "--load-nm",
        "0.6",
        "--speed-rpm",
        "1500",
    )
    assert found["order"] == 1
    assert found["order_limit_reached"] is False
    assert found["gamma_certified"] < 1.001 * found["gamma_exact"]
    assert found["delay_max_certified_s"] > 0.999 * found["delay_max_exact_s"]
    share = 100.0 * 0.6 / (1500.0 * np.pi / 30.0)
    assert found["percent"]["gamma_exact"] == pytest.approx(share * found["gamma_exact"])
    assert found["percent"]["step_peak"] == pytest.approx(share * found["step_peak_rad_s"])
    assert found["percent"]["step_peak"] > found["percent"]["step_peak_floor"]


def test_an_unstable_loop_is_said_to_be_one_without_infinities() -> None:
    found = told("analyse", "speed", MOTOR, "--gain", GAIN, "--delay-ms", "200")
    assert found["stable"] is False
    assert found["gamma_exact"] is None
    assert found["gamma_certified"] is None
    assert found["step_peak_rad_s"] is None
    assert found["delay_max_exact_s"] == pytest.approx(0.170369, abs=1e-6)


def test_analysis_of_the_sampled_loop() -> None:
    network = ("--period-ms", "10", "--loss-max", "5", "--tau-max-ms", "4")
    found = told(
        "analyse", "speed", MOTOR, "--gain", GAIN, "--delay-ms", "64", *network, "--strategy", "history",
        "--monte-carlo", "200", "--seed", "3",
    )  # fmt: skip
    assert set(found) >= LOOP_KEYS | SAMPLED_KEYS
    sequences = found["sequences"]
    assert found["certified"] is True
    assert sequences["decay_per_s"]["found"] == pytest.approx(7.7502, rel=1e-5)
    assert sequences["decay_per_s"]["certified"] == pytest.approx(7.7501, rel=1e-3)
    assert sequences["gain"]["found"] == pytest.approx(136.425, rel=1e-5)
    assert sequences["gain"]["certified"] == pytest.approx(136.425, rel=1e-3)
    assert sequences["gain"]["gap_percent"] < 0.1
    assert sequences["step_peak_rad_s"]["certified"] >= sequences["step_peak_rad_s"]["found"]
    assert sequences["step_peak_rad_s"]["gap_percent"] < 6.0
    assert found["monte_carlo"]["diverged"]["value"] == 0.0
    peaks = found["monte_carlo"]["peak_rad_s"]
    assert peaks["p50"]["low"] <= peaks["p50"]["value"] <= peaks["p99"]["value"]


def test_without_a_delay_the_sampled_loop_s_longest_age_is_taken() -> None:
    found = told(
        "analyse", "speed", MOTOR, "--gain", GAIN, "--period-ms", "10", "--strategy", "arrival",
        "--loss-max", "1", "--tau-max-ms", "4",
    )  # fmt: skip
    assert found["delay_s"] == pytest.approx(0.024)
    assert [row["lost"] for row in found["by_losses"]] == [0, 1]
    decay = found["sequences"]["decay_per_s"]
    assert decay["certified"] <= decay["found"]
    assert found["sequences"]["decay_pattern"][0].keys() == {"delay_s", "lost_after"}


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--gain", "0;1", "--delay-ms", "1"), "--gain"),
        (("--gain", "0,nan", "--delay-ms", "1"), "--gain"),
        (("--gain", GAIN), "--delay-ms"),
        (("--gain", GAIN, "--delay-ms", "1", "--strategy", "stamp"), "--period-ms"),
        (("--gain", GAIN, "--delay-ms", "1", "--monte-carlo", "5"), "--period-ms"),
    ],
)
def test_what_cannot_be_analysed_is_bad_input(arguments: tuple[str, ...], said: str) -> None:
    status, out, err = run("analyse", "speed", MOTOR, *arguments)
    assert status == 2
    assert out == ""
    assert said in err
    assert "Traceback" not in err


def test_largest_delay_for_a_gain() -> None:
    found = told("design", "speed", MOTOR, "--gamma", "125", "--feedback", "speed")
    assert set(found) >= DESIGN_KEYS
    assert found["delay_s"] == pytest.approx(0.0653718, abs=1e-6)
    assert found["gain"][0] == 0.0
    assert found["gamma_exact"] == pytest.approx(125.0, rel=1e-6)


def test_least_gain_for_a_delay_and_the_same_in_percent() -> None:
    asked = ("--delay-ms", "64", "--feedback", "speed", "--load-nm", "0.6", "--speed-rpm", "1500")
    found = told("design", "speed", MOTOR, *asked)
    assert found["gamma"] == pytest.approx(122.9396, rel=1e-5)
    assert found["error_percent"] == pytest.approx(46.96, abs=0.01)
    percent = str(found["error_percent"] + 1.0)
    again = told("design", "speed", MOTOR, *asked, "--error-percent", percent)
    assert again["gamma"] == pytest.approx(found["gamma"], rel=1e-9)


def test_out_of_reach_names_the_best_and_what_would_do(tmp_path: Path) -> None:
    network = tmp_path / "n.toml"
    network.write_text("[network]\nperiod_us = 10000\nlosses_in_a_row_max = 2\ndelay_max_us = 1000\n")
    asked = ("--error-percent", "5", "--load-nm", "0.6", "--speed-rpm", "1500", "--feedback", "speed")
    status, out, err = run("design", "speed", MOTOR, *asked, "--network", str(network), "--json")
    assert status == 2
    assert "Traceback" not in err
    assert "out of reach" in err
    found = json.loads(out)
    assert found["feasible"] is False
    best, do = found["best"], found["would_do"]
    assert best["error_percent"] > 5.0
    assert do["loss_max"] is None
    assert do["load_nm"] == pytest.approx(0.6 * 5.0 / best["error_percent"], rel=1e-6)
    assert do["period_s"] == pytest.approx((do["delay_s"] - 0.001) / 3)
    # each change alone does what it says
    for change in (
        ("--load-nm", str(do["load_nm"] * 0.9999), "--delay-ms", "31"),
        ("--load-nm", "0.6", "--delay-ms", str(1e3 * do["delay_s"] * 0.9999)),
    ):
        told(
            "design",
            "speed",
            MOTOR,
            "--error-percent",
            "5",
            "--speed-rpm",
            "1500",
            "--feedback",
            "speed",
            *change,
        )


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((), "--gamma or --error-percent"),
        (("--gamma", "1", "--error-percent", "1"), "--error-percent"),
        (("--delay-ms", "1", "--network", "n.toml"), "--network"),
        (("--gamma", "125", "--method", "ccl", "--feedback", "speed"), "Algorithm 4.2 knows no other"),
        (("--network", "none.toml"), "Network file not found: none.toml"),
        (("--gamma", "125", "--integral-time-ms", "5"), "--integral"),
        (("--delay-ms", "5", "--target", "sampled"), "--network and --method exact"),
    ],
)
def test_what_cannot_be_designed_is_bad_input(arguments: tuple[str, ...], said: str) -> None:
    status, _, err = run("design", "speed", MOTOR, *arguments)
    assert status == 2
    assert said in err
    assert "Traceback" not in err


def test_a_delay_beside_a_network_is_told_in_ms(tmp_path: Path) -> None:
    network = tmp_path / "n.toml"
    network.write_text("[network]\nperiod_us = 1000\nlosses_in_a_row_max = 1\ndelay_max_us = 2000\n")
    asked = ("--structure", "predictor", "--network", str(network), "--delay-ms", "64")
    status, _, err = run("design", "speed", MOTOR, *asked)
    assert status == 2
    assert "--delay-ms: found 64.0, expected either --network or --delay-ms" in err


def test_a_loop_that_is_not_certified_gets_no_file(tmp_path: Path) -> None:
    network, out = tmp_path / "n.toml", tmp_path / "k.toml"
    network.write_text("[network]\nperiod_us = 10000\nlosses_in_a_row_max = 5\ndelay_max_us = 4000\n")
    asked = (
        "--network",
        str(network),
        "--strategy",
        "stamp",
        "--delay-margin-percent",
        "0",
        "--gamma",
        "1e6",
    )
    status, _, err = run("design", "speed", MOTOR, *asked, "--out", str(out))
    assert status == 2
    assert "certified" in err
    assert not out.exists()


@pytest.mark.parametrize(("structure", "most"), [("static", 50), ("predictor", 5), ("hinf", 5)])
def test_an_outage_is_not_designed_for(tmp_path: Path, structure: str, most: int) -> None:
    network = tmp_path / "n.toml"
    network.write_text(HAND_WRITTEN.replace("max = 1\n", f"max = {most + 1}\n"))
    status, _, err = run("design", "speed", MOTOR, "--network", str(network), "--structure", structure)
    assert status == 2
    assert f"network.losses_in_a_row_max: found {most + 1}, expected at most {most}" in err


def test_a_network_written_by_hand_is_enough(tmp_path: Path) -> None:
    network = tmp_path / "n.toml"
    network.write_text(HAND_WRITTEN)
    found = told("design", "speed", MOTOR, "--network", str(network), "--feedback", "speed")
    assert found["delay_s"] == pytest.approx(0.005)
    assert found["sampled"]["certified"] is True


def test_nothing_is_designed_where_the_way_of_the_commands_is_not_known(tmp_path: Path) -> None:
    network = tmp_path / "n.toml"
    network.write_text(HAND_WRITTEN + 'commands = "not measured"\n')
    status, _, err = run("design", "speed", MOTOR, "--network", str(network))
    assert status == 2
    assert "network.commands" in err
    assert 'commands = "stated"' in err


@pytest.mark.parametrize(("delay_us", "agreed_ms"), [(1000, 6.0), (2002, 6.0), (2200, 8.0)])
def test_stamp_is_designed_for_whole_periods(tmp_path: Path, delay_us: int, agreed_ms: float) -> None:
    network = tmp_path / "n.toml"
    network.write_text(HAND_WRITTEN.replace("delay_max_us = 1000", f"delay_max_us = {delay_us}"))
    found = told(
        "design", "speed", MOTOR, "--network", str(network), "--feedback", "speed", "--strategy", "stamp"
    )
    # two periods of 2 ms for one loss, and the delay, up to the next SYNC
    assert found["sampled"]["agreed_delay_s"] == pytest.approx(1e-3 * agreed_ms)
