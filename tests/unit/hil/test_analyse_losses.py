"""``hil analyse losses``: a controller's file on a network file."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from servobench.hil.cli import app

HINF = "examples/controllers/ling2012-hinf.toml"
NETWORK = """\
[network]
period_us = 1000
losses_in_a_row_max = 5
delay_max_us = 1000
"""
BURSTS = """\
[network.reading_losses]
p_good_to_bad = 0.02
p_bad_to_good = 0.5
loss_bad = 0.8
loss_good = 0.001
"""


def analyse(folder: Path, network: str, *options: str, controller: str = HINF) -> Result:
    file = folder / "network.toml"
    file.write_text(network, encoding="utf-8")
    return CliRunner().invoke(app, ["analyse", "losses", controller, "--network", str(file), *options])


def test_figures_of_a_file_are_told_for_its_own_load_step(tmp_path: Path) -> None:
    result = analyse(
        tmp_path, NETWORK + BURSTS, "--json", "--threshold-rad-s", "2.5", "--threshold-rad-s", "4"
    )
    assert result.exit_code == 0, result.output
    figures = json.loads(result.stdout)
    assert figures["stable_in_mean_square"]
    assert figures["load_nm"] == 0.6
    assert figures["reading_losses"]["share"] == pytest.approx(0.02 / 0.52 * 0.8 + 0.5 / 0.52 * 0.001)
    less, more = figures["exceedance"]
    assert 0.0 < more["probability_least"] <= more["probability_most"] < less["probability_least"] < 0.1
    assert max(figures["after_step"]["deviations_rad_s"]) == pytest.approx(
        figures["after_step"]["deviation_largest_rad_s"], rel=0.1
    )


def test_on_the_terminal_courses_over_time_are_left_out(tmp_path: Path) -> None:
    text = analyse(tmp_path, NETWORK + BURSTS).stdout
    assert "deviation_largest_rad_s" in text
    assert "deviations_rad_s" not in text


def test_a_share_alone_counts_as_independent_losses(tmp_path: Path) -> None:
    share = NETWORK + "loss_percent = 10.0\n"
    chain = NETWORK + BURSTS.replace("0.02", "0.0").replace("0.001", "0.1")
    first, second = (json.loads(analyse(tmp_path, each, "--json").stdout) for each in (share, chain))
    assert first["exceedance"] == second["exceedance"]


@pytest.mark.parametrize(
    ("network", "controller", "words"),
    [
        (NETWORK, HINF, "network.reading_losses"),
        (NETWORK.replace("= 1000", "= 2000", 1) + BURSTS, HINF, "network.period_us"),
        (NETWORK + BURSTS, "examples/controllers/azaiz2007-speed.toml", "controller.kind"),
        (NETWORK + 'commands = "not measured"\n' + BURSTS, HINF, "network.commands"),
    ],
)
def test_what_cannot_be_analysed_is_refused(
    tmp_path: Path, network: str, controller: str, words: str
) -> None:
    result = analyse(tmp_path, network, controller=controller)
    assert result.exit_code == 2
    assert words in str(result.exception) + result.output
