"""Sealed folders of every kind: recordings of a run, with user's code, of a run that failed in a campaign and
of one recovered; stores of a campaign in one part and in several."""

import os
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple

from servobench.hil.campaign.campaign import Campaign, run_campaign
from servobench.hil.campaign.store import schema_of, stored_runs
from servobench.hil.configuration.bench_file import Bench, load_bench
from servobench.hil.execution.recovered_run import recover_run
from servobench.hil.rows.run_files import LOGGER_LOG, PRINTED_FILE, SEAL_FILE, SUMMARY_FILE
from servobench.hil.rows.seal import check_seal
from tests.unit.hil.recorded_runs import BENCH, short_run

HOOKS: Final = Path(__file__).parents[1] / "exits" / "misused_hooks.py"
UNSEALED: Final = frozenset({LOGGER_LOG, PRINTED_FILE})
"""What processes write beside a recording as long as they live."""
RUNS: Final = 4
"""Of a campaign; the first fails and is recorded."""
SWEEP: Final = f"""
[campaign]
name = "mutated"
bench = "{BENCH}"
seeds = {RUNS}
failures_recorded = 1
[change]
"bench.duration_s" = 0.3
load = {{}}
verdict = {{ speed_error_rms_rad_s_max = 0.001 }}
"""


class Evidence(NamedTuple):
    """A sealed folder."""

    folder: Path
    files: Sequence[Path]
    """Each that is sealed, and not empty."""
    check: Callable[[], object]
    """What every command that reads it asks first."""
    commands: Sequence[Sequence[str]]
    """Those that read it, without what has them read it unsealed."""
    can_be_unsealed: bool


def made_evidence(folder: Path, command: Callable[[Sequence[str], Path], object]) -> list[Evidence]:
    """All of them, in ``folder``; ``command`` runs a command line, what it prints goes into a file."""
    whole = short_run(folder / "whole")
    written = folder / "written"
    written.mkdir()
    runs = [short_run(folder / "run", seed=7), _with_own_code(folder, command), _recovered(folder)]
    stores = [_campaign(folder, "store", parts=1), _campaign(folder, "parts", parts=RUNS)]
    runs += stores[0].folder.glob("failures/*")
    return [_recording(run, whole, written) for run in runs] + [_store(each, written) for each in stores]


def _with_own_code(folder: Path, command: Callable[[Sequence[str], Path], object]) -> Path:
    bench, run = folder / "own.toml", folder / "own"
    parameters = {"where": "output", "way": "print('said')"}
    own = {"kind": "python", "object": f"{HOOKS}:Hooks", "parameters": parameters}
    changes = {"bench.duration_s": 0.3, "load": {}, "drive.axis1.controller": own}
    bench.write_text(Bench.load(BENCH).changed(changes).config.resolved_text(), encoding="utf-8")
    command(["run", str(bench), "--record", str(run)], folder / "said")
    return run


def _recovered(folder: Path) -> Path:
    """Its logger was killed before it wrote the second half of its seal."""
    run = short_run(folder / "recovered")
    (run / SUMMARY_FILE).unlink()
    lines = (run / SEAL_FILE).read_text().splitlines(keepends=True)
    (run / SEAL_FILE).write_text("".join(lines[: len(lines) // 2]))
    recover_run(load_bench(BENCH).as_run("simulated", None), run)
    return run


def _campaign(folder: Path, name: str, parts: int) -> Campaign:
    sweep = folder / f"{name}.toml"
    sweep.write_text(SWEEP, encoding="utf-8")
    for _ in range(parts):
        done = run_campaign(sweep, folder / name, workers=1, resume=True, seconds=0.0 if parts > 1 else None)
    return done


def _recording(run: Path, whole: Path, written: Path) -> Evidence:
    files = [path for path in sorted(run.iterdir()) if path.stat().st_size and path.name not in UNSEALED]
    commands = (
        ("export", "{}", "--to", "csv", "--out", os.devnull),
        ("review", "{}"),
        ("trace", "{}"),
        ("runs", "{}"),
        ("compare", "{}", str(whole)),
        ("compare", str(whole), "{}"),
        ("picture", "{}", str(written / "figure.svg"), "--paper"),
    )
    return Evidence(run, files, partial(check_seal, run), commands, can_be_unsealed=True)


def _store(done: Campaign, written: Path) -> Evidence:
    kept = ("campaign.json", SEAL_FILE)
    files = [done.folder / name for name in kept] + sorted(done.folder.glob("runs/*"))
    commands = (
        ("campaign", "report", "{}"),
        ("campaign", "replay", "{}", "--run", "1", "--into", str(written / "replayed")),
        ("campaign", "run", str(done.plan.source), "--out", "{}", "--resume"),
    )
    check = partial(stored_runs, done.folder, schema_of(done.plan))
    return Evidence(done.folder, files, check, commands, can_be_unsealed=False)
