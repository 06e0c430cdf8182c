"""``hil view``: opens the viewer on a recorded run or commissioning."""

from functools import partial
from typing import Annotated

import typer

from servobench.drivers.errors import BadInput
from servobench.hil.terminal.options import RunArgument, SpanOption, UnsealedOption, valued
from servobench.hil.terminal.output import note_seal, say


def view(
    run: RunArgument,
    at: Annotated[float | None, valued("--at", "S", "Where the cursor is, s since the first cycle.")] = None,
    span: SpanOption = None,
    unsealed: UnsealedOption = False,
) -> None:
    """Open a recorded run or commissioning in the Rerun viewer; without a display, say how to see it.

    Exit status: 0 opened, or explained; 2 bad input; 3 the viewer does not open at --at.

    Examples:
      hil view runs/monday   # a window
    """
    if span is not None and at is None:
        raise BadInput("--span", "", f"{span:g}", "--at beside it: about which instant")
    from servobench.hil.recorded.viewer import page_file
    from servobench.hil.recording.page_keepers import start_viewer

    recording = page_file(run, unsealed=unsealed, tell_seal=partial(note_seal, run))
    if missing_display():
        from servobench.hil.terminal.report import viewer_command

        say(f"hil: no display here; on a machine with one: {viewer_command()} {recording}")
        there = "" if at is None else f" --at {at:g}" + ("" if span is None else f" --span {span:g}")
        say(f"hil: as a picture: hil picture {run} page.png{there}")
        typer.echo(str(recording.resolve()))
        return
    if at is None:
        start_viewer(str(recording.resolve()))
    else:
        from servobench.hil.recorded.viewer import open_at

        open_at(recording, at, span)


def missing_display() -> bool:
    """Return True if no window can be opened here."""
    from servobench.hil.machine.doctor import Machine, display

    return bool(display(Machine()).remedy)
