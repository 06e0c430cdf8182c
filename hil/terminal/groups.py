"""Groups of commands: ``hil reproduce``, ``hil analyse``, ``hil design``."""

import typer

from hil.terminal import analyse_speed, design_speed
from hil.terminal.design_current import current
from hil.terminal.design_hinf import hinf
from hil.terminal.design_pid import pid
from hil.terminal.reproduce import azaiz2007, ling2012

reproduce = typer.Typer(name="reproduce", help="The papers' own results beside ours.", no_args_is_help=True)
reproduce.command()(azaiz2007)
reproduce.command()(ling2012)

design = typer.Typer(name="design", help="Design a controller.", no_args_is_help=True)
design.command()(current)
design.command()(hinf)
design.command()(pid)
design.command()(design_speed.speed)

analyse = typer.Typer(name="analyse", help="Exact and certified figures of a loop.", no_args_is_help=True)
analyse.command()(analyse_speed.speed)
