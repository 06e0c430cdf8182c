"""Kinds of controllers and compensators: their tables in a bench file, and their construction.

A new kind is its class in ``hil/control``, its section here, and its place in the union at the end.
"""

import math
from typing import Annotated, Any, ClassVar, Literal, get_args

from pydantic import Field, model_validator

from servobench.design.speed.position_loop import design_position
from servobench.drivers.timebase import NS_PER_S, NS_PER_US, Duration
from servobench.hil.configuration.config_files import Section
from servobench.hil.configuration.controller_files import (
    Certificate,
    LoopFigures,
    LossCertificate,
    MadeFor,
    Rows,
)
from servobench.hil.configuration.controller_section import ORDER_MAX, AxisController, check_period
from servobench.hil.configuration.drive_file import LoopOfDrive
from servobench.hil.configuration.predicting_controllers import FusedController, PredictorController
from servobench.hil.configuration.quantities import (
    Gain,
    Inertia,
    PositiveGain,
    SignedTorque,
    TimeConstant,
    ViscousFriction,
)
from servobench.hil.control.compensation import Arrival, Stamp
from servobench.hil.control.controllers import (
    HinfFeedback,
    Pid,
    PidGains,
    PositionLoop,
    SetPointStream,
    StateFeedback,
)
from servobench.hil.control.own_code import OBJECT_PATTERN, guarded_compensator, guarded_controller
from servobench.hil.control.setup import Setup
from servobench.hil.loop.protocol import Compensator, Controller
from servobench.hil.loop.scenario import Quantity

Vector = Annotated[tuple[Gain, ...], Field(strict=False, min_length=1, max_length=ORDER_MAX)]


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
        check_period(self.period_us, setup)
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


class ArrivalCompensator(Section):
    """Uses the newest reading as soon as it arrives."""

    kind: Literal["arrival"]

    def build(self, setup: Setup) -> Compensator:  # noqa: ARG002
        """Build the compensator of an axis."""
        return Arrival()


class StampCompensator(Section):
    """Uses a reading when it is exactly ``delay_us`` old, [Ling2012] 2.3.

    Drives sample at SYNCs; with ``loop.actuation = "on_sync"``, without which this is refused, they act at
    SYNCs too. So ``delay_us`` is a whole number of periods.
    """

    kind: Literal["stamp"]
    delay_us: int = Field(gt=0, description="the age at which a reading acts, us")

    def build(self, setup: Setup) -> Compensator:
        """Build the compensator of an axis."""
        return Stamp(Duration(self.delay_us * NS_PER_US), setup.period)


class TunedFor(Section):
    """``made_for`` of a PID: the data of its tuning rule."""

    crossover_rad_s: float = Field(gt=0, description="where the speed loop crosses over, rad/s")
    current_loop: LoopOfDrive = Field(description="the table [controller.made_for.current_loop]")


class PidController(AxisController):
    """u = Kp e + Ki int(e) - Kd s/(1 + s Tf) omega + Bff omega*, torque out of speed error."""

    kind: Literal["pid"]
    proportional_nm_s_rad: PositiveGain = Field(description="Kp, N m per rad/s")
    integral_nm_rad: PositiveGain = 0.0
    derivative_nm_s2_rad: PositiveGain = 0.0
    derivative_filter_s: TimeConstant = 0.002
    anti_windup_s: TimeConstant | None = None
    """Time constant of back-calculation; Kp/Ki if absent."""
    feedforward_nm_s_rad: Gain = 0.0
    """Torque per reference speed, usually the viscous friction."""
    made_for: TunedFor | None = None
    """Absent: unknown; ``hil run`` then judges by the gains alone."""

    def build(self, setup: Setup) -> Controller:
        """Build the controller of an axis."""
        gains = PidGains(**self.model_dump(exclude={"kind", "made_for"}))
        return Pid(gains, setup.period_s)


Gains = Annotated[tuple[Gain, ...], Field(strict=False, min_length=2, max_length=3)]


class StateFeedbackController(AxisController):
    """u = K x with x = [i_q* - i_q, omega* - omega] and u = i_q* - i_qr, [Ling2012] (2.4) and (2.14).

    A third gain acts on the integral of the speed error.
    """

    kind: Literal["state_feedback"]
    gain: Gains = Field(description="K: [K1 in A/A, K2 in A s/rad], and K3 in A/rad if it is to integrate")
    feedforward_load_nm: SignedTorque = 0.0
    """Load torque carried by the nominal current in addition to the friction."""
    made_for: MadeFor | None = None
    """The network and the drive that it was designed for; ``hil run`` refuses others."""
    certificate: Certificate | None = None

    def build(self, setup: Setup) -> Controller:
        """Build the controller of an axis."""
        motor = setup.motor
        return StateFeedback(
            self.gain,
            motor.torque_constant_nm_a,
            motor.viscous_friction_nm_s,
            self.feedforward_load_nm,
            setup.period_s,
        )


class SpeedLoopOfDrive(Section):
    """``made_for`` of a position loop: the speed loop inside it."""

    delay_us: int = Field(ge=0, description="from sample to actuator, us; hil measure tells it")
    speed_bandwidth_hz: float = Field(gt=0, le=5e3, description="of the drive's closed speed loop, Hz")

    def gain_per_s(self, period: Duration) -> float:
        """Return K of the position loop, 1/s."""
        bandwidth_rad_s = math.tau * self.speed_bandwidth_hz
        return design_position(period / NS_PER_S, self.delay_us / 1e6, bandwidth_rad_s)


class PositionController(AxisController):
    """omega_set = K (theta* - theta) + F omega*, speed set-points out of the position error; for csv."""

    kind: Literal["position"]
    gain_per_s: float | None = Field(default=None, gt=0, le=1e5, description="K, 1/s")
    """Default: designed for ``made_for`` (:mod:`servobench.design.speed.position_loop`)."""
    feedforward: float = Field(default=1.0, ge=0, le=2)
    """F: share of the reference's own speed."""
    made_for: SpeedLoopOfDrive = Field(description="a table with delay_us and speed_bandwidth_hz")
    gives: ClassVar = (Quantity.SPEED,)

    def follows(self, given: Quantity) -> tuple[Quantity, ...]:  # noqa: ARG002
        return (Quantity.POSITION,)

    def build(self, setup: Setup) -> Controller:
        """Build the controller of an axis."""
        gain_per_s = self.gain_per_s
        if gain_per_s is None:
            gain_per_s = self.made_for.gain_per_s(setup.period)
        # A held set-point stands for its middle; a first-order loop comes after by its time constant.
        lag_s = 1.0 / (math.tau * self.made_for.speed_bandwidth_hz)
        lead = Duration(setup.period // 2 + round(lag_s * NS_PER_S))
        return PositionLoop(gain_per_s, self.feedforward, lead)


class StreamController(AxisController):
    """Passes the reference on as set-points: positions in csp, speeds in csv, torques in cst."""

    kind: Literal["stream"]
    gives: ClassVar = tuple(Quantity)

    def follows(self, given: Quantity) -> tuple[Quantity, ...]:
        return (given,)

    def build(self, setup: Setup) -> Controller:
        """Build the controller of an axis."""
        return SetPointStream(setup.given, setup.period)


class OwnCode(Section):
    """A user class: ``object`` names it, ``parameters`` go to its constructor."""

    kind: Literal["python"]
    object: str = Field(
        pattern=OBJECT_PATTERN,
        description="a class, as MODULE:NAME, or FILE.py:NAME from the bench file's folder",
    )
    parameters: dict[str, Any] = Field(default_factory=dict)


class OwnCompensator(OwnCode):
    """A user's compensator."""

    def build(self, setup: Setup) -> Compensator:
        """Build the compensator of an axis; runs the code. Raises BadInput if it is none."""
        return guarded_compensator(self.object, self.parameters, setup)


class OwnController(OwnCode, AxisController):
    """A user's controller."""

    gives: ClassVar = tuple(Quantity)

    def follows(self, given: Quantity) -> tuple[Quantity, ...]:  # noqa: ARG002
        return (Quantity.SPEED, Quantity.POSITION, Quantity.TORQUE)

    def build(self, setup: Setup) -> Controller:
        """Build the controller of an axis; runs the code. Raises BadInput if it is none."""
        return guarded_controller(self.object, self.parameters, setup)


CompensatorSection = Annotated[
    ArrivalCompensator | StampCompensator | OwnCompensator, Field(discriminator="kind")
]
AnyController = (
    PidController
    | StateFeedbackController
    | PredictorController
    | FusedController
    | HinfSection
    | PositionController
    | StreamController
    | OwnController
)
ControllerSection = Annotated[AnyController, Field(discriminator="kind")]


def controllers_giving(given: Quantity) -> list[str]:
    """Return the kinds of controllers whose set-points are ``given``."""
    sections: tuple[type[AxisController], ...] = get_args(AnyController)
    return [
        get_args(section.model_fields["kind"].annotation)[0] for section in sections if given in section.gives
    ]


class ControllerFile(Section):
    """A controller in a separate file."""

    controller: ControllerSection = Field(description="the table [controller] with its kind")
