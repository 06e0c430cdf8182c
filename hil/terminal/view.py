"""``hil view``: opens the viewer on a recorded run or commissioning."""

from functools import partial
from typing import TYPE_CHECKING, Annotated

import typer

from servobench.drivers.errors import BadInput
from servobench.hil.terminal.options import RunArgument, SpanOption, UnsealedOption, flag, valued
from servobench.hil.terminal.output import note_seal, say

if TYPE_CHECKING:
    from servobench.hil.rows.recording_plan import ServedPorts


def view(
    run: RunArgument,
    at: Annotated[float | None, valued("--at", "S", "Where the cursor is, s since the first cycle.")] = None,
    span: SpanOption = None,
    served: Annotated[
        bool, flag("--serve", "Serve it to browsers and viewers of this machine, until Ctrl-C.")
    ] = False,
    unsealed: UnsealedOption = False,
) -> None:
    """Open a recorded run or commissioning in the Rerun viewer; without a display, say how to see it.

    Exit status: 0 opened, explained, or served until it was ended; 2 bad input; 3 the viewer does not open at
    --at, or serves nothing.

    Examples:
      hil view runs/monday   # a window
      hil view runs/monday --serve   # a browser
    """
    if span is not None and at is None:
        raise BadInput("--span", "", f"{span:g}", "--at beside it: about which instant")
    if served and at is not None:
        raise BadInput("--serve", "", f"--at {at:g}", "neither --at nor --span beside it")
    from servobench.hil.recorded.viewer import page_file
    from servobench.hil.recording.page_keepers import start_viewer

    recording = page_file(run, unsealed=unsealed, tell_seal=partial(note_seal, run))
    if served:
        from servobench.hil.machine.stopping import stop_signals
        from servobench.hil.recorded.viewer import serve

        def tell(ports: "ServedPorts") -> None:
            say_served(ports)
            say("hil: Ctrl-C ends it")

        with stop_signals() as stop:
            serve(recording, tell, stop)
        return
    if missing_display():
        from servobench.hil.terminal.report import viewer_command

        say(f"hil: no display here; on a machine with one: {viewer_command()} {recording}")
        there = "" if at is None else f" --at {at:g}" + ("" if span is None else f" --span {span:g}")
        say(f"hil: in a browser, over ssh too: hil view {run} --serve")
        say(f"hil: as a picture: hil picture {run} page.png{there}")
        typer.echo(str(recording.resolve()))
        return
    if at is None:
        start_viewer(str(recording.resolve()))
    else:
        from servobench.hil.recorded.viewer import open_at

        open_at(recording, at, span)


def say_served(ports: "ServedPorts") -> None:
    """Tell where a recording, or a run that goes on, is served."""
    from servobench.hil.rows.recording_plan import LOOPBACK
    from servobench.hil.terminal.report import viewer_command

    tunnel = " ".join(f"-L {port}:{LOOPBACK}:{port}" for port in ports)
    say(f"hil: served to browsers at {ports.page_url}")
    say(f"hil: and to viewers: {viewer_command()} --connect {ports.stream_uri}")
    say(f"hil: from another machine, first: ssh {tunnel} HOST")


def missing_display() -> bool:
    """Return True if no window can be opened here."""
    from servobench.hil.machine.doctor import Machine, display

    return bool(display(Machine()).remedy)
