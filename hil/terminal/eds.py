"""``hil eds``: a data sheet read, repaired, and compared with the needs of a bench."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from servobench.hil.terminal.options import JsonOption, bitrate_option, flag, valued
from servobench.hil.terminal.output import put
from servobench.hil.verdict.verdict import ExitStatus

ANY_NODE = 1
"""Node-ID for $NODEID if neither the user nor the file gives one."""


def eds(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="EDS, DCF, XDD or XDC of a device.")],
    node: Annotated[
        int | None,
        valued("--node", None, "Node id for $NODEID; default: a DCF's own, or 1.", min=1, max=127),
    ] = None,
    plan: Annotated[bool, flag("--plan", "Show the PDO plan and its bus load.")] = False,
    mode: Annotated[
        Literal["cst", "csv", "csp", "ip", "vl", "pt", "pv", "pp"] | None,
        valued("--mode", None, "Mode to plan for; default: the best available."),
    ] = None,
    period_us: Annotated[int, valued("--period-us", None, "Period of the loop, us.", min=100)] = 1000,
    bitrate: Annotated[int, bitrate_option("Bit rate, bit/s.")] = 1_000_000,
    as_json: JsonOption = False,
) -> None:
    """Read an EDS, DCF, XDD or XDC: the device's use for a bench, and the repairs needed to read the file.

    Exit status: 0 it can serve a bench, 1 it cannot (the output says why), 2 the file cannot be read.

    Examples:
      hil eds drive.eds --plan
    """
    from servobench.drivers.sheets.dictionary import load_dictionary
    from servobench.drivers.sheets.fitness import assess
    from servobench.hil.commissioning.drive_port import QUANTITY_OF_MODE
    from servobench.hil.terminal.eds_report import print_sheet
    from servobench.hil.terminal.eds_sheet import plan_for, sheet

    loaded = load_dictionary(file, node)
    if loaded.dictionary.node_id is None:
        loaded = load_dictionary(file, ANY_NODE)
    node_id = loaded.dictionary.node_id or ANY_NODE
    fitness = assess(loaded, node_id, tuple(QUANTITY_OF_MODE))
    planned = None
    if plan or mode:
        planned = plan_for(loaded, fitness, node_id, mode, period_us, bitrate)
    figures = sheet(file, loaded, fitness, planned)
    put(figures, as_json, lambda _figures: print_sheet(file, loaded, fitness, planned))
    raise typer.Exit(ExitStatus.PASSED if fitness.serves else ExitStatus.FAILED)
