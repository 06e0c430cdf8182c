"""Campaigns on the simulated bench: the same table whoever runs it and whatever is killed; replay, claims."""

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from typer.testing import CliRunner

from servobench import run as run_bench
from servobench.drivers.errors import BadInput
from servobench.hil.campaign import pool as pool_module
from servobench.hil.campaign.campaign import Campaign, CampaignProgress, run_campaign
from servobench.hil.campaign.figures import cell_maps, figures_of
from servobench.hil.campaign.page import write_page
from servobench.hil.campaign.plan import CampaignPlan
from servobench.hil.campaign.pool import DEATHS_MAX, RunRefused, Worker, WorkerDied, WorkerPool
from servobench.hil.campaign.store import open_campaign
from servobench.hil.campaign.worker import NotTheSame
from servobench.hil.cli import app
from servobench.hil.configuration.config_files import toml_text
from servobench.hil.machine.stopping import Interrupted, StopRequest
from servobench.hil.testing.campaign_runs import CampaignRunner
from tests.draws import few_of
from tests.rrd_columns import columns

ROOT = Path(__file__).parents[2]
LING = ROOT / "examples" / "ling2012.toml"
LOSS = "faults.loss.0.probability"
INTEGRAL = "drive.axis1.controller.integral_nm_rad"
PEAK = "speed_error_peak_percent"
CHANGES = {
    "bench.duration_s": 0.3,
    "reference.axis1.0.at_s": 0.05,
    "load": {},
    "faults": {"loss": [{"probability": 0.02}]},
    "verdict": {"dropouts_percent_max": 10.0, "settling_ms": 100},
}


def sweep(seeds: int = 6, **more: Any) -> dict[str, Any]:
    return {
        "campaign": {"name": "short", "bench": str(LING), "seeds": seeds, "failures_recorded": 1},
        "change": CHANGES,
        "vary": [{"key": LOSS, "values": [0.02, 0.2]}],
        **more,
    }


def written(folder: Path, tables: dict[str, Any]) -> Path:
    path = folder / "sweep.toml"
    path.write_text(toml_text(tables))
    return path


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Campaign:
    folder = tmp_path_factory.mktemp("campaign")
    return run_campaign(written(folder, sweep()), folder / "out", workers=1)


def rows(campaign: Campaign) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = campaign.table.to_pylist()
    return found


def test_a_row_says_what_the_run_says(done: Campaign) -> None:
    table = rows(done)
    assert [row["run"] for row in table] == list(range(12))
    assert [row["passed"] for row in table] == [True, False] * 6
    planned = done.plan.run(7)
    alone = run_bench(done.plan.bench, planned.changes, seed=planned.seed)
    assert alone.digest == table[7]["digest"]
    assert alone.verdict.reason == table[7]["reason"]
    assert alone.summary.speed_error.peak_percent == table[7]["speed_error_peak_percent"]
    assert 100 * (alone.column("fate") != 0).mean() == pytest.approx(table[7]["dropouts_percent"])
    assert len({row["digest"] for row in table}) == 12


def test_a_failure_is_recorded_and_a_run_can_be_had_again(done: Campaign, tmp_path: Path) -> None:
    (failure,) = (done.folder / "failures").iterdir()
    assert failure.name == "run-000000001"
    assert json.loads((failure / "summary.json").read_text())["digest"] == rows(done)[1]["digest"]
    ran = CliRunner().invoke(
        app, ["campaign", "replay", str(done.folder), "--run", "4", "--into", str(tmp_path / "again")]
    )
    assert ran.exit_code == 0, ran.output
    assert (tmp_path / "again" / "records.arrow").exists()


def test_a_run_that_comes_to_another_digest_is_told(done: Campaign, tmp_path: Path) -> None:
    other = Campaign(done.folder, done.plan)
    column = other.table.schema.get_field_index("digest")
    vars(other)["table"] = other.table.set_column(column, "digest", [["0" * 32] * 12])
    with pytest.raises(NotTheSame, match="run 3: digest"):
        other.replay(3, tmp_path / "again")


def killing(pool: WorkerPool, got: Iterator[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    """The rows of ``got``; after the second a worker is killed, after the fourth the other."""
    for number, row in enumerate(got):
        if number in (1, 3):
            os.kill(pool.process_ids[0], signal.SIGKILL)
        yield row


def test_killed_workers_are_replaced_and_nothing_changes(done: Campaign) -> None:
    pool = WorkerPool(done.plan, 2, StopRequest())
    found = list(killing(pool, pool.rows(range(6))))
    assert found == rows(done)[:6]


class Doomed(Worker):
    """A worker that ends before it is ready: until it has read where the plan is it cannot be."""

    born: ClassVar[list["Doomed"]] = []
    doomed: ClassVar[int]
    by_signal: ClassVar[bool] = True

    def send(self, what: Any) -> None:
        """The first ``doomed`` of all get no plan."""
        if "sweep" in what:
            self.born.append(self)
            if len(self.born) <= self.doomed:
                assert self.process.stdin is not None
                if self.by_signal:
                    self.process.kill()
                self.process.stdin.close()
                return
        super().send(what)


@pytest.fixture
def doomed(monkeypatch: pytest.MonkeyPatch) -> type[Doomed]:
    class Fresh(Doomed):
        born: ClassVar[list[Doomed]] = []

    monkeypatch.setattr(pool_module, "Worker", Fresh)
    return Fresh


def test_workers_killed_before_they_are_ready_are_replaced(done: Campaign, doomed: type[Doomed]) -> None:
    doomed.doomed = DEATHS_MAX - 1
    found = list(WorkerPool(done.plan, 2, StopRequest()).rows(range(12)))
    assert found == rows(done)
    assert len(doomed.born) == DEATHS_MAX + 1


@pytest.mark.parametrize(
    ("by_signal", "starts", "told"),
    [
        (True, DEATHS_MAX, "3 workers in a row died before their first run, the last with status -9"),
        (False, 1, "a worker ended with status 1 before its first run"),
    ],
)
def test_workers_that_never_are_ready_end_the_campaign(
    done: Campaign, doomed: type[Doomed], by_signal: bool, starts: int, told: str
) -> None:
    doomed.doomed, doomed.by_signal = 1000, by_signal
    with pytest.raises(WorkerDied, match=told):
        list(WorkerPool(done.plan, 1, StopRequest()).rows(range(12)))
    assert len(doomed.born) == starts


KILLED = """
import os, signal, sys
from servobench.hil.campaign import campaign

campaign.STORED_EVERY_NS = 0  # every row is stored at once
sync, calls = os.fsync, []

def killing(descriptor):
    calls.append(descriptor)
    if len(calls) == int(sys.argv[3]):
        os.kill(os.getpid(), signal.SIGKILL)
    sync(descriptor)

os.fsync = killing
campaign.run_campaign(sys.argv[1], sys.argv[2], workers=1)
"""
"""The third argument: at which sync it is killed. Each file has three: its own, that of its line in the seal,
and that of its folder."""


@pytest.mark.parametrize(("sync", "stored", "kept"), few_of([(11, 2, 3), (12, 3, 3), (10, 2, 2)], 2))
def test_a_campaign_that_was_killed_goes_on_to_the_same_table(
    done: Campaign, tmp_path: Path, sync: int, stored: int, kept: int
) -> None:
    out = tmp_path / "out"
    command = [sys.executable, "-c", KILLED, str(done.plan.source), str(out), str(sync)]
    assert subprocess.run(command, cwd=ROOT, check=False).returncode == -signal.SIGKILL
    assert len(list(out.glob("runs/*.parquet"))) == stored
    assert len(list(out.glob("runs/*.writing"))) == (sync % 3 != 0)
    with pytest.raises(BadInput, match="no last line"):
        Campaign.load(out)
    with open_campaign(out, CampaignPlan.load(done.plan.source), resume=True) as store:
        assert store.count == kept
    resumed = run_campaign(done.plan.source, out, workers=1, resume=True)
    assert rows(resumed) == rows(done)
    parts = {path.name for path in out.glob("runs/*")}
    run_campaign(done.plan.source, out, workers=1, resume=True)
    assert {path.name for path in out.glob("runs/*")} == parts, "nothing is run twice"


def asking(stop: StopRequest, after: int) -> Callable[[CampaignProgress], None]:
    """Asks for the end when so many runs are done."""
    return lambda at: stop.ask() if at.done == after else None


def test_one_who_asks_for_the_end_keeps_what_is_done(done: Campaign, tmp_path: Path) -> None:
    stop = StopRequest()
    with pytest.raises(Interrupted):
        run_campaign(done.plan, tmp_path / "out", workers=1, stop=stop, progress=asking(stop, 4))
    assert rows(Campaign(tmp_path / "out", done.plan)) == rows(done)[:4]


def test_enough_is_enough_wherever_it_was_interrupted(tmp_path: Path) -> None:
    tables = sweep(400, stop={"rate_width": 0.5})
    whole = run_campaign(written(tmp_path, tables), tmp_path / "whole", workers=1)
    assert whole.sequential
    assert 10 < whole.table.num_rows < 60
    assert whole.table.num_rows % 2 == 0
    stop = StopRequest()
    with pytest.raises(Interrupted):
        run_campaign(
            whole.plan,
            tmp_path / "cut",
            workers=1,
            stop=stop,
            progress=asking(stop, 7),
        )
    resumed = run_campaign(whole.plan, tmp_path / "cut", workers=1, resume=True)
    assert rows(resumed) == rows(whole)


def test_what_cannot_be_run_ends_the_campaign(tmp_path: Path) -> None:
    """A draw that the check of a few values has not seen."""
    draw = {
        "key": "loop.deadline_us",
        "distribution": "uniform",
        "low": -400.0,
        "high": 4000.0,
        "whole": True,
    }
    path = written(tmp_path, sweep(32, draw=[draw], drawing={"seed": 2}))
    for number, workers in enumerate((1, 2)):
        with pytest.raises((BadInput, RunRefused), match=r"loop.deadline_us: found -?\d+"):
            run_campaign(path, tmp_path / f"out-{number}", workers=workers)


def test_the_command_runs_reports_and_tells(tmp_path: Path) -> None:
    path = written(tmp_path, sweep(3))
    command = ["campaign", str(path), "--out", str(tmp_path / "out")]
    ran = CliRunner().invoke(app, [*command, "--workers", "1", "--json"])
    assert ran.exit_code == 0, ran.output
    found = json.loads(ran.stdout)
    assert [(point["runs"], point["passed"]) for point in found["points"]] == [(3, 3), (3, 0)]
    assert found["points"][0]["low"] == pytest.approx(0.025 ** (1 / 3))
    assert found["sensitivity"][LOSS]["passed"]["share_of_variance"] == pytest.approx(1.0)
    told = CliRunner().invoke(app, ["campaign", "report", str(tmp_path / "out")])
    assert told.exit_code == 0, told.output
    page = (tmp_path / "out" / "report.html").read_text()
    assert "3 of 6 runs passed, 6 were planned" in page
    assert "src=" not in page
    assert "href=" not in page
    refused = CliRunner().invoke(app, command)
    assert refused.exit_code == 2
    assert "--resume goes on with it" in refused.stderr


def test_its_page_has_every_run_and_a_cell_s_worst_run(done: Campaign, tmp_path: Path) -> None:
    two_keys = {"key": "loop.deadline_us", "values": [900, 1000]}
    both = run_campaign(written(tmp_path, sweep(1, vary=[*sweep(1)["vary"], two_keys])), tmp_path / "out")
    write_page(both, tmp_path / "page.rrd")
    passed = both.column("passed").astype(bool)
    for name, kept in (("passed", passed), ("failed", ~passed)):
        shown = both.column(PEAK)[kept & np.isfinite(both.column(PEAK).astype(float))]
        _, drawn = columns(tmp_path / "page.rrd", f"/members/{name}", "Scalars:scalars")
        assert [value for (value,) in drawn] == pytest.approx(shown.tolist())
    _, labels = columns(tmp_path / "page.rrd", "/map0/rate/values", "Points2D:labels")
    rows, across = both.plan.axes
    rate, _ = cell_maps(both, rows, across)
    lines = [line for place in np.ndindex(rate.values.shape) for line in rate.label(*place).split("\n")]
    assert labels == [lines]
    assert [run for run in rate.runs.ravel() if run >= 0] == np.flatnonzero(~passed).tolist(), "one a cell"
    write_page(done, tmp_path / "one_key.rrd")
    _, text = columns(tmp_path / "one_key.rrd", "/summary", "TextDocument:text")
    assert "hil campaign replay" in str(text)


def test_a_report_that_cannot_be_written_is_no_defect(done: Campaign, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(done.folder, out)
    (out / "report.html").mkdir()
    told = CliRunner().invoke(app, ["campaign", "report", str(out)])
    assert told.exit_code == 2, told.output
    assert "expected a place to write to; Is a directory" in told.stderr


def test_claims_hold_with_their_confidence(servo_campaign: CampaignRunner, done: Campaign) -> None:
    fair = servo_campaign(sweep(8, vary=[]))
    fair.assert_pass_rate(at_least=0.68, confidence=0.95)
    with pytest.raises(AssertionError, match=r"8 of 8 runs passed .* at least 0.687656, 0.7 asked for"):
        fair.assert_pass_rate(at_least=0.7, confidence=0.95)
    with pytest.raises(
        AssertionError, match=r"= 0.2: 0 of 6 runs passed \(6 did not, the first of them run 1\)"
    ):
        done.assert_pass_rate(at_least=0.5)


def test_controllers_are_compared_in_pairs(tmp_path: Path) -> None:
    gain = "drive.axis1.controller.proportional_nm_s_rad"
    vary = [{"key": gain, "values": [0.12, 0.06], "labels": ["eager", "careful"]}]
    plan = CampaignPlan.load(written(tmp_path, sweep(4, vary=vary)))
    found = run_campaign(plan, tmp_path / "out", workers=1)
    (pair,) = figures_of(found)["pairs"]
    assert (pair["first"], pair["second"], pair["pairs"]) == ("eager", "careful", 4)
    peak = found.column("speed_error_peak_percent").reshape(4, 2)
    assert pair["peak_percent_second_less_first"]["mean"] == pytest.approx((peak[:, 1] - peak[:, 0]).mean())


def test_adaptive_draws_are_the_same_whoever_runs_them_and_find_the_failures(tmp_path: Path) -> None:
    draw = {"key": INTEGRAL, "distribution": "normal", "mean": 2.0, "deviation": 0.2}
    tables = sweep(44, vary=[], draw=[draw], adaptive={"guide": PEAK, "round_runs": 20})
    tables["campaign"]["failures_recorded"] = 0
    tables["change"] = CHANGES | {"verdict": {"settling_ms": 100, "speed_error_peak_percent_max": 3.0}}
    path = written(tmp_path, tables)
    stop = StopRequest()
    with pytest.raises(Interrupted):
        run_campaign(path, tmp_path / "cut", workers=1, stop=stop, progress=asking(stop, 33))
    cut = run_campaign(path, tmp_path / "cut", workers=1, resume=True)
    whole = run_campaign(path, tmp_path / "whole", workers=2)
    assert rows(cut) == rows(whole)
    table = whole.table.to_pandas()
    assert set(table["weight"][:20]) == {1.0}
    assert not table["counts"][:20].any()
    assert table["counts"][20:].all()
    counting = table[table["counts"]]
    assert (~counting["passed"]).mean() > (~table["passed"][:20]).mean() + 0.2
    failure = figures_of(whole)["failure"]
    assert failure["rate"] == pytest.approx((counting["weight"] * ~counting["passed"]).mean())
    assert whole.pass_rate().low == pytest.approx(1.0 - failure["high"])
    again = Campaign.load(tmp_path / "whole")
    assert again.replay(43, tmp_path / "again").summary.digest == table["digest"][43]


def test_a_guide_that_is_no_figure_is_refused(tmp_path: Path) -> None:
    draw = {"key": INTEGRAL, "distribution": "normal", "mean": 2.0, "deviation": 0.2}
    tables = sweep(60, vary=[], draw=[draw], adaptive={"guide": "luck", "round_runs": 20})
    with pytest.raises(BadInput, match=r"adaptive\.guide: found 'luck'"):
        run_campaign(written(tmp_path, tables), tmp_path / "out", workers=1)
