"""The terminal summary and the progress line."""

import io
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from servobench.hil.configuration.bench_file import load_bench
from servobench.hil.machine.progress import LINE_WIDTH, TerminalProgress, bar_line
from servobench.hil.terminal.report import print_run, recording_lines, viewer_command
from servobench.hil.verdict.figures import DropoutCounts, Percentiles, SpeedError
from servobench.hil.verdict.metrics import VerdictLimits
from servobench.hil.verdict.summary import Summary
from servobench.hil.verdict.verdict import CycleCount, Finding, RunOutcome, VerdictKind, judge
from tests.unit.hil.recording_tools import whole_outcome
from tests.unit.hil.test_summary import timing

EXAMPLES = Path(__file__).parents[3] / "examples"


LIMITS = VerdictLimits(speed_error_peak_percent_max=10.0, delay_p99_us_max=2000.0, after_load_percent_max=5.0)


def summary(
    *,
    passed: bool = True,
    completed: bool = True,
    faults: tuple[str, ...] = (),
    limits: VerdictLimits = LIMITS,
) -> Summary:
    outcome = whole_outcome(2000) if completed else RunOutcome(completed=False, reason="lost the bus")
    values = {
        "speed_error_peak_percent_max": 4.25,
        "delay_p99_us_max": 999.0 if passed else 2345.0,
        "after_load_percent_max": 3.0,
    }
    verdict = judge(outcome, CycleCount(2000, 2000, 0), values, limits, "; ".join(faults))
    return Summary(
        cycles=2000,
        dropouts=DropoutCounts(lost=90, late=5, stale=1, missed=0),
        reading_delay_us=Percentiles(612.0, 987.5, 1044.25),
        speed_error=SpeedError(6.68, 4.25, 0.7, None),
        bus_load_percent=51.4,
        realtime_factor=38.2,
        lateness_us=Percentiles(0.0, 0.0, 0.0),
        compute_us=Percentiles(12.0, 20.0, 88.0),
        verdict=verdict,
        recording="runs/x",
        seed=2012,
        digest="ab" * 16,
        recording_faults=faults,
    )


def printed(found: Summary, width: int = 100) -> str:
    stream = io.StringIO()
    console = Console(file=stream, width=width, highlight=False)
    print_run(load_bench(EXAMPLES / "ling2012.toml"), found, console=console)
    return stream.getvalue()


def test_summary_holds_every_figure() -> None:
    text = printed(summary())
    for part in (
        "ling2012: PASSED",
        "2000 cycles at 1000 Hz, 1 axis",
        "bus simulated, seed 2012",
        "peak 6.68 rad/s (4.25 %), rms 0.7 rad/s",
        "After load step  not measured",
        "p50 612 us, p99 987.5 us, max 1044 us",
        "96 (4.80 %): 90 lost, 5 late, 1 stale",
        "51.4 %",
        "38.2 times real time",
        "ab" * 16,
    ):
        assert part in text


def test_verdict_names_each_limit_and_what_became_of_it() -> None:
    lines = printed(summary(passed=False)).splitlines()
    assert "NOT PASSED" in lines[0]
    row = next(line for line in lines if "delay of readings" in line)
    assert row.split()[1:-1] == ["delay", "of", "readings,", "p99", "[us]", "2345", "2000", "too", "high"]
    assert any("speed error, peak [%]" in line and line.split()[-2] == "ok" for line in lines)


def test_a_run_cut_short_says_why() -> None:
    text = printed(summary(passed=False, completed=False))
    assert "ling2012: CUT SHORT" in text
    assert "Cut short: lost the bus" in text
    assert " ok " not in text, "of the part that was run nothing was kept"
    assert text.count("not measured") == 5, "three limits, the speed error after load, and lost commands"
    assert "The recording lacks: 7 rows" in printed(summary(faults=("7 rows",)))


@pytest.mark.parametrize(("p99", "told"), [(999.0, False), (1000.0, True), (28_345.6, True)])
def test_a_controller_too_slow_for_its_period_is_named_though_simulated_time_waited(
    p99: float, told: bool
) -> None:
    text = " ".join(printed(replace(summary(), compute_us=Percentiles(12.0, p99, 3e4))).split())
    assert (f"Computing takes {p99:.0f} us (p99), the period is 1000 us" in text) is told
    assert ("simulated time waits for it" in text.replace("│ ", "")) is told


def test_fits_one_screen() -> None:
    lines = printed(summary(), width=80).splitlines()
    assert len(lines) <= 24
    assert max(map(len, lines)) <= 80


def test_three_axes_and_their_clocks_fit_one_screen() -> None:
    told = timing(uncertain=12)
    told["axes"] |= {"b": told["axes"]["a"], "c": timing(clock_steps=1)["axes"]["a"]}
    lines = printed(replace(summary(), timing=told), width=80).splitlines()
    assert len(lines) <= 26
    assert max(map(len, lines)) <= 80
    wide = printed(replace(summary(), timing=told)).splitlines()
    rows = [line.strip("│ ") for line in wide if "Timing of" in line]
    assert [row.split("  ", 1)[0] for row in rows] == ["Timing of a", "Timing of b", "Timing of c"]
    assert rows[0].endswith("12 uncertain")
    assert rows[2].endswith("set once")


def test_a_run_that_is_not_trusted_says_why() -> None:
    found = summary().also(Finding(VerdictKind.NOT_TRUSTWORTHY, "axis1: 3 readings came before their SYNC"))
    assert "ling2012: NOT TRUSTWORTHY" in printed(found)
    assert "Not trustworthy: axis1: 3 readings came" in printed(found)


def test_a_run_of_which_nothing_was_asked_does_not_say_passed() -> None:
    text = printed(summary(limits=VerdictLimits()))
    assert "ling2012: COMPLETED, NOTHING WAS ASKED" in text
    assert "PASSED" not in text


def test_a_load_machine_is_told_by_its_steps_and_readings() -> None:
    steps = [{"asked_nm": 0.6, "measured_nm": 0.59876}, {"asked_nm": 123.0, "measured_nm": None}]
    machine = {"identity": "ACME 1", "steps": steps, "readings": 400, "late": 3, "spoilt": 2}
    words = " ".join(printed(replace(summary(), load_machine=machine)).replace("│", "").split())
    assert words.partition("Load machine ")[2].partition(" Bus load")[0] == (
        "ACME 1: 0.6 N m asked, 0.5988 measured; 123 N m asked, - measured; 400 readings, 3 late, 2 spoilt"
    )
    assert "Load machine" not in printed(summary())


def test_recording_is_named_with_the_command_that_opens_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    expected = ["Recording  runs/x/run.rrd", f"Open with  {viewer_command()} runs/x/run.rrd"]
    assert recording_lines("runs/x") == expected
    assert recording_lines(str(tmp_path / "runs" / "x")) == expected
    assert recording_lines("") == ["Recording  none requested"]


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
    assert [line for line in lines if " 25 %" in line] == [bar_line("running", 0.5, 2.0, 25)]
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
