"""``hil fault``: a drive's faults, and their reset on demand."""

from typing import Annotated

import typer

from servobench.hil.terminal.options import BitrateOption, DriveBusOption, DriveNodeOption, JsonOption, flag
from servobench.hil.terminal.output import put
from servobench.hil.verdict.verdict import ExitStatus


def fault(
    bus: DriveBusOption,
    node: DriveNodeOption,
    reset: Annotated[bool, flag("--reset", "Reset the fault; no other command does.")] = False,
    bitrate: BitrateOption = 1_000_000,
    as_json: JsonOption = False,
) -> None:
    """Show a drive's state and its faults in words: 603Fh, 1001h and 1003h.

    Exit status: 0 no fault, 1 in fault, 2 bad input, 3 no answer, or the fault stays in spite of --reset.

    Examples:
      hil fault --bus hub:lab --node 1
    """
    from servobench.hil.execution.world import drive_network
    from servobench.hil.inspecting.drive_fault import look_at_fault
    from servobench.hil.write_lists import FAULT

    with drive_network(bus, bitrate, FAULT) as network:
        diagnosis = look_at_fault(network, node, reset)
    put(diagnosis.as_json(), as_json, lambda _figures: typer.echo("\n".join(diagnosis.lines())))
    raise typer.Exit(ExitStatus.FAILED if diagnosis.in_fault else ExitStatus.PASSED)
