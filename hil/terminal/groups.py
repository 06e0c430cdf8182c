"""Groups of commands: ``hil reproduce``, ``hil design``."""

import typer

from hil.terminal.design_current import current
from hil.terminal.reproduce_azaiz2007 import azaiz2007

reproduce = typer.Typer(name="reproduce", help="The papers' own results beside ours.", no_args_is_help=True)
reproduce.command()(azaiz2007)

design = typer.Typer(name="design", help="Design a controller.", no_args_is_help=True)
design.command()(current)
