"""What a controller of one's own is written with: version 1 of the protocol, see ``docs/control.md``.

Everything else in here belongs to the bench and may change. The names are found when they are asked for:
before that no other package is imported, which a folder of the user's could hide.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from drivers.exchange import Command, Reading
    from hil.control.setup import Setup
    from hil.loop.axis_roles import PROTOCOL_VERSION, Compensator, Controller
    from hil.loop.context import Context, PositionSetPoint, SetPoint, SpeedSetPoint, TorqueSetPoint
    from hil.loop.samples import Sample, StateEstimate

_HOMES = {
    "drivers.exchange": ("Command", "Reading"),
    "hil.control.setup": ("Setup",),
    "hil.loop.axis_roles": ("PROTOCOL_VERSION", "Compensator", "Controller"),
    "hil.loop.context": ("Context", "PositionSetPoint", "SetPoint", "SpeedSetPoint", "TorqueSetPoint"),
    "hil.loop.samples": ("Sample", "StateEstimate"),
}

__all__ = [
    "PROTOCOL_VERSION",
    "Command",
    "Compensator",
    "Context",
    "Controller",
    "PositionSetPoint",
    "Reading",
    "Sample",
    "SetPoint",
    "Setup",
    "SpeedSetPoint",
    "StateEstimate",
    "TorqueSetPoint",
]


def __getattr__(name: str) -> Any:
    for home, names in _HOMES.items():
        if name in names:
            return getattr(import_module(home), name)
    raise AttributeError(f"module 'hil' has no attribute {name!r}")
