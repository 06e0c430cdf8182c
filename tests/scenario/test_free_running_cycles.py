"""Limits of the position examples hold in every phase of the drive's own position loop to the SYNC.

Profiles and position loop of the simulated drive run once a millisecond from its power-on, so a set-point
waits for up to a millisecond, by a phase that the instant decides at which a run begins. An inner rate beside
16 kHz makes that phase wander: at the kink of the reference, at 0.75 s, it is another one for each.
"""

from pathlib import Path

import pytest

from servobench.drivers.bounded_file import read_toml
from servobench.hil.configuration.bench_file import bench_from
from servobench.hil.execution.bench import run_bench

EXAMPLES = Path(__file__).parents[2] / "examples"
RATES_HZ = (16_005, 16_009, 16_010)


@pytest.mark.parametrize("name", ["position_csv", "position_csp", "position_ip"])
def test_the_limits_of_an_example_hold_in_every_phase(name: str) -> None:
    peaks = []
    for rate_hz in RATES_HZ:
        tables = read_toml(EXAMPLES / f"{name}.toml", "bench file")
        drive = tables["drive"]["axis1"]
        drive["motor"] = str(EXAMPLES / "motors" / "ling2012.toml")
        drive["simulation"] = {"inner_rate_hz": rate_hz}
        summary = run_bench(bench_from(tables, "bench.toml", Path()), keep=False)
        assert summary.verdict.passed, summary.verdict.reason
        peaks.append(summary.position_error.following_peak_rad or summary.position_error.peak_rad or 0.0)
    assert max(peaks) > min(peaks) + 1e-3, "the phase is another one"
