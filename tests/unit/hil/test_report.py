"""The terminal summary and the progress line."""

import io
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from hil.configuration.bench_file import load_bench
from hil.figures.summary import Check, DropoutCounts, Percentiles, SpeedError, Summary, Verdict
from hil.terminal.progress import LINE_WIDTH, TerminalProgress, bar_line
from hil.terminal.report import print_run, recording_lines, viewer_command
from tests.unit.hil.test_summary import timing

EXAMPLES = Path(__file__).parents[3] / "examples"


def summary(*, passed: bool = True, completed: bool = True, faults: tuple[str, ...] = ()) -> Summary:
    checks = (
        Check("speed_error_peak_percent_max", 4.25, 10.0, True),
        Check("delay_p99_us_max", 2345.0 if not passed else 999.0, 2000.0, passed),
        Check("after_load_percent_max", None, 5.0, False),
    )
    return Summary(
        cycles=2000,
        dropouts=DropoutCounts(lost=90, late=5, stale=1, missed=0),
        delay_us=Percentiles(612.0, 987.5, 1044.25),
        speed_error=SpeedError(6.68, 4.25, 0.7, None),
        bus_load_percent=51.4,
        realtime_factor=38.2,
        lateness_us=Percentiles(0.0, 0.0, 0.0),
        verdict=Verdict(passed, completed, "" if completed else "lost the bus", checks),
        recording="runs/x",
        seed=2012,
        digest="ab" * 16,
        recording_faults=faults,
    )


def printed(found: Summary, recording: Path | None = None, width: int = 100) -> str:
    stream = io.StringIO()
    console = Console(file=stream, width=width, highlight=False)
    print_run(load_bench(EXAMPLES / "ling2012.toml"), found.as_json(), recording, console=console)
    return stream.getvalue()


def test_summary_holds_every_figure() -> None:
    text = printed(summary())
    for part in (
        "ling2012: PASSED",
        "2000 cycles at 1000 Hz, 1 axis",
        "bus simulated, seed 2012",
        "peak 6.68 rad/s (4.25 %), rms 0.7 rad/s",
        "After load step  not measured",
        "p50 612 us, p99 988 us, max 1044 us",
        "96 (4.80 %): 90 lost, 5 late, 1 stale",
        "51.4 %",
        "38.2 times real time",
        "ab" * 16,
    ):
        assert part in text


def test_verdict_names_each_limit_and_what_became_of_it() -> None:
    lines = printed(summary(passed=False)).splitlines()
    assert "NOT PASSED" in lines[0]
    row = next(line for line in lines if "delay p99" in line)
    assert row.split()[1:-1] == ["delay", "p99", "[us]", "2345", "2000", "too", "high"]
    assert any("after load step [%]" in line and "not measured" in line for line in lines)
    assert any("speed error, peak [%]" in line and line.split()[-2] == "ok" for line in lines)


def test_a_run_cut_short_says_why() -> None:
    assert "The run was cut short: lost the bus" in printed(summary(passed=False, completed=False))
    assert "The recording lacks: 7 rows" in printed(summary(faults=("7 rows",)))


def test_fits_one_screen() -> None:
    lines = printed(summary(), Path("runs/x"), width=80).splitlines()
    assert len(lines) <= 24
    assert max(map(len, lines)) <= 80


def test_three_axes_and_their_clocks_fit_one_screen() -> None:
    told = timing(uncertain=12)
    told["axes"] |= {"b": told["axes"]["a"], "c": timing(clock_steps=1)["axes"]["a"]}
    lines = printed(replace(summary(), timing=told), Path("runs/x"), width=80).splitlines()
    assert len(lines) <= 26
    assert max(map(len, lines)) <= 80
    wide = printed(replace(summary(), timing=told)).splitlines()
    rows = [line.strip("│ ") for line in wide if "Timing of" in line]
    assert [row.split("  ", 1)[0] for row in rows] == ["Timing of a", "Timing of b", "Timing of c"]
    assert rows[0].endswith("12 uncertain")
    assert rows[2].endswith("set once")


def test_a_run_that_is_not_trusted_says_why() -> None:
    found = summary(passed=False)
    verdict = replace(found.verdict, distrust=("axis1: 3 readings came before their SYNC",))
    assert "Not trustworthy: axis1: 3 readings came" in printed(replace(found, verdict=verdict))


def test_recording_is_named_with_the_command_that_opens_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    expected = ["Recording  runs/x/run.rrd", f"Open with  {viewer_command()} runs/x/run.rrd"]
    assert recording_lines(Path("runs/x")) == expected
    assert recording_lines(tmp_path / "runs" / "x" / "run.rrd") == expected
    assert recording_lines(None) == ["Recording  none was asked for"]


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_progress_writes_once_for_each_percent() -> None:
    terminal = Terminal()
    progress = TerminalProgress(terminal, 2.0)
    for step in range(2001):
        progress("running", step * 1e-3)
    lines = terminal.getvalue().split("\r")[1:]
    assert len(lines) == 101
    assert all(len(line) == LINE_WIDTH for line in lines)
    assert "100 %" in lines[-1]
    progress.clear()
    assert terminal.getvalue().endswith("\r" + " " * LINE_WIDTH + "\r")


def test_progress_into_a_file_is_a_line_for_each_phase() -> None:
    stream = io.StringIO()
    progress = TerminalProgress(stream, 2.0)
    for phase, elapsed_s in (("connecting", 0.0), ("running", 0.0), ("running", 1.0), ("stopping", 2.0)):
        progress(phase, elapsed_s)
    progress.clear()
    assert stream.getvalue() == "connecting\nrunning\nstopping\n"


@pytest.mark.parametrize("elapsed_s", [0.0, 0.5, 1e6])
def test_bar_line_never_outgrows_the_terminal(elapsed_s: float) -> None:
    assert len(bar_line("a very long phase name", elapsed_s, 1e6, 50)) == LINE_WIDTH
