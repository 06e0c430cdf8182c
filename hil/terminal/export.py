"""``hil export``: a recording's cycles or frames for other programs."""

from pathlib import Path
from typing import Annotated

import typer

from servobench.hil.reviewing.export_format import ExportFormat
from servobench.hil.terminal.options import JsonOption, UnsealedOption, valued
from servobench.hil.terminal.output import put


def export(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="The folder of the run.")],
    to: Annotated[ExportFormat, typer.Option("--to", help="Format.")],
    out: Annotated[
        Path | None,
        valued("--out", "FILE", "Output file; default: in RUN, records., frames. or faults.FORMAT."),
    ] = None,
    unsealed: UnsealedOption = False,
    as_json: JsonOption = False,
) -> None:
    """Write every cycle of a recording as CSV, Parquet, MDF 4 or MAT, with units and codes, every frame as
    candump's log, Vector's asc or blf, or pcap, or every injected fault as a line of JSON.

    Exit status: 0 written; 2 no recording, an unfinished one, or a file that cannot be written; 5 the disk is
    full.

    Examples:
      hil export runs/monday --to csv
      hil export runs/monday --to log   # for can-utils and Wireshark
    """
    from servobench.hil.reviewing.export import export_run
    from servobench.hil.rows.seal import doubt

    done = export_run(run, to, out, unsealed=unsealed)
    text = f"{done.file}: {done.rows} rows{doubt(done.seal)}"
    put(done._asdict(), as_json, lambda _figures: typer.echo(text))
