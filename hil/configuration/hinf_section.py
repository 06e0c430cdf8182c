"""``kind = "hinf"``: an H-infinity controller on the speed error, with its matrices in a file."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import NS_PER_US
from servobench.hil.configuration.controller_section import AxisController
from servobench.hil.configuration.quantities import Gain, Inertia, ViscousFriction
from servobench.hil.configuration.speed_controller_file import LoopFigures, LossCertificate, MadeFor, Rows
from servobench.hil.control.hinf import HinfFeedback
from servobench.hil.control.setup import Setup
from servobench.hil.loop.axis_roles import Controller

_ORDER_MAX = 64
"""States, or entries of a row; a design for a delay of 1.1 ms at 1 kHz has four."""
Vector = Annotated[tuple[Gain, ...], Field(strict=False, min_length=1, max_length=_ORDER_MAX)]


class HinfSection(AxisController):
    """x+ = A x + B e + L (u_sent - feed-forward), u = C x + D e + feed-forward; e is the speed error."""

    kind: Literal["hinf"]
    period_us: int = Field(gt=0, description="of the loop for which the matrices hold, us")
    A: Rows
    B: Vector = Field(description="of the speed error in rad/s")
    L: Vector = Field(description="of the torque that was sent, N m")
    C: Vector = Field(description="N m")
    D: Gain = Field(description="N m per rad/s")
    inertia_kg_m2: Inertia = Field(description="of all that turns, kg m^2; for the feed-forward")
    viscous_friction_nm_s: ViscousFriction = 0.0
    answer_us: float = Field(ge=0, le=1e6, description="from a reading to the speed's answer, us")
    made_for: MadeFor | None = None
    """The network and the drive that it was designed for; ``hil run`` refuses others."""
    certificate: LossCertificate | None = None
    figures: LoopFigures | None = None

    @model_validator(mode="after")
    def _shapes(self) -> "HinfSection":
        n = len(self.C)
        if not (len(self.A) == len(self.B) == len(self.L) == n and all(len(row) == n for row in self.A)):
            raise ValueError(f"A of {n} rows and columns, B and L of {n} entries, as C has, are expected")
        return self

    def build(self, setup: Setup) -> Controller:
        """Build the controller of an axis. Raises BadInput for another period than its own."""
        if self.period_us * NS_PER_US != setup.period:
            key = f"drive.{setup.axis}.controller.period_us"
            expected = f"loop.period_us = {setup.period / NS_PER_US:g}"
            raise BadInput(setup.source, key, self.period_us, expected)
        return HinfFeedback(
            self.A,
            self.B,
            self.L,
            self.C,
            self.D,
            self.inertia_kg_m2,
            self.viscous_friction_nm_s,
            self.answer_us / self.period_us,
        )
