"""What a controller of one's own is written with: version 1 of the protocol, see ``docs/control.md``.

Everything else in here belongs to the bench and may change.
"""

from drivers.exchange import Command, Reading
from hil.loop.axis_roles import PROTOCOL_VERSION, Compensator, Controller
from hil.loop.context import Context, PositionSetPoint, SetPoint, SpeedSetPoint, TorqueSetPoint
from hil.loop.samples import Sample, StateEstimate

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
    "SpeedSetPoint",
    "StateEstimate",
    "TorqueSetPoint",
]
