"""``hil view``: the viewer on a recorded run."""

import typer

from drivers.errors import BadInput
from hil.terminal.exit_status import reported_errors
from hil.terminal.options import RunArgument
from hil.terminal.output import say


def view(run: RunArgument) -> None:
    """Open a recorded run in the Rerun viewer; without a display, say where the file is and how to see it.

    Exit status: 0 opened, or told; 2 bad input.
    """
    with reported_errors():
        from hil.recording.log_files import start_viewer
        from hil.recording.telemetry import RERUN_FILE

        recording = run / RERUN_FILE if run.is_dir() else run
        if not recording.is_file():
            raise BadInput("RUN", "", str(run), f"the folder of a run, with its {RERUN_FILE}")
        if missing_display():
            from hil.terminal.report import viewer_command

            say(f"hil: no display here; on a machine with one: {viewer_command()} {recording}")
            say(f"hil: as a picture: hil picture {run} page.png")
            typer.echo(str(recording.resolve()))
            return
        start_viewer(str(recording.resolve()))


def missing_display() -> bool:
    """No window can be opened here."""
    from hil.machine.capability import CapabilityStatus, Machine
    from hil.machine.doctor_machine import display

    return display(Machine()).status is not CapabilityStatus.OK
