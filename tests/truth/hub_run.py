"""A run on a hub with its drives in another process, beside a third client, held against what that heard."""

import json
import os
import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from servobench.hil.configuration.config import BenchConfig
from servobench.hil.rows.records import ROW_DTYPE
from servobench.hil.rows.records_file import read_metadata, read_records
from servobench.hil.rows.run_files import RECORDS_FILE
from servobench.hil.testing.hosted import DriveProcess
from servobench.hil.testing.wire import pdo_plans
from servobench.virtual_bus.bus.hub_place import HubPlace
from tests.scenario.processes import HIL, RUN_TIMEOUT_S, loop_of, start_run
from tests.truth.command_judge import CommandJudgement, judge_commands
from tests.truth.hub_listener import heard, listening
from tests.truth.hub_truth import Spacings, hub_truth, sync_spacings
from tests.truth.judge import Judgement, Timing, judge_axis
from tests.truth.plans import Plan
from tests.truth.rows import USED, Told, told_by
from tests.truth.runner import ROOT, SEED, bench_config
from tests.truth.stalls import Stalls, stalling
from tests.truth.sync_process import making_syncs

FRAMES, COMMANDS = "frames.bin", "commands.bin"
MOTOR: Final = ROOT / "examples" / "motors" / "ling2012.toml"


@dataclass(frozen=True, slots=True)
class HubOutcome:
    """What came of it."""

    status: int
    """Of ``hil run``."""
    said: str
    summary: dict[str, Any]
    readings: Judgement
    commands: CommandJudgement
    spacings: Spacings
    negative_delays: int
    delays_us: tuple[float, float, float]
    """p50, p99, max, as told."""


def run_beside_a_listener(
    plan: Plan,
    cycles: int,
    folder: Path,
    drive_faults: str = "",
    stalls: Stalls | None = None,
    by: Sequence[str] = HIL,
) -> HubOutcome:
    """``hil run`` and ``hil simulate`` for ``cycles`` planned cycles of ``plan``.

    ``folder``: of the run's files. ``drive_faults``: TOML, a fault plan of the drives' side. ``stalls``: of
    host, drives and the hub's broker. ``by``: see :func:`start_run`; stalls need processes of its own.
    """
    config = bench_config(plan, cycles, on_hub=True)
    hub = f"truth-{os.getpid()}"
    bench = folder / "bench.toml"
    bench.write_text(config.as_run(f"hub:{hub}", None).resolved_text(), encoding="utf-8")
    with listening(hub, folder / FRAMES), _producer(plan, hub):
        drives = DriveProcess(_simulate(hub, plan.axes, folder, drive_faults), folder / "drives.log")
        try:
            process = start_run(bench, f"hub:{hub}", folder / "run", by=by)
            victims = _victims(hub, process.pid, drives.pid) if stalls else ()
            with stalling(stalls, victims):
                out, said = process.communicate(timeout=RUN_TIMEOUT_S + config.bench.duration_s)
        finally:
            drives.stop()
    summary = json.loads(out) if out.strip() else {}
    return _outcome(config, folder, process.returncode, said, summary)


def _victims(hub: str, host: int, drives: int) -> list[int]:
    return [loop_of(host), drives, int(HubPlace(hub).alive.read_text())]


def _producer(plan: Plan, hub: str) -> AbstractContextManager[None]:
    """Who makes the SYNCs of a plan that does not leave them to the loop."""
    if not plan.heard:
        return nullcontext()
    return making_syncs(hub, plan.producer_period_us, plan.producer_jitter_us, seed=SEED)


def _simulate(hub: str, axes: int, folder: Path, faults: str) -> list[str]:
    command = [sys.executable, "-m", "tests.truth.tapped_drives", str(folder / COMMANDS), "simulate"]
    command += ["--bus", f"hub:{hub}", "--node", f"1-{axes}", "--motor", str(MOTOR)]
    if faults:
        (folder / "drive_faults.toml").write_text(faults, encoding="utf-8")
        command += ["--faults", str(folder / "drive_faults.toml")]
    return command


def _outcome(
    config: BenchConfig, folder: Path, status: int, said: str, summary: dict[str, Any]
) -> HubOutcome:
    frames, heard_commands = heard(folder / FRAMES), heard(folder / COMMANDS)
    records = folder / "run" / RECORDS_FILE
    first_cycle = int(read_metadata(records)["first_cycle_bench_ns"])
    rows = np.concatenate([np.empty(0, ROW_DTYPE), *read_records(records, first_cycle)])
    heard_syncs = config.loop.sync != "own"
    timing = Timing(config.loop.period, config.loop.deadline, config.loop.horizon_periods, heard_syncs)
    readings, commands, negative, delays = Judgement(), CommandJudgement(), 0, list[int]()
    plans = pdo_plans(config)
    for axis, name in enumerate(config.axes):
        told = told_by(rows, axis, timing.period)
        truth = hub_truth(frames, told, plans[name], heard_commands, heard_syncs)
        readings.add(judge_axis(told, truth, timing))
        commands.add(judge_commands(told, truth))
        negative += int((_used_delays(told) < 0).sum())
        delays += _used_delays(told).tolist()
    spacings = sync_spacings(truth, told, timing.period)
    p50, p99, most = (float(np.percentile(delays, q)) / 1e3 for q in (50, 99, 100))
    return HubOutcome(status, said, summary, readings, commands, spacings, negative, (p50, p99, most))


def _used_delays(told: Told) -> NDArray[np.int64]:
    delays: NDArray[np.int64] = told["delay_ns"][told["fate"] == USED]
    return delays
