"""``kind = "predictor"``: a Kalman filter, a prediction over the delay and a feedback, stated in a file."""

import math
from typing import Literal

from pydantic import Field

from servobench.design.speed.predictor_plant import PredictorPlant
from servobench.drivers.timebase import NS_PER_US, Duration
from servobench.hil.configuration.controller_section import AxisController
from servobench.hil.configuration.quantities import Gain, Inertia, ViscousFriction
from servobench.hil.configuration.speed_controller_file import LoopFigures, LossCertificate, MadeFor
from servobench.hil.control.load_filter import FilterNoise
from servobench.hil.control.predictor import LoadCancelling, Predictor
from servobench.hil.control.setup import Setup
from servobench.hil.loop.axis_roles import Controller


class PredictorController(AxisController):
    """Predicts the state to the instant at which a command acts, and cancels the load."""

    kind: Literal["predictor"]
    inertia_kg_m2: Inertia = Field(description="of all that turns, kg m^2")
    viscous_friction_nm_s: ViscousFriction = 0.0
    current_bandwidth_hz: float = Field(gt=0, description="of the drive's current loop, Hz")
    speed_filter_hz: float = Field(
        gt=0, description="corner of the filter behind the drive's speed 606Ch, Hz"
    )
    dead_time_us: float = Field(default=0.0, ge=0)
    """Dead time of the drive, in addition to these two."""
    speed_noise_rad_s: float = Field(gt=0, description="rms of the noise on each reading of the speed, rad/s")
    torque_noise_nm: float = Field(default=0.0, ge=0)
    """Rms difference between a period's torque and its command."""
    load_noise_nm_sqrt_s: float = Field(gt=0, description="of the load's random walk, N m per root of s")
    load_noise_max_nm_sqrt_s: float = Field(gt=0, description="the same where a reading tells of a step")
    speed_gain_nm_s_rad: Gain = Field(description="torque per speed error, N m per rad/s")
    torque_gain: Gain = Field(default=0.0, description="torque per torque that is missing, N m/N m")
    made_for: MadeFor | None = None
    """The network and the drive that it was designed for; ``hil run`` refuses others."""
    certificate: LossCertificate | None = None
    figures: LoopFigures | None = None

    def build(self, setup: Setup) -> Controller:
        """Build the controller of an axis, with its predictor."""
        plant = PredictorPlant(
            self.inertia_kg_m2,
            self.viscous_friction_nm_s,
            math.tau * self.current_bandwidth_hz,
            math.tau * self.speed_filter_hz,
        )
        noise = FilterNoise(
            self.speed_noise_rad_s,
            self.torque_noise_nm,
            self.load_noise_nm_sqrt_s,
            self.load_noise_max_nm_sqrt_s,
        )
        dead_time = Duration(round(self.dead_time_us * NS_PER_US))
        predictor = Predictor(plant, noise, dead_time, setup.period)
        return LoadCancelling(predictor, plant, self.speed_gain_nm_s_rad, self.torque_gain)
