"""The same seed gives the same records: twice, in another process and hash seed, at another pace."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from hil.bench import BenchResult, run_bench
from hil.configuration.bench_file import load_bench
from hil.recording.records_file import read_records
from hil.terminal.progress import no_progress

BENCH = Path(__file__).parents[2] / "examples" / "ling2012.toml"
SHORT_S = 0.5


@pytest.fixture(scope="module")
def short_bench(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The example with all its faults, cut to half a second."""
    text = BENCH.read_text().replace("duration_s = 2.0", f"duration_s = {SHORT_S}")
    text = text.replace('"motors/', f'"{BENCH.parent}/motors/').replace(
        '"faults/', f'"{BENCH.parent}/faults/'
    )
    text = text.replace("at_s = 1.0", "at_s = 0.3")
    path = tmp_path_factory.mktemp("bench") / "short.toml"
    path.write_text(text)
    return path


def run(bench: Path, record: Path, seed: int = 2012, time: str | None = None) -> BenchResult:
    return run_bench(
        load_bench(bench),
        bus_spec=None,
        time=time,
        seed=seed,
        record=record,
        view=False,
        progress=no_progress,
    )


@pytest.fixture(scope="module")
def digest(short_bench: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    """Of the reference run."""
    return str(run(short_bench, tmp_path_factory.mktemp("run") / "a").summary["digest"])


def test_the_same_seed_gives_the_same_digest_and_another_another(
    short_bench: Path, digest: str, tmp_path: Path
) -> None:
    assert run(short_bench, tmp_path / "b").summary["digest"] == digest
    assert run(short_bench, tmp_path / "c", seed=9).summary["digest"] != digest


@pytest.mark.parametrize("hash_seed", ["0", "77"])
def test_another_process_and_hash_seed_give_the_same_digest(
    short_bench: Path, digest: str, tmp_path: Path, hash_seed: str
) -> None:
    command = [
        sys.executable,
        "-m",
        "hil.cli",
        "run",
        str(short_bench),
        "--json",
        "--record",
        str(tmp_path / "r"),
    ]
    done = subprocess.run(
        command, env={**os.environ, "PYTHONHASHSEED": hash_seed}, capture_output=True, text=True, check=False
    )
    assert json.loads(done.stdout)["digest"] == digest


def test_the_pace_changes_nothing(short_bench: Path, digest: str, tmp_path: Path) -> None:
    paced = run(short_bench, tmp_path / "paced", time="real").summary
    assert paced["digest"] == digest
    assert paced["realtime_factor"] < 1.3


def test_every_cycle_has_one_record_and_one_fate(short_bench: Path, tmp_path: Path) -> None:
    summary = run(short_bench, tmp_path / "r").summary
    records = list(read_records(tmp_path / "r" / "records.arrow"))
    rows = sum(len(chunk) for chunk in records)
    assert rows == summary["cycles"] == round(SHORT_S * 1000)
    dropped = sum(summary["dropouts"].values())
    used = sum(int((chunk["fate"] == 0).sum()) for chunk in records)
    assert used + dropped == rows
    assert dropped > 0
