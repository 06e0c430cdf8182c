"""``hil view``: the viewer on a recorded run or commissioning."""

from functools import partial

import typer

from servobench.hil.terminal.options import RunArgument, UnsealedOption
from servobench.hil.terminal.output import note_seal, say


def view(run: RunArgument, unsealed: UnsealedOption = False) -> None:
    """Open a recorded run or commissioning in the Rerun viewer; without a display, say where the file is and
    how to see it.

    Exit status: 0 opened, or told; 2 bad input.
    """
    from servobench.hil.recorded.viewer import page_file
    from servobench.hil.recording.page_keepers import start_viewer

    recording = page_file(run, unsealed=unsealed, tell_seal=partial(note_seal, run))
    if missing_display():
        from servobench.hil.terminal.report import viewer_command

        say(f"hil: no display here; on a machine with one: {viewer_command()} {recording}")
        say(f"hil: as a picture: hil picture {run} page.png")
        typer.echo(str(recording.resolve()))
        return
    start_viewer(str(recording.resolve()))


def missing_display() -> bool:
    """No window can be opened here."""
    from servobench.hil.machine.doctor import Machine, display

    return bool(display(Machine()).remedy)
