"""The steps of commissioning, in order."""

from hil.commissioning.sequence import Step
from hil.commissioning.steps_current import TorqueConstant
from hil.commissioning.steps_design import Suggest, Verify
from hil.commissioning.steps_dynamics import Delays, Response
from hil.commissioning.steps_mechanics import MechanicsStep
from hil.commissioning.steps_setup import EnableAtZero, SetUp, Watchdog
from hil.commissioning.steps_static import BusCheck, DumpStep, IdentityCheck, UnitsTold
from hil.commissioning.steps_stopping import StopProof, StopSettings
from hil.commissioning.steps_units import MotionUnits, Polarity, Turn
from hil.commissioning.steps_voltage import VoltageConstant


def all_steps() -> list[Step]:
    """New steps, for one commissioning."""
    return [
        BusCheck(),
        IdentityCheck(),
        DumpStep(),
        UnitsTold(),
        SetUp(),
        StopSettings(),
        Watchdog(),
        EnableAtZero(),
        Polarity(),
        MotionUnits(),
        Turn(),
        StopProof(),
        MechanicsStep(),
        TorqueConstant(),
        VoltageConstant(),
        Response(),
        Delays(),
        Suggest(),
        Verify(),
    ]
