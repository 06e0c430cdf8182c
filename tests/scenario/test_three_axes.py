"""Three drives at 1 kHz on one bus."""

from pathlib import Path

from hil.bench import run_bench
from hil.configuration.bench_file import load_bench
from hil.terminal.progress import no_progress

BENCH = Path(__file__).parents[2] / "examples" / "three_axes.toml"


def test_three_axes_keep_their_limits_on_one_bus(tmp_path: Path) -> None:
    result = run_bench(
        load_bench(BENCH),
        bus_spec=None,
        time=None,
        seed=None,
        record=tmp_path / "run",
        view=False,
        progress=no_progress,
    )
    assert result.passed, result.summary["verdict"]
    assert result.summary["cycles"] == 2000
    assert sum(result.summary["dropouts"].values()) == 0
    assert 60.0 < result.summary["bus_load_percent"] < 75.0
