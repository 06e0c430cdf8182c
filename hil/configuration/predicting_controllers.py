"""``predictor`` and ``fused``: tables of controllers that predict the state to when a command acts."""

import math
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from servobench.design.speed.position_loop import design_position
from servobench.design.speed.predictor_plant import PredictorPlant
from servobench.drivers.timebase import NS_PER_S, NS_PER_US, Duration
from servobench.hil.configuration.controller_files import LoopFigures, LossCertificate, MadeFor
from servobench.hil.configuration.controller_section import ORDER_MAX, AxisController, check_period
from servobench.hil.configuration.quantities import Gain, Inertia, ViscousFriction
from servobench.hil.control.load_filter import FilterNoise
from servobench.hil.control.predictor import (
    FusedPredictor,
    LoadCancelling,
    PositionTracking,
    Predicting,
    Predictor,
)
from servobench.hil.control.setup import Setup
from servobench.hil.loop.protocol import Controller
from servobench.hil.loop.scenario import Quantity

_APPROACH = 0.8
"""Share of ``speed_max_rpm``, at which the bench stops a drive: a speed loop overshoots."""
_BRAKING = 0.5
"""Share of the torque limit to brake with from a step of the position: the load has the rest."""
_Pair = Annotated[tuple[Gain, Gain], Field(strict=False)]
FusedGains = Annotated[
    tuple[Annotated[tuple[_Pair, _Pair, _Pair, _Pair], Field(strict=False)], ...],
    Field(strict=False, min_length=1, max_length=ORDER_MAX),
]


class PredictingController(AxisController):
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
    position_gain_per_s: float | None = Field(default=None, gt=0, le=1e5)
    """K: speed per position error, for a reference of positions, 1/s. Default: designed as that of a
    ``position`` controller, for the speed loop that ``speed_gain_nm_s_rad`` closes and the delay of
    ``made_for``."""
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

    def follows(self, given: Quantity) -> tuple[Quantity, ...]:  # noqa: ARG002
        return (Quantity.SPEED, Quantity.POSITION)

    def feedback(self, predictor: Predicting, setup: Setup) -> Controller:
        """Build the feedback of an axis on the state that its predictor tells."""
        gains = (self.speed_gain_nm_s_rad, self.torque_gain)
        if setup.followed is not Quantity.POSITION:
            return LoadCancelling(predictor, self.plant, *gains)
        return PositionTracking(
            predictor,
            self.plant,
            *gains,
            self.position_gain_per_s or self._designed_gain_per_s(setup.period),
            _APPROACH * setup.speed_max_rad_s,
            _BRAKING * setup.torque_max_nm / self.inertia_kg_m2,
        )

    def _designed_gain_per_s(self, period: Duration) -> float:
        """Return K for its own speed loop, 1/s."""
        delay = period if self.made_for is None else self.made_for.delay_us * NS_PER_US
        bandwidth_rad_s = self.speed_gain_nm_s_rad / self.inertia_kg_m2
        return design_position(period / NS_PER_S, delay / NS_PER_S, bandwidth_rad_s)


class PredictorController(PredictingController):
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
        return self.feedback(predictor, setup)


class FusedController(PredictingController):
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
        check_period(self.period_us, setup)
        predictor = FusedPredictor(
            self.plant,
            self.gains,
            self.speed_gains,
            self.count_spread_rad,
            Duration(round(self.tick_us * NS_PER_US)),
            self.dead_time,
            setup.period,
        )
        return self.feedback(predictor, setup)
