"""``hil params``: the parameters of a drive, kept in a file, compared, and loaded."""

from collections.abc import Callable
from contextlib import suppress
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
    flag,
    valued,
)
from servobench.hil.terminal.output import put, say, say_written
from servobench.hil.verdict.verdict import ExitStatus

if TYPE_CHECKING:
    from servobench.hil.inspecting.loading import Loaded, LoadRequest
    from servobench.hil.inspecting.parameters import ParameterDifference, ParameterSet
    from servobench.hil.inspecting.units import Place
    from servobench.hil.restoring.journal import JournaledNetwork

_NAME_MAX = 40
"""Letters of a name in the table; makers' names go to a hundred."""
_SHEET = valued("--eds", "FILE", "Data sheet that names the parameters.")
SheetOption = Annotated[Path, _SHEET]
OptionalSheetOption = Annotated[Path | None, _SHEET]
StoreOption = Annotated[bool, flag("--store", "Have the drive keep them (1010h).")]
OutOption = Annotated[
    Path | None, valued("--out", "DIR", "Folder of the journal; default: named by source and node.")
]


def save(
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE.dcf", help="The DCF to write, or .bin, a concise one; none may be there."
        ),
    ],
    bus: DriveBusOption,
    node: DriveNodeOption,
    eds: OptionalSheetOption = None,
    indices: Annotated[
        list[str] | None,
        valued("--range", "FIRST-LAST", "Without a sheet: indices to ask for, hexadecimal; default: all."),
    ] = None,
    bitrate: BitrateOption = 1_000_000,
    as_json: JsonOption = False,
) -> None:
    """Read every parameter of a drive and write them to a DCF (CiA 306-1), or a concise one (CiA 302-3).

    Without a data sheet the drive is asked for every index: types are guessed by size, and what changes
    meanwhile is no parameter. Nothing is written to the drive. Exit status: 0 all read, 1 the drive refused
    some, 2 bad input, 3 no answer or another device.

    Examples:
      hil params save drive.dcf --bus hub:lab --node 1 --eds drive.eds
      hil params save drive.bin --bus hub:lab --node 1 --eds drive.eds
      hil params save asked.dcf --bus hub:lab --node 1 --range 6060-60FF
    """
    from servobench.drivers.canopen.objects301 import object_name
    from servobench.drivers.canopen.write_list import NOTHING
    from servobench.drivers.sheets.concise import is_concise
    from servobench.drivers.written_file import written
    from servobench.hil.execution.world import drive_network
    from servobench.hil.inspecting.loading import concise_dcf
    from servobench.hil.inspecting.parameters import configuration_text, read_parameters
    from servobench.hil.inspecting.upload_scan import EVERY_INDEX

    if file.exists():
        raise BadInput("FILE.dcf", "", str(file), "a file that is not there yet")
    if indices and eds is not None:
        raise BadInput("--range", "", indices[0], "no --eds, whose objects are read")
    asked = tuple(_indices(text) for text in indices or ()) or EVERY_INDEX
    with drive_network(bus, bitrate, NOTHING) as network:
        read, dictionary, identity = read_parameters(network, node, eds, bus, _note, asked)
    concise = is_concise(file)
    data = concise_dcf(read) if concise else configuration_text(read, dictionary, identity, bitrate).encode()
    with written("FILE.dcf", file) as path:
        path.write_bytes(data)
    say_written(file)
    refused = {object_name(*place): why for place, why in read.unread.items()}
    figures = {"file": str(file), "node": node, "parameters": len(read.values), "refused": refused}
    put(figures, as_json, lambda _figures: _print_saved(len(read.values), refused))
    raise typer.Exit(ExitStatus.FAILED if refused else ExitStatus.PASSED)


def load(
    file: Annotated[
        Path,
        typer.Argument(metavar="FILE", help="A DCF or XDC with parameter values, or a concise DCF, .bin."),
    ],
    bus: DriveBusOption,
    node: DriveNodeOption,
    eds: OptionalSheetOption = None,
    out: OutOption = None,
    store: StoreOption = False,
    bitrate: BitrateOption = 1_000_000,
    as_json: JsonOption = False,
) -> None:
    """Write the parameters of a file into a drive that is disabled and stands; read each back.

    The same command goes on after an end of any kind; hil restore DIR/journal.jsonl undoes it.
    Exit status: 0 all held, 1 the drive refused some, 2 bad input, 3 no answer, another device, or a drive
    that is enabled or moves.

    Examples:
      hil params load drive.dcf --bus hub:lab --node 1
      hil params load drive.bin --bus hub:lab --node 1 --eds drive.eds
    """
    from servobench.hil.inspecting.loading import LoadRequest
    from servobench.hil.inspecting.parameters import for_node, parameters_of

    read = parameters_of(file, node, eds)
    parameters, left = for_node(read, node)
    folder = out or Path(f"{file.stem}-node{node}")
    request = LoadRequest(bus, bitrate, node, folder, store)
    _load(request, lambda _network: (parameters, {**left, **read.unread}), as_json)


def clone(
    bus: DriveBusOption,
    node: DriveNodeOption,
    to: Annotated[int, valued("--to", "N", "Node id of the drive to load.", min=1, max=127)],
    eds: SheetOption,
    out: OutOption = None,
    store: StoreOption = False,
    bitrate: BitrateOption = 1_000_000,
    as_json: JsonOption = False,
) -> None:
    """Read every parameter of a drive and write them into another one of its type, as hil params load does.

    Identifiers follow the node-ID; node-ID, bit rate and serial number stay. Exit status: as of hil params
    load.

    Examples:
      hil params clone --bus hub:lab --node 1 --to 2 --eds drive.eds
    """
    from servobench.drivers.canopen.nmt_states import NODE_ID_MAX
    from servobench.hil.inspecting.loading import LoadRequest
    from servobench.hil.inspecting.parameters import for_node, read_parameters

    if to == node:
        raise BadInput("--to", "", to, f"another node id 1..{NODE_ID_MAX} than --node")

    def parameters(network: "JournaledNetwork") -> "tuple[ParameterSet, dict[Place, str]]":
        read, _, _ = read_parameters(network, node, eds, bus, _note)
        moved, left = for_node(read, to)
        return moved, {**left, **read.unread}

    folder = out or Path(f"node{node}-node{to}")
    _load(LoadRequest(bus, bitrate, to, folder, store), parameters, as_json)


def _load(
    request: "LoadRequest",
    parameters: "Callable[[JournaledNetwork], tuple[ParameterSet, dict[Place, str]]]",
    as_json: bool,
) -> None:
    from servobench.drivers.canopen.objects301 import object_name
    from servobench.hil.execution.world import drive_world
    from servobench.hil.inspecting.loading import load_parameters, loading_network
    from servobench.hil.machine.stopping import stop_signals

    with stop_signals() as stop, drive_world(request.bus, request.bitrate_bit_s) as world:
        network = loading_network(world)
        wanted, left = parameters(network)
        loaded = load_parameters(network, wanted, request, _note, stop.check)
    figures = {
        "node": request.node,
        "parameters": loaded.parameters,
        "differed": loaded.differed,
        "refused": {object_name(*place): why for place, why in sorted(loaded.refused.items())},
        "left": {object_name(*place): why for place, why in sorted(left.items())},
        "stored": loaded.stored,
        "journal": str(request.journal) if loaded.differed else None,
    }
    put(figures, as_json, lambda _figures: _print_loaded(request, loaded, wanted, figures))
    raise typer.Exit(ExitStatus.PASSED if loaded.complete else ExitStatus.FAILED)


def _print_loaded(
    request: "LoadRequest", loaded: "Loaded", wanted: "ParameterSet", figures: dict[str, Any]
) -> None:
    from servobench.hil.restoring.journal import restore_command

    count, refused = loaded.parameters, len(loaded.refused)
    typer.echo(
        f"{count - refused} of {count} parameters held by node {request.node}, {loaded.differed} differed"
    )
    for name, why in figures["refused"].items():
        place = int(name[:4], 16), int(name[6:], 16)
        typer.echo(f"  {name} {wanted.names[place]}: {why}")
    for name, why in figures["left"].items():
        typer.echo(f"  {name} left: {why}")
    if loaded.differed:
        typer.echo(f"undo: {restore_command(request.journal)}")
    if loaded.not_stored:
        typer.echo(f"NOT stored: {loaded.not_stored}")
    elif loaded.stored:
        typer.echo("stored (1010h)")


def diff(
    first: Annotated[
        Path,
        typer.Argument(
            metavar="FIRST", help="A DCF or XDC with parameter values; of two drives their sheet."
        ),
    ],
    second: Annotated[
        Path | None,
        typer.Argument(metavar="[SECOND.dcf]", help="Another one; default: the drive of --bus and --node."),
    ] = None,
    bus: Annotated[str | None, bus_option("hub:NAME, socketcan:can0, or INTERFACE:CHANNEL.")] = None,
    node: Annotated[
        int | None, valued("--node", "N", "Node id of the drive to compare.", min=1, max=127)
    ] = None,
    other: Annotated[
        int | None, valued("--other", "N", "Node id of a drive to compare with --node's.", min=1, max=127)
    ] = None,
    eds: OptionalSheetOption = None,
    bitrate: BitrateOption = 1_000_000,
    as_json: JsonOption = False,
) -> None:
    """Compare the parameters of two files, of a file and a drive, or of two drives, in their units too.

    Identifiers that follow the node-ID, and node-ID, bit rate and serial number, are no difference of two
    nodes. Nothing is written to the drive. Exit status: 0 equal, 1 they differ, 2 bad input, 3 no answer
    or another device.

    Examples:
      hil params diff drive.dcf --bus hub:lab --node 1
      hil params diff drive.dcf drive.bin --eds drive.eds
      hil params diff drive.eds --bus hub:lab --node 1 --other 2
    """
    from servobench.hil.inspecting.parameters import differences, parameters_of

    if (second is None) != (bus is not None and node is not None) or (bus is None) != (node is None):
        given = {"SECOND.dcf": second, "--bus": bus, "--node": node}
        found = ", ".join(name for name, value in given.items() if value is not None) or "FIRST.dcf alone"
        raise BadInput("SECOND.dcf", "", found, "a second file, or --bus and --node of a drive")
    if other is not None and (second is not None or other == node):
        raise BadInput("--other", "", other, "another drive than --node's, beside --bus and --node")
    drives = [] if second is not None else _of_drives(eds or first, str(bus), node or 0, other, bitrate)
    mine = drives[0] if len(drives) > 1 else parameters_of(first, node, eds)
    theirs = parameters_of(second, None, eds) if second is not None else drives[-1]
    found_differences = differences(mine, theirs)
    figures = {
        "first": mine.source,
        "second": theirs.source,
        "parameters": len(mine.values.keys() | theirs.values.keys()),
        "differences": [_figures(each) for each in found_differences],
    }
    put(figures, as_json, lambda _figures: _print_differences(mine, theirs, found_differences))
    raise typer.Exit(ExitStatus.FAILED if found_differences else ExitStatus.PASSED)


def _of_drives(sheet: Path, bus: str, node: int, other: int | None, bitrate: int) -> "list[ParameterSet]":
    from servobench.drivers.canopen.write_list import NOTHING
    from servobench.hil.execution.world import drive_network
    from servobench.hil.inspecting.parameters import compared_drive

    nodes = [node] if other is None else [node, other]
    with drive_network(bus, bitrate, NOTHING) as network:
        return [compared_drive(network, each, sheet, bus, _note) for each in nodes]


def _indices(text: str) -> range:
    """Parse ``6060-60FF``. Raises BadInput."""
    with suppress(ValueError):
        first, last = (int(part, 16) for part in text.split("-"))
        if 0x1000 <= first <= last <= 0xFFFF:
            return range(first, last + 1)
    raise BadInput("--range", "", text, "two hexadecimal indices 1000-FFFF, as 2000-2FFF")


def _note(text: str) -> None:
    say(f"hil: note: {text}")


def _figures(each: "ParameterDifference") -> dict[str, Any]:
    from servobench.drivers.canopen.objects301 import object_name

    values = {name: getattr(each, name) or None for name in ("first", "second", "first_si", "second_si")}
    return {"object": object_name(*each.place), "name": each.name, **values}


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
        pairs = ((each.first, each.first_si), (each.second, each.second_si))
        values = (f"{raw or 'none'}{f' ({si})' if si else ''}" for raw, si in pairs)
        typer.echo(f"  {object_name(*each.place):<11}{name:<{_NAME_MAX + 2}}{'  '.join(values)}")
