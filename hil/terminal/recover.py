"""``hil recover``: ends the recording of a run whose recorder did not live to the end of it."""

import json
from pathlib import Path
from typing import Annotated

import typer

from hil.terminal.exit_status import reported_errors
from hil.terminal.options import JsonOption


def recover(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="The folder of the run.")],
    as_json: JsonOption = False,
) -> None:
    """Write the missing summary of a run from its rows, and end its files behind their last whole entries.

    A whole recording is never touched. Exit status: 0 recovered, 2 nothing to recover, 5 the disk is full.
    """
    with reported_errors():
        from hil.configuration.bench_file import load_bench
        from hil.execution.recovered_run import recover_run, refuse_whole
        from hil.terminal.report import print_run

        refuse_whole(run)
        config = load_bench(run / "bench.toml")
        summary = recover_run(config, run)
        if as_json:
            typer.echo(json.dumps(summary.as_json(), allow_nan=False))
        else:
            print_run(config, summary)
