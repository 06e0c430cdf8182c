"""``hil review``: a recording judged from its files, and what it says of rows that are not its own."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from servobench.hil.cli import app
from servobench.hil.rows.records_file import RecordsWriter, read_metadata, read_records
from tests.unit.hil.recorded_runs import short_run

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("forked_children")]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With its step, its losses and its blackout left out."""
    return short_run(tmp_path_factory.mktemp("runs") / "run", 0.6)


def review(*arguments: object) -> tuple[int, str]:
    found = CliRunner().invoke(app, ["review", *map(str, arguments)])
    return found.exit_code, found.output


def test_a_review_by_its_own_limits_is_the_verdict_of_the_run(run: Path) -> None:
    status, told = review(run, "--json")
    summary = json.loads((run / "summary.json").read_text())
    found = json.loads(told)
    assert found["verdict"] == summary["verdict"]
    assert status == summary["verdict"]["exit_status"]
    assert found["digest"] == summary["digest"]


def test_other_requirements_are_judged_by_the_same_rows(run: Path, tmp_path: Path) -> None:
    asked = tmp_path / "requirements.toml"
    asked.write_text("[verdict]\novershoot_percent_max = 1.0\nsettling_time_ms_max = 200\n")
    status, told = review(run, "--against", asked, "--json")
    limits = {each["metric"]: each for each in json.loads(told)["verdict"]["limits"]}
    rows = np.concatenate(list(read_records(run / "records.arrow")))
    over = np.nanmax(rows["velocity_rad_s"]) / rows["reference_rad_s"].max() - 1.0
    assert limits["overshoot_percent_max"]["value"] == pytest.approx(100.0 * over)
    assert limits["overshoot_percent_max"]["result"] == "broken"
    assert limits["overshoot_percent_max"]["at_ns"] == 200_000_000
    assert limits["settling_time_ms_max"]["result"] == "kept"
    assert status == 1


def test_a_key_that_no_limit_has_is_refused(run: Path, tmp_path: Path) -> None:
    asked = tmp_path / "requirements.toml"
    asked.write_text("[verdict]\novershoot_max = 1.0\n")
    status, told = review(run, "--against", asked)
    assert status == 2
    assert "overshoot_max" in told


def test_rows_that_are_not_those_of_the_run_are_told(run: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(run, tmp_path / "copy"))
    rows = np.concatenate(list(read_records(copy / "records.arrow")))
    rows["velocity_rad_s"][300] += 1e-9
    writer = RecordsWriter(copy / "records.arrow")
    writer.begin(read_metadata(run / "records.arrow"), 0)  # type: ignore[arg-type]
    writer.write(rows)
    writer.close()
    status, told = review(copy)
    assert status == 2
    found = re.search(rf"{copy / 'records.arrow'}: rows (\d+) to (\d+): found", told)
    assert found, told
    first, last = map(int, found.groups())
    assert first <= 301 <= last, "the batch of the altered row"
    status, told = review(copy, "--unsealed")
    assert status == 5
    assert "digest" in told


def test_a_run_that_was_cut_off_is_not_judged(run: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(run, tmp_path / "copy"))
    (copy / "summary.json").unlink()
    status, told = review(copy)
    assert status == 2
    assert "hil recover" in told


@pytest.mark.parametrize("name", ["report.html", "report.md"])
def test_a_report_holds_its_pictures(run: Path, tmp_path: Path, name: str) -> None:
    out = tmp_path / name
    review(run, "--report", out)
    text = out.read_text()
    assert "speed error, peak [%]" in text
    assert ("<svg" in text) == (name == "report.html")
    assert ("data:image/svg+xml;base64," in text) == (name == "report.md")
    assert "http://" not in text.replace("http://www.w3.org", "").replace("http://purl.org", "").replace(
        "http://creativecommons.org", ""
    )
