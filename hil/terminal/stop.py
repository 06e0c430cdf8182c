"""``hil stop``: brings the drives of a bus to rest, from any shell."""

from typing import Annotated

import typer

from servobench.hil.terminal.options import BitrateOption, DriveBusOption, JsonOption, valued
from servobench.hil.terminal.output import put
from servobench.hil.verdict.verdict import ExitStatus


def stop(
    bus: DriveBusOption,
    node: Annotated[
        list[str] | None,
        valued("--node", "N", "Node ids: 1, 1,2 or 1-3; repeatable. Default: all drives found."),
    ] = None,
    bitrate: BitrateOption = 1_000_000,
    as_json: JsonOption = False,
) -> None:
    """Bring drives to rest by quick stop and disable them, even if another master is on the bus.

    Exit status: 0 all at rest and disabled, 2 bad input, 3 a drive is not, or does not answer.

    Examples:
      hil stop --bus hub:lab
    """
    from servobench.hil.execution.world import drive_network
    from servobench.hil.inspecting.stopping import stop_drives
    from servobench.hil.terminal.options import drive_ids
    from servobench.hil.write_lists import STOP

    nodes = drive_ids(node) if node else []
    with drive_network(bus, bitrate, STOP) as network:
        stopped = stop_drives(network, nodes)
    at_rest = all(each.at_rest for each in stopped)
    lines = [f"node {each.node}: {each.text} (after {each.took_ms:.0f} ms)" for each in stopped]
    figures = {"at_rest": at_rest, "nodes": [each._asdict() for each in stopped]}
    put(figures, as_json, lambda _figures: typer.echo("\n".join(lines)))
    raise typer.Exit(ExitStatus.PASSED if at_rest else ExitStatus.PEER_FAULT)
