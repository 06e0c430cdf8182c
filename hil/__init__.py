"""Benches run from Python (``docs/python.md``), and what a controller of one's own is written with: version 1
of the protocol (``docs/control.md``).

Everything else in here belongs to the bench and may change. The names are found when they are asked for:
before that no other package is imported, which a folder of the user's could hide.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from drivers.exchange import Command, Reading
    from hil.configuration.bench_tables import Bench
    from hil.control.setup import Setup
    from hil.loop.axis_roles import PROTOCOL_VERSION, Compensator, Controller
    from hil.loop.context import Context, PositionSetPoint, SetPoint, SpeedSetPoint, TorqueSetPoint
    from hil.loop.samples import Sample, StateEstimate
    from hil.testing.one_run import run
    from hil.testing.run import Run

_HOMES = {
    "drivers.exchange": ("Command", "Reading"),
    "hil.configuration.bench_tables": ("Bench",),
    "hil.control.setup": ("Setup",),
    "hil.loop.axis_roles": ("PROTOCOL_VERSION", "Compensator", "Controller"),
    "hil.loop.context": ("Context", "PositionSetPoint", "SetPoint", "SpeedSetPoint", "TorqueSetPoint"),
    "hil.loop.samples": ("Sample", "StateEstimate"),
    "hil.testing.one_run": ("run",),
    "hil.testing.run": ("Run",),
}

__all__ = [
    "PROTOCOL_VERSION",
    "Bench",
    "Command",
    "Compensator",
    "Context",
    "Controller",
    "PositionSetPoint",
    "Reading",
    "Run",
    "Sample",
    "SetPoint",
    "Setup",
    "SpeedSetPoint",
    "StateEstimate",
    "TorqueSetPoint",
    "run",
]


def __getattr__(name: str) -> Any:
    for home, names in _HOMES.items():
        if name in names:
            if (trouble := import_module("hil.terminal.hidden_rooms").hidden_room()) is not None:
                raise ImportError(trouble)
            return getattr(import_module(home), name)
    raise AttributeError(f"module 'hil' has no attribute {name!r}")
