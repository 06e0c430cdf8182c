"""``hil campaign``: what its options ask for, what is printed of a campaign, and with which status it ends.

Campaigns are made up here; what is claimed of their rows is held elsewhere.
"""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from servobench.hil.campaign import campaign, figures, page, plan, report
from servobench.hil.campaign.campaign import Campaign, CampaignProgress, CounterExample
from servobench.hil.cli import app

POINTS = [
    {"point": "load 1", "runs": 40, "passed": 39, "rate": 0.975, "low": 0.86837, "high": 0.99936},
    {"point": "", "runs": 0, "passed": 0, "rate": None, "low": 0.0, "high": 1.0},
]
FIGURES: dict[str, Any] = {
    "points": POINTS,
    "passed": 39,
    "runs": 40,
    "planned": 50,
    "certificate": {},
    "confidence": 0.95,
    "interval": "Clopper-Pearson",
}
PRINTED = """\
point runs passed pass rate interval
load 1 40 39 97.50 % 86.84 to 99.94 %
all 0 0 - 0.00 to 100.00 %
39 of 40 runs passed, 50 were planned
intervals of 95 %, Clopper-Pearson; campaign out
"""


class Made:
    """In place of the campaigns: what was asked of them, and what they hold."""

    def __init__(self) -> None:
        self.asked: list[Any] = []
        self.figures = dict(FIGURES)
        self.found: dict[int, list[str]] = {}
        self.checks = False
        self.steps: list[CampaignProgress] = []
        self.notes: list[str] = []
        self.summary = SimpleNamespace(
            digest="abc",
            recording="there",
            verdict=SimpleNamespace(outcome="not passed", exit_status=1),
            as_json=lambda: {"digest": "abc"},
        )
        self.findings: list[str] | None = None

    @property
    def done(self) -> Any:
        lines = [f"run {number}: {text}" for number, texts in self.found.items() for text in texts]
        return SimpleNamespace(
            folder=Path("out"),
            found=self.found,
            found_lines=lambda: lines,
            plan=SimpleNamespace(own=SimpleNamespace(checks=self.checks)),
            hold_certificate=lambda: self.asked.append("held"),
            replay=self.replay,
        )

    def load(self, folder: Path) -> Any:
        self.asked.append(folder)
        return self.done

    def run(self, made: Any, folder: Path, *, progress: Any, note: Any, **how: Any) -> Any:
        self.asked.append((made, folder, how))
        for text in self.notes:
            note(text)
        for step in self.steps:
            progress(step)
        return self.done

    def replay(self, number: int, record: Path | None) -> Any:
        self.asked.append((number, record))
        return SimpleNamespace(summary=self.summary, findings=self.findings)


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> Made:
    campaigns = Made()

    def load(path: Path) -> Any:
        sections = SimpleNamespace(campaign=SimpleNamespace(name=f"name of {path}"))
        return SimpleNamespace(sweep=sections, path=path)

    monkeypatch.setattr(plan.CampaignPlan, "load", load)
    monkeypatch.setattr(campaign, "run_campaign", campaigns.run)
    monkeypatch.setattr(Campaign, "load", campaigns.load)
    monkeypatch.setattr(figures, "figures_of", lambda _done: campaigns.figures)
    monkeypatch.setattr(report, "write_report", lambda _done, place: place.write_text("report"))
    monkeypatch.setattr(page, "write_page", lambda _done, place: place.write_text("page"))
    return campaigns


def hil(*arguments: str) -> Result:
    return CliRunner().invoke(app, ["campaign", *arguments])


def plain(text: str) -> str:
    return "".join(" ".join(line.split()) + "\n" for line in text.splitlines())


def test_a_sweep_file_may_stand_where_the_commands_do(made: Made) -> None:
    for arguments in (("sweep.toml",), ("run", "sweep.toml")):
        told = hil(*arguments)
        assert (told.exit_code, plain(told.stdout), told.stderr) == (0, PRINTED, "")
    (asked, folder, how), again = made.asked
    assert again[1:] == (folder, how)
    assert (asked.path, folder) == (Path("sweep.toml"), Path("campaigns/name of sweep.toml"))
    assert how == {
        "workers": None,
        "dask": None,
        "resume": False,
        "against_certificate": False,
        "seconds": None,
    }
    assert hil("--help").stdout.split()[:4] == ["Usage:", "hil", "campaign", "[OPTIONS]"]


def test_the_options_of_a_campaign_are_handed_on(made: Made) -> None:
    hil(
        "sweep.toml", "--workers", "3", "--dask", "tcp://x", "--resume", "--out", "there", "--seconds", "0",
        "--against", "certificate",
    )  # fmt: skip
    (_, folder, how), held = made.asked
    assert (folder, held) == (Path("there"), "held")
    assert how == {
        "workers": 3,
        "dask": "tcp://x",
        "resume": True,
        "against_certificate": True,
        "seconds": 0.0,
    }


def test_a_campaign_is_printed_with_everything_that_it_has(made: Made) -> None:
    made.checks = True
    made.figures |= {
        "certificate": {"runs": {"kept": 30, "premise left": 10}},
        "failure": {"rate": 0.01234, "low": 0.001, "high": 0.05, "counting": 7, "plain_runs": 900},
    }
    assert plain(hil("sweep.toml").stdout).splitlines()[3:] == [
        "39 of 40 runs passed, 50 were planned",
        "failure probability 0.0123, 0.001 to 0.05, by 7 weighted runs behind those that found the way; "
        "plain draws would take 900 for it",
        "the check found something in 0 runs",
        "certificate kept: 30 runs",
        "certificate premise left: 10 runs",
        "intervals of 95 %, Clopper-Pearson; campaign out",
    ]
    assert json.loads(hil("sweep.toml", "--json").stdout) == made.figures


@pytest.mark.parametrize("lines", [1, 40, 41])
def test_what_a_check_has_found_fails_and_is_told_in_forty_lines(made: Made, lines: int) -> None:
    made.checks = True
    made.found = {number: ["odd"] for number in range(lines)}
    told = hil("sweep.toml")
    assert told.exit_code == 1
    shown = plain(told.stdout).splitlines()[4:-1]
    assert shown == [
        f"the check found something in {lines} runs",
        *(f"run {number}: odd" for number in range(min(lines, 40))),
    ]


def test_a_counter_example_comes_before_what_a_check_has_found(
    made: Made, monkeypatch: pytest.MonkeyPatch
) -> None:
    made.found = {3: ["odd"]}

    def exceeded(*_given: Any, **_how: Any) -> Any:
        done = made.done
        done.hold_certificate = lambda: (_ for _ in ()).throw(CounterExample("run 3"))
        return done

    monkeypatch.setattr(campaign, "run_campaign", exceeded)
    told = hil("sweep.toml", "--against", "certificate")
    assert (told.exit_code, told.stderr) == (7, "hil: error: run 3\n")
    assert hil("sweep.toml").exit_code == 1


def test_that_a_campaign_was_killed_is_a_note(made: Made) -> None:
    made.notes = ["out/seal: no last line"]
    assert hil("sweep.toml", "--resume").stderr == "hil: note: out/seal: no last line\n"


def test_progress_is_a_line_for_each_percent(made: Made) -> None:
    """Beside a terminal; 3 and 4 of 250 are in one percent."""
    left = (0.4, 59.6, 3_600.0, 7_325.0, 3_599.4)
    made.steps = [
        CampaignProgress(done, 250, done - 1, 12.34, left_s)
        for done, left_s in zip((1, 3, 4, 5, 250), left, strict=True)
    ]
    assert hil("sweep.toml").stderr.splitlines() == [
        "1/250 runs  0 passed  12.3/s  0 s left at most",
        "3/250 runs  2 passed  12.3/s  1 min 0 s left at most",
        "5/250 runs  4 passed  12.3/s  2 h 2 min left at most",
        "250/250 runs  249 passed  12.3/s  59 min 59 s left at most",
        "12.3 runs a second",
    ]


@pytest.mark.parametrize("done", [0, 1, 2, 100])
def test_the_first_that_is_heard_of_a_campaign_is_told(made: Made, done: int) -> None:
    made.steps = [CampaignProgress(done, 100, 0, 1.0, 5.0)]
    assert hil("sweep.toml").stderr.splitlines() == [
        f"{done}/100 runs  0 passed  1.0/s  5 s left at most",
        "1.0 runs a second",
    ]


def test_a_report_is_a_file_and_a_page_in_the_folder(
    made: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("there").mkdir()
    told = hil("report", "there")
    files = [Path("there/report.html"), Path("there/campaign.rrd")]
    assert made.asked == [Path("there")]
    assert [path.read_text() for path in files] == ["report", "page"]
    assert (told.exit_code, plain(told.stdout)) == (0, PRINTED)
    assert told.stderr.splitlines() == [f"written {path}" for path in files]
    assert json.loads(hil("report", "there", "--json").stdout) == FIGURES


def test_a_run_again_ends_with_its_own_verdict(made: Made) -> None:
    told = hil("replay", "there", "--run", "7")
    assert (told.exit_code, told.stderr) == (1, "written there\n")
    assert told.stdout == "run 7: not passed; digest abc, as in the campaign\n"
    assert made.asked == [Path("there"), (7, None)]
    made.findings = ["one thing", "another"]
    made.summary.verdict.exit_status = 0
    told = hil("replay", "there", "--run", "0", "--into", "here")
    assert made.asked[-1] == (0, Path("here"))
    assert (told.exit_code, told.stdout.splitlines()[1:]) == (0, ["found: one thing", "found: another"])
    told = hil("replay", "there", "--run", "0", "--json")
    assert (json.loads(told.stdout), told.stderr) == ({"digest": "abc"}, "")
