"""The same seed gives the same records: twice, in another process and hash seed, at another pace."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from servobench.hil.loop.cycle_record import FATE_SAMPLE
from servobench.hil.testing.bench_runs import BenchRunner
from tests.draws import few_of
from tests.scenario.processes import EXAMPLES

BENCH = EXAMPLES / "ling2012.toml"
SHORT_S = 0.5
SHORT = {"bench.duration_s": SHORT_S, "load.axis1.0.at_s": 0.3}
"""The example with all its faults, cut to half a second."""
HASH_SEEDS = few_of(("77", "0"), 1)


def test_the_same_seed_gives_the_same_digest_and_another_another(servo_bench: BenchRunner) -> None:
    digests = [servo_bench(BENCH, SHORT, seed=seed).digest for seed in (None, 2012, 9)]
    assert digests[0] == digests[1] != digests[2]


def test_another_process_and_hash_seed_give_the_same_digest(servo_bench: BenchRunner, tmp_path: Path) -> None:
    run = servo_bench(BENCH, SHORT)
    for hash_seed in HASH_SEEDS:
        command = [
            sys.executable,
            "-m",
            "servobench.hil.cli",
            "run",
            str(run.folder / "bench.toml"),
            "--json",
        ]
        done = subprocess.run(
            [*command, "--record", str(tmp_path / hash_seed)],
            env={**os.environ, "PYTHONHASHSEED": hash_seed},
            capture_output=True,
            text=True,
            check=False,
        )
        assert json.loads(done.stdout)["digest"] == run.digest


def test_the_pace_changes_nothing(servo_bench: BenchRunner) -> None:
    paced = servo_bench(BENCH, SHORT, time="real")
    assert paced.digest == servo_bench(BENCH, SHORT).digest
    assert 0.1 < (paced.summary.realtime_factor or 0.0) < 1.3


def test_every_cycle_has_one_record_and_one_fate(servo_bench: BenchRunner) -> None:
    run = servo_bench(BENCH, SHORT)
    assert run.rows.size == run.summary.cycles == round(SHORT_S * 1000)
    assert (np.diff(run.rows["sequence"]) == 1).all()
    used = int((run.rows["fate"] == FATE_SAMPLE).sum())
    assert used + run.summary.dropouts.total == run.rows.size
    run.assert_dropouts_handled()


@pytest.mark.parametrize("faults", ["demo", "noise"])
def test_the_bus_carries_the_same_frames_too(servo_bench: BenchRunner, faults: str) -> None:
    plan = EXAMPLES / "faults" / f"{faults}.toml"
    first, second = (servo_bench(BENCH, SHORT, faults=plan).wire.frames for _ in range(2))
    assert len(first) > 1000
    assert first == second
