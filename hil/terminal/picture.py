"""``hil picture``: a page of a recorded run as a PNG, or a figure for a paper."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from servobench.drivers.errors import BadInput
from servobench.hil.terminal.options import RunArgument, SpanOption, UnsealedOption, flag, valued
from servobench.hil.terminal.output import note_seal, say_written


def picture(
    run: RunArgument,
    out: Annotated[
        Path, typer.Argument(metavar="OUT", help="The picture: .png; with --paper also .svg or .pdf.")
    ],
    page: Annotated[
        str | None, valued("--page", "PAGE", "Page: overview, AXIS, timing, controller, zoom, zoom/AXIS.")
    ] = None,
    at: Annotated[
        float | None, valued("--at", "S", "Cursor, s since the first cycle; default: the end.")
    ] = None,
    span: SpanOption = None,
    paper: Annotated[
        bool, flag("--paper", "Draw speed, error, torque and delay by matplotlib, without a viewer.")
    ] = False,
    unsealed: UnsealedOption = False,
) -> None:
    """Draw a recorded run: the page that a user sees first, without a window; or a figure for a paper.

    Exit status: 0 drawn, 2 bad input, 3 the viewer cannot run here.

    Examples:
      hil picture runs/monday monday.png
      hil picture runs/monday monday.svg --paper
    """
    if span is not None and at is None:
        raise BadInput("--span", "", f"{span:g}", "--at beside it: about which instant")
    if out.is_dir() or not out.parent.is_dir():
        raise BadInput("OUT", "", str(out), "a file in an existing folder")
    window = (None, None) if at is None or span is None else (at - span / 2, at + span / 2)
    if paper:
        if page is not None:
            raise BadInput("--page", "", page, "no --paper beside it")
        from servobench.hil.recorded.paper import paper_figure, save_figure
        from servobench.hil.recorded.recorded_run import open_run, signals_of

        opened = open_run(run, unsealed=unsealed)
        note_seal(run, opened.seal)
        figure = paper_figure(signals_of(opened, *window))
        save_figure(figure, out)
    else:
        if out.suffix != ".png":
            raise BadInput("OUT", "", str(out), "a file that ends in .png, or --paper")
        from servobench.drivers.written_file import write_file
        from servobench.hil.recorded.viewer import draw_page

        tell_seal = partial(note_seal, run)
        write_file("OUT", out, draw_page(run, page, at, window, unsealed=unsealed, tell_seal=tell_seal))
    say_written(out)
