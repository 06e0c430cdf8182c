"""Short runs of the example, recorded, for tests of what is done with recordings."""

from pathlib import Path

from servobench.hil.configuration.bench_file import load_bench
from servobench.hil.execution.bench import run_bench

BENCH = Path(__file__).parents[3] / "examples" / "ling2012.toml"


def short_run(folder: Path, duration_s: float = 0.3, seed: int | None = None) -> Path:
    """The folder of a run of the first part of the example."""
    bench = load_bench(BENCH)
    cut = bench.bench.model_copy(update={"duration_s": duration_s})
    short = bench.model_copy(update={"bench": cut, "load": {}})
    run_bench(short, seed=seed, record=folder)
    return folder
