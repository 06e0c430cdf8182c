"""``hil recover``: completes the recording of a run whose recorder died."""

from pathlib import Path
from typing import Annotated

import typer

from servobench.hil.terminal.options import JsonOption
from servobench.hil.terminal.output import put


def recover(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="The folder of the run.")],
    as_json: JsonOption = False,
) -> None:
    """Complete the recording of a run whose recorder died.

    Its missing summary is written from its rows, and its files are cut after their last whole entries.
    A whole recording is never touched. Exit status: 0 recovered, 2 nothing to recover, 5 the disk is full.

    Examples:
      hil recover runs/killed   # a run that was killed
    """
    from servobench.hil.configuration.bench_file import load_bench
    from servobench.hil.execution.recovered_run import recover_run, refuse_whole
    from servobench.hil.terminal.report import print_run

    refuse_whole(run)
    config = load_bench(run / "bench.toml")
    summary = recover_run(config, run)
    put(summary.as_json(), as_json, lambda _figures: print_run(config, summary))
