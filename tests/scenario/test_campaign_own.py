"""Campaigns whose runs are drawn by a function of one's own, and held against another."""

from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from servobench.drivers.errors import BadInput
from servobench.hil.campaign.campaign import FAILURES_FOLDER, Campaign, run_campaign
from servobench.hil.campaign.plan import CampaignPlan
from servobench.hil.cli import app
from servobench.hil.configuration.config_files import toml_text
from servobench.hil.control.own_code import OwnCodeFailed

ROOT = Path(__file__).parents[2]
CODE = """
LOSS = (0.0, 0.3)


def changes(seed):
    return {
        "bench.duration_s": 0.1,
        "load": {},
        "reference.axis1.0.at_s": 0.0,
        "faults": {"loss": [{"probability": LOSS[seed % 2], "direction": "drive_to_host"}]},
    }


def check(seed, run):
    ran = run()
    assert ran.config.bench.duration_s == 0.1
    readings = len(ran.wire.find("181#*", sent=False))
    if readings < 100:
        yield f"seed {seed}: {readings} readings of {ran.rows.size} cycles"


def raises(seed, run):
    run()
    raise KeyError("speed")


def twice(seed, run):
    run(), run()
    return ()


def leaves(seed, run):
    run()
    raise SystemExit
"""
COUNT = 6


def written(folder: Path, own: dict[str, str], **campaign: Any) -> Path:
    """A sweep with its code beside it."""
    (folder / "own.py").write_text(CODE)
    bench = str(ROOT / "examples" / "ling2012.toml")
    tables = {
        "campaign": {"name": "own", "bench": bench, "seeds": COUNT, "failures_recorded": 1} | campaign,
        "own": own,
    }
    path = folder / "sweep.toml"
    path.write_text(toml_text(tables))
    return path


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Campaign:
    folder = tmp_path_factory.mktemp("own")
    path = written(folder, {"changes": "own.py:changes", "check": "own.py:check"})
    return run_campaign(path, folder / "out", workers=1)


def test_findings_are_kept_by_run(done: Campaign) -> None:
    assert list(done.found) == [0, 2, 4], "first_seed is 1: the seeds with losses"
    assert done.found[2][0].startswith("seed 3: ")
    assert done.table.column("findings")[1].as_py() == []
    with pytest.raises(AssertionError, match=r"run 0: seed 1: .* readings of 100 cycles\n"):
        done.assert_nothing_found()


def test_the_first_with_findings_is_recorded_and_replayed(done: Campaign, tmp_path: Path) -> None:
    assert [each.name for each in (done.folder / FAILURES_FOLDER).iterdir()] == ["run-000000000"]
    again = Campaign.load(done.folder).replay(2, tmp_path / "again")
    assert again.findings == done.found[2], "the check looks at the recording"
    assert again.summary.digest == done.column("digest")[2]
    assert (tmp_path / "again" / "frames.arrow").exists()


def test_workers_and_an_end_on_the_way_change_nothing(done: Campaign, tmp_path: Path) -> None:
    runner, out = CliRunner(), tmp_path / "out"
    command = ["campaign", str(done.plan.source), "--out", str(out)]
    ended = runner.invoke(app, [*command, "--seconds", "0", "--workers", "1"])
    assert ended.exit_code == 1, ended.output
    assert "runs a second" in ended.stderr
    assert "the check found something in 1 runs" in ended.stdout
    assert f"hil campaign replay {out} --run 0" in ended.stdout
    assert Campaign.load(out).table.num_rows == 1
    assert runner.invoke(app, [*command, "--resume", "--workers", "2"]).exit_code == 1
    assert Campaign.load(out).table.equals(done.table)


def test_other_code_is_another_campaign(tmp_path: Path) -> None:
    path = written(tmp_path, {"check": "own.py:check"})
    before = CampaignPlan.load(path).identity
    (tmp_path / "own.py").write_text(CODE.replace("< 100", "< 99"))
    assert CampaignPlan.load(path).identity != before


@pytest.mark.parametrize(
    ("check", "message"), [("raises", "KeyError: 'speed'"), ("twice", r"run\(\) 2 times, expected once")]
)
def test_a_check_that_fails_ends_the_campaign(tmp_path: Path, check: str, message: str) -> None:
    path = written(tmp_path, {"changes": "own.py:changes", "check": f"own.py:{check}"})
    with pytest.raises(OwnCodeFailed, match=message):
        run_campaign(path, tmp_path / "out", workers=1)


@pytest.mark.parametrize("workers", ["1", "2"])
def test_a_check_that_calls_sys_exit_does_not_make_a_campaign_pass(tmp_path: Path, workers: str) -> None:
    path = written(tmp_path, {"changes": "own.py:changes", "check": "own.py:leaves"})
    ended = CliRunner().invoke(
        app, ["campaign", "run", str(path), "--out", str(tmp_path / "out"), "--workers", workers]
    )
    assert ended.exit_code == 3, ended.output
    assert "own.py:34 in leaves: SystemExit" in ended.output


@pytest.mark.parametrize("name", ["nowhere.py:check", "own.py:nothing"])
def test_code_that_is_not_there_is_refused(tmp_path: Path, name: str) -> None:
    path = written(tmp_path, {"changes": name})
    with pytest.raises(BadInput, match=r"own\.changes: found .*, expected a function"):
        run_campaign(path, tmp_path / "out", workers=1)


def test_no_function_leads_a_campaign_to_a_bus_in_real_time(tmp_path: Path) -> None:
    path = written(tmp_path, {"changes": "own.py:changes"})
    own = tmp_path / "own.py"
    own.write_text(own.read_text().replace('"load": {},', '"load": {}, "bus.spec": "hub:nobody",'))
    with pytest.raises(BadInput, match=r"bus\.spec: found 'hub:nobody', expected 'simulated'"):
        run_campaign(path, tmp_path / "out", workers=1)
