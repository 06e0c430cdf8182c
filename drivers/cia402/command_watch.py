"""How far what a drive reports may lie from its commands, for CommandWatch (core/command_watch.c)."""

from typing import Final

DEMAND_MARGIN_RAW: Final = 2
"""Rounding of 6074h to and fro in a drive that computes in currents, per thousand of the rated torque."""
ACTUAL_MARGIN_RAW: Final = 100
"""6077h is measured: ripple, friction of the current loop and its lag come in."""
ACTUAL_SHARE: Final = 4
"""Plus a quarter of the command: the torque constant depends on temperature, and is known to some ten
percent."""
