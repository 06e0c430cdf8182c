"""The steps of commissioning, in order."""

from servobench.hil.commissioning.sequence import Step
from servobench.hil.commissioning.steps_current import TorqueConstant
from servobench.hil.commissioning.steps_design import Suggest, Verify
from servobench.hil.commissioning.steps_dynamics import Delays, Response
from servobench.hil.commissioning.steps_mechanics import MechanicsStep
from servobench.hil.commissioning.steps_setup import EnableAtZero, SetUp, Watchdog
from servobench.hil.commissioning.steps_static import BusCheck, DumpStep, IdentityCheck, UnitsTold
from servobench.hil.commissioning.steps_stopping import StopProof, StopSettings
from servobench.hil.commissioning.steps_units import MotionUnits, Polarity, Turn
from servobench.hil.commissioning.steps_voltage import VoltageConstant


def all_steps() -> list[Step]:
    """Return new steps, for one commissioning."""
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
