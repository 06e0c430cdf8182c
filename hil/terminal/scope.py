"""``hil scope``: objects of a drive over time."""

from pathlib import Path
from typing import Annotated

import typer

from servobench.hil.terminal.options import (
    BitrateOption,
    DriveBusOption,
    DriveNodeOption,
    JsonOption,
    flag,
    valued,
)
from servobench.hil.terminal.output import put, say_written
from servobench.hil.verdict.verdict import ExitStatus


def scope(
    bus: DriveBusOption,
    node: DriveNodeOption,
    objects: Annotated[
        list[str], valued("--object", "INDEX[:SUB]", "Object to watch, hexadecimal; repeatable.")
    ],
    seconds: Annotated[float, valued("--seconds", "S", "Time to watch.", min=0.05, max=3600)] = 5.0,
    out: Annotated[
        Path | None, valued("--out", "DIR", "Folder for samples.csv, scope.png and scope.html.")
    ] = None,
    eds: Annotated[Path | None, valued("--eds", "FILE", "Data sheet that names makers' objects.")] = None,
    sdo: Annotated[bool, flag("--sdo", "Ask for what the drive sends in PDOs too.")] = False,
    bitrate: BitrateOption = 1_000_000,
    as_json: JsonOption = False,
) -> None:
    """Watch objects of a drive: out of the PDOs that it sends anyway, else asked for by SDO, one by one.

    Nothing is written to the drive. For each object it tells least, mean and greatest value, how many
    samples came by what way, how often, and how sure their instants are. An object whose PDO does not come
    within half a second is asked for by SDO. While another master asks the drive by SDO, watch objects of
    PDOs alone. Exit status: 0 done, 1 an object gave no sample, 2 bad input, 3 no answer.

    Examples:
      hil scope --bus hub:lab --node 1 --object 606C --object 6077 --out seen
    """
    from servobench.drivers.canopen.write_list import NOTHING
    from servobench.drivers.sheets.dictionary import load_dictionary
    from servobench.hil.execution.world import drive_network
    from servobench.hil.inspecting.scope import Scope, key_in, lines_of, seen_all
    from servobench.hil.inspecting.scope_files import make_folder, write_scope
    from servobench.hil.machine.stopping import stop_signals

    keys = [key_in(text) for text in objects]
    if out is not None:
        make_folder(out)
    sheet = None if eds is None else load_dictionary(eds, node)
    with stop_signals() as stop, drive_network(bus, bitrate, NOTHING) as network:
        watch = Scope(network, node, keys, sheet, sdo)
        channels = watch.watch(seconds, stop)
    files = [] if out is None else write_scope(out, channels, f"Node {node} on {bus}")
    for each in files:
        say_written(each)
    if watch.ended_by is not None:
        raise watch.ended_by
    stop.check()
    told = [each.as_json() for each in channels]
    figures = {"node": node, "objects": told, "files": [str(each) for each in files]}
    put(figures, as_json, lambda _figures: typer.echo("\n".join(lines_of(channels))))
    raise typer.Exit(ExitStatus.PASSED if seen_all(channels) else ExitStatus.FAILED)
