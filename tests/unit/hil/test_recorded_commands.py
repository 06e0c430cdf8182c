"""``hil picture``, ``review``, ``compare`` and ``view``: what they ask of a recording, and how they end.

What is drawn, judged and compared is held elsewhere, of recorded runs.
"""

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from servobench.hil.cli import app
from servobench.hil.recorded import (
    comparison,
    comparison_page,
    judgement,
    paper,
    recorded_run,
    report,
    viewer,
)
from servobench.hil.recording import page_keepers
from servobench.hil.rows import arrow_file
from servobench.hil.terminal import view as view_command
from servobench.hil.verdict import summary_text


def hil(*arguments: str | Path) -> Result:
    return CliRunner(env={"COLUMNS": "120"}).invoke(app, list(map(str, arguments)))


def refusal(result: Result) -> str:
    assert (result.exit_code, result.stdout) == (2, "")
    return result.stderr.removeprefix("hil: error: ").rstrip("\n")


# ---- picture ------------------------------------------------------------------------------------------


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    asked: list[Any] = []

    def page(*given: Any, size: tuple[int, int], unsealed: bool, tell_seal: Callable[[str], None]) -> bytes:
        assert (size, unsealed) == ((1920, 1080), False)
        tell_seal("sealed")
        asked.append(given)
        return b"a page"

    def figure(*given: Any) -> str:
        asked.append(given)
        return "the figure"

    monkeypatch.setattr(viewer, "draw_page", page)
    opened = SimpleNamespace(run=Path("one"), seal="sealed", folder=Path("one"))
    monkeypatch.setattr(recorded_run, "open_run", lambda _run, **_: opened)
    monkeypatch.setattr(arrow_file, "is_whole", lambda _path: True)
    monkeypatch.setattr(recorded_run, "signals_of", lambda run, *window: (f"signals of {run.run}", *window))
    monkeypatch.setattr(paper, "paper_figure", figure)
    monkeypatch.setattr(paper, "save_figure", lambda figure, out: out.write_text(figure))
    return asked


@pytest.mark.parametrize(
    ("options", "asked"),
    [
        ((), (None, None, (None, None))),
        (("--page", "zoom/axis1"), ("zoom/axis1", None, (None, None))),
        (("--at", "1.5"), (None, 1.5, (None, None))),
        (("--at", "1.5", "--span", "0.5"), (None, 1.5, (1.25, 1.75))),
        (("--at", "0", "--span", "2"), (None, 0.0, (-1.0, 1.0))),
    ],
)
def test_a_page_is_drawn_about_its_cursor(
    drawn: list[Any], tmp_path: Path, options: tuple[str, ...], asked: tuple[Any, ...]
) -> None:
    out = tmp_path / "page.png"
    told = hil("picture", "one", out, *options)
    assert (told.exit_code, told.stderr, out.read_bytes()) == (0, f"written {out}\n", b"a page")
    assert drawn == [(Path("one"), *asked)]


@pytest.mark.parametrize(
    ("options", "window"), [((), (None, None)), (("--at", "1", "--span", "0.5"), (0.75, 1.25))]
)
def test_a_figure_for_a_paper_is_of_the_same_stretch(
    drawn: list[Any], tmp_path: Path, options: tuple[str, ...], window: tuple[Any, ...]
) -> None:
    out = tmp_path / "figure.svg"
    told = hil("picture", "one", out, "--paper", *options)
    assert (told.exit_code, told.stderr, out.read_text()) == (0, f"written {out}\n", "the figure")
    assert drawn == [(("signals of one", *window),)]


@pytest.mark.parametrize(
    ("out", "options", "said"),
    [
        ("p.png", ("--span", "0.5"), "--span: found '0.5', expected --at beside it: about which instant"),
        (".", (), "OUT: found 'FOLDER', expected a file in an existing folder"),
        ("none/p.png", (), "OUT: found 'FOLDER/none/p.png', expected a file in an existing folder"),
        ("p.svg", (), "OUT: found 'FOLDER/p.svg', expected a file that ends in .png, or --paper"),
        ("p.svg", ("--paper", "--page", "timing"), "--page: found 'timing', expected no --paper beside it"),
        ("p.svg", ("--paper", "--size", "9x9"), "--size: found '9x9', expected no --paper beside it"),
        (
            "p.png",
            ("--size", "640x480"),
            "--size: found '640x480', expected WIDTHxHEIGHT in px, from 800x450 to 8192x8192",
        ),
    ],
)
def test_a_picture_that_cannot_be_is_refused(
    drawn: list[Any], tmp_path: Path, out: str, options: tuple[str, ...], said: str
) -> None:
    assert refusal(hil("picture", "one", tmp_path / out, *options)) == said.replace("FOLDER", str(tmp_path))
    assert drawn == []


# ---- review -------------------------------------------------------------------------------------------


def test_a_review_is_printed_written_and_ends_as_its_verdict(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    asked: list[Any] = []
    findings = [SimpleNamespace(outcome="broken", text="too [slow]")]
    verdict = SimpleNamespace(outcome="not passed", exit_status=1, findings=findings, limits=())
    judged = SimpleNamespace(
        run=SimpleNamespace(title=lambda: "run [one]", seal="sealed"),
        against="its own limits",
        summary=SimpleNamespace(verdict=verdict, as_json=lambda: {"cycles": 7}),
    )

    def judge(run: Any, against: Path | None) -> Any:
        asked.append((run, against))
        return judged

    rows = [("overshoot", "12", "10", "broken", "axis1 at 1 s"), ("delay [us]", "-", "5", "not known", "")]
    monkeypatch.setattr(recorded_run, "open_run", lambda run, **_: f"opened {run}")
    monkeypatch.setattr(judgement, "judge_run", judge)
    monkeypatch.setattr(summary_text, "limit_rows", lambda _limits: iter(rows))
    monkeypatch.setattr(report, "write_report", lambda _judged, path: path.write_text("a report"))
    told = hil("review", "one")
    assert (told.exit_code, told.stderr) == (1, "")
    assert [" ".join(line.split()) for line in told.stdout.splitlines()] == [
        "run [one], by its own limits; sealed",
        "requirement value at most worst",
        "overshoot 12 10 broken axis1 at 1 s",
        "delay [us] - 5 not known",
        "broken: too [slow]",
        "NOT PASSED",
    ]
    verdict.exit_status = 6
    out = tmp_path / "report.md"
    told = hil("review", "one", "--against", "asked.toml", "--report", out, "--json")
    assert (told.exit_code, json.loads(told.stdout), told.stderr) == (
        6,
        {"cycles": 7, "seal": "sealed"},
        f"written {out}\n",
    )
    assert out.read_text() == "a report"
    assert asked == [("opened one", None), ("opened one", Path("asked.toml"))]


# ---- compare ------------------------------------------------------------------------------------------


class Compared:
    """What was compared, and what is to come of it."""

    def __init__(self) -> None:
        self.asked: list[Any] = []
        self.kept: list[list[bool | None]] = [[]]

    def compare(self, runs: list[str], tolerances: Any) -> list[Any]:
        self.asked.append((runs, tolerances))
        return [
            SimpleNamespace(regressions=[SimpleNamespace(kept=kept) for kept in one]) for one in self.kept
        ]


@pytest.fixture
def compared(monkeypatch: pytest.MonkeyPatch) -> Compared:
    made = Compared()
    monkeypatch.setattr(recorded_run, "open_run", lambda run, **_: f"opened {run}")
    monkeypatch.setattr(comparison, "load_tolerances", lambda path: f"loaded {path}")
    monkeypatch.setattr(comparison, "compare_runs", made.compare)
    monkeypatch.setattr(comparison, "comparison_lines", lambda _compared: ["one", "two"])
    monkeypatch.setattr(comparison, "comparison_json", lambda _compared: {"same": False})
    monkeypatch.setattr(
        comparison_page, "write_comparison", lambda _compared, text, place: place.write_text(text)
    )
    return made


def test_runs_are_compared_with_the_first_or_the_baseline(compared: Compared, tmp_path: Path) -> None:
    told = hil("compare", "one", "two", "three")
    assert (told.exit_code, told.stdout, told.stderr) == (0, "one\ntwo\n", "")
    page = tmp_path / "page.rrd"
    told = hil("compare", "one", "--baseline", "base", "--tolerances", "t.toml", "--rrd", page, "--json")
    assert (json.loads(told.stdout), told.stderr) == ({"same": False}, f"written {page}\n")
    assert page.read_text() == "```\none\ntwo\n```\n"
    assert compared.asked == [
        (["opened one", "opened two", "opened three"], None),
        (["opened base", "opened one"], "loaded t.toml"),
    ]


@pytest.mark.parametrize(
    ("kept", "status"),
    [
        ([[True], [True, True]], 0),
        ([[True], [None]], 6),
        ([[None], [True, False]], 1),
        ([[False]], 1),
        ([[], []], 0),
    ],
)
def test_a_comparison_ends_by_the_worst_of_its_tolerances(
    compared: Compared, kept: list[list[bool | None]], status: int
) -> None:
    compared.kept = kept
    assert hil("compare", "one", "two").exit_code == status


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("one",), "RUN: found 'one', expected a second run, or --baseline, to compare it with"),
        *(
            (
                ("one", "two", "--rrd", place),
                f"--rrd: found '{place}', expected a .rrd file in an existing folder",
            )
            for place in ("page.html", "none/page.rrd")
        ),
    ],
)
def test_what_cannot_be_compared_is_refused(
    compared: Compared, arguments: tuple[str, ...], said: str
) -> None:
    assert refusal(hil("compare", *arguments)) == said
    assert compared.asked == []


# ---- view ---------------------------------------------------------------------------------------------


def test_a_recording_is_opened_where_there_is_a_display(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    started: list[str] = []
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(viewer, "page_file", lambda run, **_asked: run / "run.rrd")
    monkeypatch.setattr(page_keepers, "start_viewer", started.append)
    monkeypatch.setattr(view_command, "missing_display", lambda: False)
    told = hil("view", "one")
    assert (told.exit_code, told.stdout, told.stderr) == (0, "", "")
    page = str(tmp_path / "one" / "run.rrd")
    assert started == [page]
    monkeypatch.setattr(view_command, "missing_display", lambda: True)
    monkeypatch.setattr("servobench.hil.terminal.report.viewer_command", lambda: "rerun")
    told = hil("view", "one")
    assert (told.exit_code, told.stdout, len(started)) == (0, f"{page}\n", 1)
    assert told.stderr.splitlines() == [
        "hil: no display here; on a machine with one: rerun one/run.rrd",
        "hil: in a browser, over ssh too: hil view one --serve",
        "hil: as a picture: hil picture one page.png",
    ]
