"""``hil io``: a drive's digital inputs and outputs."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from servobench.drivers.errors import BadInput
from servobench.hil.terminal.options import (
    BitrateOption,
    DriveBusOption,
    DriveNodeOption,
    JsonOption,
    flag,
    valued,
)
from servobench.hil.terminal.output import put, say
from servobench.hil.verdict.verdict import ExitStatus


def io(
    bus: DriveBusOption,
    node: DriveNodeOption,
    set_: Annotated[
        list[str] | None,
        valued("--set", "BIT=LEVEL", "Set an output of 60FEh, 1 to 31, to 0 or 1; repeatable."),
    ] = None,
    out: Annotated[
        Path | None, valued("--out", "DIR", "Folder of the journal of --set; default: by the node.")
    ] = None,
    test_switches: Annotated[
        bool, flag("--test-switches", "Have each limit and home switch actuated by hand, and judge it.")
    ] = False,
    switch: Annotated[
        list[str] | None,
        valued("--switch", "NAME", "Test negative, positive or home alone; repeatable."),
    ] = None,
    seconds: Annotated[
        float, valued("--seconds", "S", "Time for each switch.", min=0.1, max=3600)
    ] = 30.0,
    bitrate: BitrateOption = 1_000_000,
    as_json: JsonOption = False,
) -> None:  # fmt: skip
    """Show a drive's digital inputs and outputs (60FDh, 60FEh), set outputs, or test its switches.

    Outputs are set in a drive that is disabled and stands, and stay so; hil restore DIR/journal.jsonl gives
    them back. The brake's is left to hil brake. The test says for each switch whether its own input follows,
    and which way. Exit status: 0 done, 1 a switch is not right, 2 bad input, 3 no answer, or a drive that
    refuses, is enabled or moves.

    Examples:
      hil io --bus hub:lab --node 1
    """
    from servobench.drivers.canopen.objects import RemoteObjects
    from servobench.hil.execution.world import drive_world
    from servobench.hil.inspecting.digital_io import (
        BITS,
        SWITCHES,
        OutputRequest,
        read_panel,
        set_outputs,
        try_switches,
    )
    from servobench.hil.machine.stopping import stop_signals
    from servobench.hil.restoring.journal import JournaledNetwork, restore_command
    from servobench.hil.write_lists import IO

    levels = _levels(set_ or (), BITS)
    names = switch or list(SWITCHES)
    for name in names:
        if name not in SWITCHES:
            raise BadInput("--switch", "", name, f"one of {', '.join(SWITCHES)}")
    if levels and (test_switches or switch):
        raise BadInput("--set", "", ", ".join(set_ or ()), "no test of switches beside it")
    request = OutputRequest(bus, bitrate, node, out or Path(f"io-node{node}"), levels)
    tried = []
    with stop_signals() as stop, drive_world(bus, bitrate) as world:
        network = JournaledNetwork(world.link, world.clock, IO)
        objects = RemoteObjects(network, node)
        if test_switches or switch:
            tried = try_switches(objects, names, seconds, say, stop.check)
        panel = set_outputs(network, request) if levels else read_panel(objects)
    undo = restore_command(request.journal) if levels else None
    figures = {**panel._asdict(), "switches": [each._asdict() for each in tried], "undo": undo}
    lines = [*panel.lines(), *([f"undo: {undo}"] if undo else [])]
    put(figures, as_json, lambda _figures: typer.echo("\n".join(lines)))
    raise typer.Exit(ExitStatus.PASSED if all(each.right for each in tried) else ExitStatus.FAILED)


def _levels(texts: Sequence[str], bits: range) -> dict[int, bool]:
    """Parse ``--set``. Raises BadInput."""
    levels = {}
    for text in texts:
        match = re.fullmatch(r"(\d{1,2})=([01])", text)
        if match is None or int(match[1]) not in bits:
            raise BadInput("--set", "", text, f"BIT=LEVEL with a bit {bits[0]}..{bits[-1]} and 0 or 1")
        levels[int(match[1])] = match[2] == "1"
    return levels
