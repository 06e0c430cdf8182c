"""``hil params``: the parameters of a drive, kept in a file and compared."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from servobench.drivers.errors import BadInput
from servobench.hil.terminal.options import (
    BitrateOption,
    DriveBusOption,
    DriveNodeOption,
    JsonOption,
    bus_option,
    valued,
)
from servobench.hil.terminal.output import put, say, say_written
from servobench.hil.verdict.verdict import ExitStatus

if TYPE_CHECKING:
    from servobench.hil.inspecting.parameters import ParameterDifference, ParameterSet

_NAME_MAX = 40
"""Letters of a name in the table; makers' names go to a hundred."""


def save(
    file: Annotated[Path, typer.Argument(metavar="FILE.dcf", help="The DCF to write; none may be there.")],
    bus: DriveBusOption,
    node: DriveNodeOption,
    eds: Annotated[Path, valued("--eds", "FILE", "Data sheet that names the parameters.")],
    bitrate: BitrateOption = 1_000_000,
    as_json: JsonOption = False,
) -> None:
    """Read every parameter of a drive and write them to a DCF (CiA 306-1).

    Nothing is written to the drive. Exit status: 0 all read, 1 the drive refused some, 2 bad input, 3 no
    answer or another device.

    Examples:
      hil params save drive.dcf --bus hub:lab --node 1 --eds drive.eds
    """
    from servobench.drivers.canopen.objects301 import object_name
    from servobench.drivers.canopen.write_list import NOTHING
    from servobench.drivers.written_file import written
    from servobench.hil.execution.world import drive_network
    from servobench.hil.inspecting.parameters import configuration_text, read_parameters

    if file.exists():
        raise BadInput("FILE.dcf", "", str(file), "a file that is not there yet")
    with drive_network(bus, bitrate, NOTHING) as network:
        read, dictionary, identity = read_parameters(network, node, eds, bus, _note)
    text = configuration_text(read, dictionary, identity, bitrate)
    with written("FILE.dcf", file) as path:
        path.write_text(text, encoding="utf-8")
    say_written(file)
    refused = {object_name(*place): why for place, why in read.unread.items()}
    figures = {"file": str(file), "node": node, "parameters": len(read.values), "refused": refused}
    put(figures, as_json, lambda _figures: _print_saved(len(read.values), refused))
    raise typer.Exit(ExitStatus.FAILED if refused else ExitStatus.PASSED)


def diff(
    first: Annotated[Path, typer.Argument(metavar="FIRST.dcf", help="A DCF or XDC with parameter values.")],
    second: Annotated[
        Path | None,
        typer.Argument(metavar="[SECOND.dcf]", help="Another one; default: the drive of --bus and --node."),
    ] = None,
    bus: Annotated[str | None, bus_option("hub:NAME, socketcan:can0, or INTERFACE:CHANNEL.")] = None,
    node: Annotated[
        int | None, valued("--node", "N", "Node id of the drive to compare.", min=1, max=127)
    ] = None,
    bitrate: BitrateOption = 1_000_000,
    as_json: JsonOption = False,
) -> None:
    """Compare the parameters of two files, or of a file and a drive.

    Nothing is written to the drive. Exit status: 0 equal, 1 they differ, 2 bad input, 3 no answer or another
    device.

    Examples:
      hil params diff drive.dcf --bus hub:lab --node 1
    """
    from servobench.hil.inspecting.parameters import differences, parameters_of

    if (second is None) != (bus is not None and node is not None) or (bus is None) != (node is None):
        given = {"SECOND.dcf": second, "--bus": bus, "--node": node}
        found = ", ".join(name for name, value in given.items() if value is not None) or "FIRST.dcf alone"
        raise BadInput("SECOND.dcf", "", found, "a second file, or --bus and --node of a drive")
    mine = parameters_of(first, node)
    theirs = parameters_of(second) if second is not None else _of_drive(first, str(bus), node or 0, bitrate)
    found_differences = differences(mine, theirs)
    figures = {
        "first": mine.source,
        "second": theirs.source,
        "parameters": len(mine.values.keys() | theirs.values.keys()),
        "differences": [_figures(each) for each in found_differences],
    }
    put(figures, as_json, lambda _figures: _print_differences(mine, theirs, found_differences))
    raise typer.Exit(ExitStatus.FAILED if found_differences else ExitStatus.PASSED)


def _of_drive(sheet: Path, bus: str, node: int, bitrate: int) -> "ParameterSet":
    from servobench.drivers.canopen.write_list import NOTHING
    from servobench.hil.execution.world import drive_network
    from servobench.hil.inspecting.parameters import read_parameters

    with drive_network(bus, bitrate, NOTHING) as network:
        return read_parameters(network, node, sheet, bus, _note)[0]


def _note(text: str) -> None:
    say(f"hil: note: {text}")


def _figures(each: "ParameterDifference") -> dict[str, Any]:
    from servobench.drivers.canopen.objects301 import object_name

    figures = {"object": object_name(*each.place), "name": each.name}
    return figures | {"first": each.first or None, "second": each.second or None}


def _print_saved(count: int, refused: dict[str, str]) -> None:
    typer.echo(f"{count} parameters read, {len(refused)} refused")
    for name, why in refused.items():
        typer.echo(f"  {name}: {why}")


def _print_differences(
    mine: "ParameterSet", theirs: "ParameterSet", found: "list[ParameterDifference]"
) -> None:
    from servobench.drivers.canopen.objects301 import object_name

    count = len(mine.values.keys() | theirs.values.keys())
    typer.echo(f"{len(found)} of {count} parameters differ: {mine.source}, {theirs.source}")
    for each in found:
        name = each.name if len(each.name) <= _NAME_MAX else f"{each.name[: _NAME_MAX - 3]}..."
        values = (value or "none" for value in (each.first, each.second))
        typer.echo(f"  {object_name(*each.place):<11}{name:<{_NAME_MAX + 2}}{'  '.join(values)}")
