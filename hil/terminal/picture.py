"""``hil picture``: a page of a recorded run as a PNG, or a figure for a paper."""

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from servobench.drivers.errors import BadInput
from servobench.hil.terminal.options import RunArgument, SpanOption, UnsealedOption, flag, valued
from servobench.hil.terminal.output import note_seal, say, say_written


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
    size: Annotated[
        str | None, valued("--size", "WxH", "Of the picture, px, from 800x450; default: 1920x1080.")
    ] = None,
    paper: Annotated[
        bool, flag("--paper", "Draw speed, error, torque and delay by matplotlib, without a viewer.")
    ] = False,
    unsealed: UnsealedOption = False,
) -> None:
    """Draw a recorded run: the page that a user sees first, without a window; or a figure for a paper.

    Exit status: 0 drawn, 2 bad input, 3 the viewer cannot run here.

    Examples:
      hil picture runs/monday monday.png
      hil picture runs/monday slide.png --size 3840x2160
      hil picture runs/monday monday.svg --paper
    """
    if span is not None and at is None:
        raise BadInput("--span", "", f"{span:g}", "--at beside it: about which instant")
    if out.is_dir() or not out.parent.is_dir():
        raise BadInput("OUT", "", str(out), "a file in an existing folder")
    window = (None, None) if at is None or span is None else (at - span / 2, at + span / 2)
    if paper:
        for option, value in (("--page", page), ("--size", size)):
            if value is not None:
                raise BadInput(option, "", value, "no --paper beside it")
        from servobench.hil.recorded.paper import paper_figure, save_figure
        from servobench.hil.recorded.recorded_run import open_run, signals_of
        from servobench.hil.rows.arrow_file import is_whole
        from servobench.hil.rows.run_files import RECORDS_FILE

        opened = open_run(run, unsealed=unsealed)
        note_seal(run, opened.seal)
        if not is_whole(records := opened.folder / RECORDS_FILE):
            say(f"hil: note: {records}: no end of the file; drawn as far as it goes")
        figure = paper_figure(signals_of(opened, *window))
        save_figure(figure, out)
    else:
        if out.suffix != ".png":
            raise BadInput("OUT", "", str(out), "a file that ends in .png, or --paper")
        from servobench.drivers.written_file import write_file
        from servobench.hil.recorded.viewer import draw_page

        tell_seal = partial(note_seal, run)
        pixels = _pixels(size or "1920x1080")
        png = draw_page(run, page, at, window, size=pixels, unsealed=unsealed, tell_seal=tell_seal)
        write_file("OUT", out, png)
    say_written(out)


def _pixels(size: str) -> tuple[int, int]:
    """Raises BadInput."""
    width, _, height = size.partition("x")
    pixels = tuple(int(part) if part.isascii() and part.isdigit() else 0 for part in (width, height))
    if not all(least <= part <= 8192 for part, least in zip(pixels, (800, 450), strict=True)):
        raise BadInput("--size", "", size, "WIDTHxHEIGHT in px, from 800x450 to 8192x8192")
    return pixels[0], pixels[1]
