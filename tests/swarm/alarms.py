"""``python -m tests.swarm.alarms``: drawn drives that follow, and others that do not, until the time is up.

    follows      losses, delays, bursts, torques at a limit, on_sync, drives that lack something: no alarm
    does not     another mode, or set-points ignored with or without a word: never passed, never unnoticed

``--case N`` repeats one.
"""

import argparse
import tempfile
from pathlib import Path
from random import Random
from typing import Any, Final

from servobench.drivers.errors import BenchError
from servobench.drivers.timebase import NS_PER_S, MonotonicClock
from servobench.hil.configuration.bench_file import Bench
from servobench.hil.execution.bench import run_bench
from servobench.hil.testing.run import Run
from servobench.hil.verdict.verdict import VerdictKind

EXAMPLES: Final = Path(__file__).resolve().parents[2] / "examples"
FILES: Final = ("ling2012", "ling2012", "network_designed", "position_csv", "position_csp")
DURATION_S: Final = 1.2
ALARMS: Final = ("no longer follows its commands", " left ", "ignores the commands")
"""What a run says of a drive that does not follow."""


def bench_of(number: int) -> tuple[Bench, bool]:
    """The bench of a case, and whether its drive follows."""
    draw = Random(number)
    file = draw.choice(FILES)
    bench = Bench.load(EXAMPLES / f"{file}.toml")
    axis = next(iter(bench.tables["drive"]))
    changes: dict[str, Any] = {
        "bench.duration_s": DURATION_S,
        "bench.seed": number,
        "load": {},
        "verdict": {"dropouts_percent_max": 100},
        "loop.actuation": draw.choice(("on_arrival", "on_sync")) if file == "ling2012" else None,
        f"drive.{axis}.simulation.lacks": draw.choice(
            ([], [], ["1400:5"], ["6074"], ["1013"], ["tpdo events"])
        ),
    }
    if file == "ling2012" and draw.random() < 0.3:
        changes[f"drive.{axis}.limits.torque_max_nm"] = draw.choice((0.3, 1.0))
    follows = draw.random() < 0.5
    changes["faults"] = _network(draw) if follows else _lapse(draw)
    if not follows:
        changes["guard.on_mode"] = draw.choice(("tell", "stop"))
    kept = {key: value for key, value in changes.items() if value is not None}
    return bench.changed(kept), follows


def _network(draw: Random) -> dict[str, Any]:
    """What a drive that follows may meet: at most a third of what is borne in a row."""
    plan: dict[str, Any] = {}
    if draw.random() < 0.7:
        plan["loss"] = [{"probability": draw.choice((0.02, 0.1)), "frames": ["pdo"]}]
    if draw.random() < 0.5:
        low = draw.uniform(0.0, 3000.0)
        plan["delay"] = [
            {"delay_min_us": low, "delay_max_us": low + draw.uniform(100.0, 3000.0), "frames": ["pdo"]}
        ]
    if draw.random() < 0.3:
        plan["blackout"] = [{"from_s": 0.5, "duration_s": draw.choice((0.005, 0.03)), "frames": ["pdo"]}]
    return plan


def _lapse(draw: Random) -> dict[str, Any]:
    table: dict[str, Any] = {"nodes": [1], "at_s": round(draw.uniform(0.3, 0.6), 3)}
    if draw.random() < 0.5:
        table["duration_s"] = round(draw.uniform(0.05, 0.4), 3)
    if draw.random() < 0.5:
        return {"mode_change": [table | {"mode": draw.choice(("pp", "pv", "pt", "hm"))}]}
    holds, word = draw.choice(("last", "zero")), draw.choice((True, False))
    return {"ignored_commands": [table | {"holds": holds, "bit_12_cleared": word}]}


def complaints(number: int, folder: Path) -> list[str]:
    """What a case shows that may not be."""
    bench, follows = bench_of(number)
    config = bench.config
    run = Run(config, folder / "run")
    error = ""
    try:
        run_bench(config, record=run.folder, privileged=False)
    except BenchError as failure:
        error = str(failure)
    texts = [error, *(event["text"] for event in run.events if event.get("level") == "ERROR")]
    alarms = [text for text in texts if any(alarm in text for alarm in ALARMS)]
    if follows:
        return [f"case {number}: false alarm: {text}" for text in alarms]
    silent = _silent(config.faults)
    if run.verdict.outcome in (VerdictKind.PASSED, VerdictKind.NOTHING_ASKED) and not silent:
        return [f"case {number}: {run.verdict.outcome} though its drive did not follow: {config.faults}"]
    if silent and not alarms:
        return [f"case {number}: (not to be told apart?) {config.source} {config.faults}"]
    return []


def _silent(faults: Any) -> bool:
    """Nothing but the demand tells it, and that only if the commands change."""
    return "bit_12_cleared=False" in str(faults)


def main() -> None:
    """Print what may not be, and leave with 1 if anything was."""
    parser = argparse.ArgumentParser(prog="python -m tests.swarm.alarms", description=__doc__)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--case", type=int, help="only this one")
    options = parser.parse_args()
    clock = MonotonicClock()
    ends_at = clock.now() + options.seconds * NS_PER_S
    number = options.first if options.case is None else options.case
    ran, broken = 0, 0
    while clock.now() < ends_at and (options.case is None or not ran):
        with tempfile.TemporaryDirectory() as folder:
            found = complaints(number, Path(folder))
        for text in found:
            print(text, flush=True)
        ran, broken, number = ran + 1, broken + bool(found), number + 1
    print(f"{ran} runs, {broken} with complaints")
    raise SystemExit(broken > 0)


if __name__ == "__main__":
    main()
