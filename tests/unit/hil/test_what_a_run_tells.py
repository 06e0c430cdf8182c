"""What a run tells of its timing and of its guards, beside its figures."""

from typing import Any

import pytest

from servobench.hil.configuration.network_file import load_network
from servobench.hil.testing.bench_runs import BenchRunner
from tests.scenario.processes import EXAMPLES

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("forked_children")]

SHORT: dict[str, Any] = {"bench.duration_s": 0.4, "verdict": {}, "load": {}}
LACKS = "drive.axis1.simulation.lacks"


@pytest.mark.parametrize(
    ("lacks", "level", "guard", "warnings"),
    [
        ([], "INFO", "the drive itself (1400h:05)", []),
        (["1400:5"], "INFO", "the host by 6074h", []),
        (["1400:5", "6074"], "INFO", "the host by 6077h", ["which command acts is not measured"]),
        (["1013"], "INFO", "the drive itself", ["readings are attributed to SYNCs by their order"]),
    ],
)
def test_a_run_says_who_watches_the_commands_and_warns_of_what_is_lacking(
    servo_bench: BenchRunner, lacks: list[str], level: str, guard: str, warnings: list[str]
) -> None:
    run = servo_bench(EXAMPLES / "ling2012.toml", SHORT | {LACKS: lacks}, faults={})
    texts = [(event["level"], event["text"]) for event in run.events if "text" in event]
    told = [(how, text) for how, text in texts if "its commands are watched by" in text]
    assert [(how, guard in text) for how, text in told] == [(level, True)]
    warned = [text for how, text in texts if how == "WARN"]
    assert len(warned) == len(warnings)
    assert all(wanted in text for wanted, text in zip(warnings, warned, strict=True))


def test_a_clock_that_is_set_stands_in_events_summary_and_network_file(servo_bench: BenchRunner) -> None:
    faults = {"clock_step": [{"nodes": [1], "at_s": 0.2, "step_us": -350}]}
    run = servo_bench(EXAMPLES / "ling2012.toml", SHORT, faults=faults)
    assert any("its clock was set by -350 us" in event.get("text", "") for event in run.events)
    timing = run.summary.timing
    assert timing is not None
    told = timing["axes"]["axis1"]
    assert told["clock_steps"] == 1
    network = load_network(run.folder / "network.toml")
    assert network.clocks["axis1"].steps == 1
    assert network.uncertain_percent == pytest.approx(100.0 * told["uncertain"] / network.cycles)


def test_cycles_without_sync_are_told(servo_bench: BenchRunner) -> None:
    faults = {"host_stall": [{"at_s": 0.2, "late_us": 5400}]}
    run = servo_bench(EXAMPLES / "ling2012.toml", SHORT, faults=faults)
    assert run.summary.dropouts.missed == 5
    assert load_network(run.folder / "network.toml").missed == 5
    assert any("5 cycles went without SYNC" in event.get("text", "") for event in run.events)
