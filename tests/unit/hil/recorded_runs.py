"""Short runs of the example, recorded, for tests of what is done with recordings."""

import atexit
import shutil
import tempfile
from functools import cache
from pathlib import Path

from servobench.hil.configuration.bench_file import load_bench
from servobench.hil.execution.bench import run_bench

BENCH = Path(__file__).parents[3] / "examples" / "ling2012.toml"


def short_run(folder: Path, duration_s: float = 0.3, seed: int | None = None) -> Path:
    """The folder of a run of the first part of the example: a copy, as a process makes each run once."""
    return Path(shutil.copytree(_made(duration_s, seed), folder))


@cache
def _made(duration_s: float, seed: int | None) -> Path:
    place = Path(tempfile.mkdtemp(prefix="short-run-"))
    atexit.register(shutil.rmtree, place, ignore_errors=True)
    bench = load_bench(BENCH)
    cut = bench.bench.model_copy(update={"duration_s": duration_s})
    run_bench(bench.model_copy(update={"bench": cut, "load": {}}), seed=seed, record=place / "run")
    return place / "run"
