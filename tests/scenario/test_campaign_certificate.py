"""Campaigns held against the certificate of their controller: kept, left, and a counter-example."""

import json
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from servobench.hil.campaign.campaign import CounterExample, NothingCertified, run_campaign
from servobench.hil.cli import app
from servobench.hil.configuration.config_files import toml_text
from servobench.hil.testing.campaign_runs import CampaignRunner

EXAMPLES = Path(__file__).parents[2] / "examples"
NETWORK_K = EXAMPLES / "controllers" / "network-k.toml"
DELAY = "faults.delay.0.delay_max_us"
CHANGES = {
    "bench.duration_s": 1.2,
    "reference.axis1.0.at_s": 0.05,
    "load.axis1.0.at_s": 0.8,
    "loop.command_readback": "event",
    # no statusword keeps a SYNC waiting: the certificate is for a constant period
    "drive.axis1.simulation.lacks": ["1400:5"],
}


def sweep(seeds: int = 2, change: dict[str, Any] | None = None, **more: Any) -> dict[str, Any]:
    bench = str(EXAMPLES / "network_designed.toml")
    campaign = {"name": "held", "bench": bench, "seeds": seeds, "allow_uncertified": True}
    return {
        "campaign": {**campaign, "failures_recorded": 0},
        "change": CHANGES | (change or {}),
        **more,
    }


def boasting(folder: Path, gain: float) -> dict[str, str]:
    """The bench's controller with ``gain`` certified in place of 17 rad/s per N m."""
    path = folder / "boasting.toml"
    told = NETWORK_K.read_text()
    for name in ("gain_certified", "gain_certified_all_bandwidths"):
        place = told.index(f"{name} = ")
        told = told[:place] + f"{name} = {gain}" + told[told.index("\n", place) :]
    path.write_text(told)
    return {"drive.axis1.controller": str(path)}


def test_runs_within_keep_what_is_certified_and_others_say_what_they_left(
    servo_campaign: CampaignRunner,
) -> None:
    inertia = "drive.axis1.motor.mechanics.inertia_kg_m2"
    rows = [[1000, 8e-4], [1700, 8e-4], [1000, 9e-4]]
    done = servo_campaign(sweep(vary=[{"keys": [DELAY, inertia], "rows": rows}]))
    table = done.table.to_pylist()
    assert [row["certificate"] for row in table] == ["kept", "premise left", "premise left"] * 2
    assert [row["premises_left"].partition(":")[0] for row in table[:3]] == [
        "",
        "delay",
        "drive.axis1.controller.made_for.plant.inertia_kg_m2",
    ]
    assert 0.0 < table[0]["load_gain_least_rad_s_nm"] < table[0]["load_gain_rad_s_nm"] < 17.0
    done.assert_certificate()


def test_a_counter_example_ends_the_campaign_and_is_told_with_its_replay(tmp_path: Path) -> None:
    path = tmp_path / "sweep.toml"
    vary = [{"key": DELAY, "values": [1700, 1000]}]
    path.write_text(toml_text(sweep(4, boasting(tmp_path, 5.0), vary=vary)))
    out = tmp_path / "out"
    command = ["campaign", str(path), "--out", str(out), "--workers", "1", "--against", "certificate"]
    for resumed in ([], ["--resume"]):
        ran = CliRunner().invoke(app, [*command, *resumed, "--json"])
        assert ran.exit_code == 7, ran.output
        assert f"hil campaign replay {out} --run 1" in ran.stderr
        assert "certified 5" in ran.stderr
        found = json.loads(ran.stdout)
        assert found["certificate"]["runs"] == {"exceeded": 1, "premise left": 1}
        assert found["certificate"]["premises"] == {"delay": 1}
        assert found["certificate"]["nearest_run"] == 1
    again = CliRunner().invoke(
        app, ["campaign", "replay", str(out), "--run", "1", "--into", str(tmp_path / "r")]
    )
    assert again.exit_code == 0, again.output
    reviewed = CliRunner().invoke(app, ["review", str(tmp_path / "r"), "--json"])
    assert reviewed.exit_code == 1, "the review of that run comes to the same"
    assert "certified_gain_rad_s_nm = 5" in reviewed.stdout
    whole = run_campaign(path, tmp_path / "whole", workers=1)
    assert whole.table.num_rows == 8
    with pytest.raises(CounterExample, match="run 1 kept all premises"):
        whole.hold_certificate()
    with pytest.raises(AssertionError, match="run 1 kept all premises"):
        whole.assert_certificate()


def test_a_campaign_outside_of_all_premises_holds_nothing(tmp_path: Path) -> None:
    path = tmp_path / "sweep.toml"
    path.write_text(toml_text(sweep(1, {"loop.command_readback": "sync"})))
    done = run_campaign(path, tmp_path / "out", workers=1, against_certificate=True)
    with pytest.raises(NothingCertified, match="1 premises not known"):
        done.hold_certificate()
    (row,) = done.table.to_pylist()
    assert row["premises_unknown"].startswith("delay: ")
