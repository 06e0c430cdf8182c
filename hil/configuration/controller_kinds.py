"""Kinds of controllers and compensators: their tables in a bench file, and their construction.

A new kind is its class in ``hil/control``, its section here, and its place in the union at the end.
"""

import math
from typing import Annotated, Any, ClassVar, Literal, get_args

from pydantic import Field, model_validator

from servobench.design.speed.position_loop import design_position
from servobench.design.speed.predictor_plant import PredictorPlant
from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import NS_PER_S, NS_PER_US, Duration
from servobench.hil.configuration.config_files import Section
from servobench.hil.configuration.controller_files import (
    Certificate,
    LoopFigures,
    LossCertificate,
    MadeFor,
    Rows,
)
from servobench.hil.configuration.drive_file import LoopOfDrive
from servobench.hil.configuration.quantities import (
    Gain,
    Inertia,
    PositiveGain,
    SignedTorque,
    TimeConstant,
    ViscousFriction,
)
from servobench.hil.control.compensation import Arrival, Stamp
from servobench.hil.control.controllers import Pid, PidGains, StateFeedback
from servobench.hil.control.fused import FusedPredictor
from servobench.hil.control.hinf import HinfFeedback
from servobench.hil.control.load_filter import FilterNoise
from servobench.hil.control.own_code import OBJECT_PATTERN, guarded_compensator, guarded_controller
from servobench.hil.control.positions import PositionLoop, SetPointStream
from servobench.hil.control.predictor import LoadCancelling, Predictor
from servobench.hil.control.setup import Setup
from servobench.hil.loop.axis_roles import Compensator, Controller
from servobench.hil.loop.scenario import Quantity


class AxisController(Section):
    """``[drive.NAME.controller]`` of any kind; by default a speed loop over torques."""

    gives: ClassVar[tuple[Quantity, ...]] = (Quantity.TORQUE,)
    """Set-points that it can give; a drive takes those of its mode."""

    needs_count: ClassVar[bool] = False
    """Position and speed of one SYNC are to travel in one TPDO."""

    def follows(self, given: Quantity) -> Quantity | None:  # noqa: ARG002
        """Return the reference that it takes if the drive is given ``given``; None: any."""
        return Quantity.SPEED


_ORDER_MAX = 64
"""States, or entries of a row; a design for a delay of 1.1 ms at 1 kHz has four."""
Vector = Annotated[tuple[Gain, ...], Field(strict=False, min_length=1, max_length=_ORDER_MAX)]

_Pair = Annotated[tuple[Gain, Gain], Field(strict=False)]
FusedGains = Annotated[
    tuple[Annotated[tuple[_Pair, _Pair, _Pair, _Pair], Field(strict=False)], ...],
    Field(strict=False, min_length=1, max_length=_ORDER_MAX),
]


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
        _check_period(self.period_us, setup)
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


def _check_period(period_us: int, setup: Setup) -> None:
    if period_us * NS_PER_US != setup.period:
        key = f"drive.{setup.axis}.controller.period_us"
        expected = f"loop.period_us = {setup.period / NS_PER_US:g}"
        raise BadInput(setup.source, key, period_us, expected)


class _PredictingController(AxisController):
    """Predicts the state to the instant at which a command acts, and cancels the load."""

    inertia_kg_m2: Inertia = Field(description="of all that turns, kg m^2")
    viscous_friction_nm_s: ViscousFriction = 0.0
    current_bandwidth_hz: float = Field(gt=0, description="of the drive's current loop, Hz")
    speed_filter_hz: float = Field(
        gt=0, description="corner of the filter behind the drive's speed 606Ch, Hz"
    )
    dead_time_us: float = Field(default=0.0, ge=0)
    """Dead time of the drive, in addition to these two."""
    speed_gain_nm_s_rad: Gain = Field(description="torque per speed error, N m per rad/s")
    torque_gain: Gain = Field(default=0.0, description="torque per torque that is missing, N m/N m")
    made_for: MadeFor | None = None
    """The network and the drive that it was designed for; ``hil run`` refuses others."""
    certificate: LossCertificate | None = None
    figures: LoopFigures | None = None

    @property
    def plant(self) -> PredictorPlant:
        """The model."""
        return PredictorPlant(
            self.inertia_kg_m2,
            self.viscous_friction_nm_s,
            math.tau * self.current_bandwidth_hz,
            math.tau * self.speed_filter_hz,
        )

    @property
    def dead_time(self) -> Duration:
        """``dead_time_us`` in ns."""
        return Duration(round(self.dead_time_us * NS_PER_US))


class PredictorController(_PredictingController):
    """By the speed alone, with gains that follow losses and load steps."""

    kind: Literal["predictor"]
    speed_noise_rad_s: float = Field(gt=0, description="rms of the noise on each reading of the speed, rad/s")
    torque_noise_nm: float = Field(default=0.0, ge=0)
    """Rms difference between a period's torque and its command."""
    load_noise_nm_sqrt_s: float = Field(gt=0, description="of the load's random walk, N m per root of s")
    load_noise_max_nm_sqrt_s: float = Field(gt=0, description="the same where a reading tells of a step")

    def build(self, setup: Setup) -> Controller:
        """Build the controller of an axis, with its predictor."""
        noise = FilterNoise(
            self.speed_noise_rad_s,
            self.torque_noise_nm,
            self.load_noise_nm_sqrt_s,
            self.load_noise_max_nm_sqrt_s,
        )
        predictor = Predictor(self.plant, noise, self.dead_time, setup.period)
        return LoadCancelling(predictor, self.plant, self.speed_gain_nm_s_rad, self.torque_gain)


class FusedController(_PredictingController):
    """By count and speed of each sample, 6064h and 606Ch of one SYNC, with constant gains."""

    kind: Literal["fused"]
    period_us: int = Field(gt=0, description="of the loop for which the gains hold, us")
    gains: FusedGains = Field(
        description="of a sample after 0, 1 .. lost ones: rows of speed, filtered speed, angle and load, for "
        "the count (rad) and for the filtered speed (rad/s)"
    )
    speed_gains: Annotated[tuple[Gain, Gain, Gain], Field(strict=False)] = Field(
        description="of a sample without a count: speed, filtered speed, load"
    )
    count_spread_rad: float = Field(gt=0, description="rms of a count beside the expected one, rad")
    tick_us: float = Field(default=0.0, ge=0, le=1e4)
    """At which the drive samples its encoder; 0: unknown."""
    needs_count: ClassVar = True

    def build(self, setup: Setup) -> Controller:
        """Build the controller of an axis, with its predictor. Raises BadInput for another period than its
        own."""
        _check_period(self.period_us, setup)
        predictor = FusedPredictor(
            self.plant,
            self.gains,
            self.speed_gains,
            self.count_spread_rad,
            Duration(round(self.tick_us * NS_PER_US)),
            self.dead_time,
            setup.period,
        )
        return LoadCancelling(predictor, self.plant, self.speed_gain_nm_s_rad, self.torque_gain)


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

    def follows(self, given: Quantity) -> Quantity:  # noqa: ARG002
        return Quantity.POSITION

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

    def follows(self, given: Quantity) -> Quantity:
        return given

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

    def follows(self, given: Quantity) -> None:
        """Return None: any reference."""

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
