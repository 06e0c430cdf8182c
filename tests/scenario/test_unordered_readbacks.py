"""Frames that come twice hide losses of commands behind their echo; the run and its network file say so."""

import tomllib
from pathlib import Path

import pytest

from servobench.drivers.bounded_file import read_toml
from servobench.hil.configuration.bench_file import bench_from
from servobench.hil.execution.bench import run_bench

EXAMPLE = Path(__file__).parents[2] / "examples" / "network_measured.toml"


@pytest.mark.parametrize("twice", [False, True])
def test_read_backs_beside_frames_that_came_twice_are_counted(twice: bool, tmp_path: Path) -> None:
    tables = read_toml(EXAMPLE, "bench file")
    tables["bench"]["duration_s"] = 0.4
    tables["loop"]["command_readback"] = "sync"
    tables["drive"]["axis1"]["motor"] = str(EXAMPLE.parent / "motors" / "ling2012.toml")
    double = [{"probability": 0.05, "later_us": 1000, "direction": "drive_to_host", "frames": ["pdo"]}]
    tables["faults"] = {"duplicate": double} if twice else {}
    summary = run_bench(bench_from(tables, "bench.toml", Path()), record=tmp_path)
    assert summary.timing is not None
    count = summary.timing["axes"]["axis1"]["readbacks_unordered"]
    assert (100 < count < 220) is twice, count
    network = tomllib.loads((tmp_path / "network.toml").read_text())["network"]
    assert network["clocks"]["axis1"]["readbacks_unordered"] == count
    if not twice:
        assert count == 0
