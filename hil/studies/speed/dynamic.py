"""``hil design speed --structure``: what all controllers with states of their own have in common."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

from design.motor import PmsmParameters
from design.sampled.analysis import SampledAnalysis
from design.speed.loop_robustness import LOST, LoopRobustness
from design.speed.loss_certificate import with_losses
from design.speed.predictor_design import PredictorRequest
from design.speed.predictor_plant import encoder_noise_rad_s
from hil.configuration.config_files import Section
from hil.configuration.speed_controller_file import CurrentLoop, LoopFigures, MadeFor
from hil.studies.numbers import finite, short
from hil.studies.speed.controller_text import plant_of, whole_us
from hil.studies.speed.losses import certified_of, loss_certificate, loss_figures

US_PER_S = 1e6
_TORQUE_NOISE = 0.005
"""Of the rated torque: what a drive's torque differs from its demand within a period, ripple and offsets."""


@dataclass(frozen=True, slots=True)
class PredictorDrive:
    """What the design knows of the drive beside its motor."""

    current_bandwidth_hz: float
    encoder_counts: int
    speed_filter_hz: float
    inner_rate_hz: float
    """At which it takes the difference of its encoder's counts."""
    dead_time_s: float
    """From a command's instant to its voltage, and from a sample's to that of its count."""


@dataclass(frozen=True, slots=True)
class PredictorNetwork:
    """What the network does."""

    period_s: float
    delay_max_s: float
    """From a sample to its command's instant."""
    losses_max: int
    measured: bool
    """Whether somebody measured it: then a run is held against it."""


def request_of(
    motor: PmsmParameters,
    drive: PredictorDrive,
    network: PredictorNetwork,
    load_nm: float,
    command_noise_nm: float,
) -> PredictorRequest:
    """What a design goes by."""
    return PredictorRequest(
        motor=motor,
        current_rate_rad_s=math.tau * drive.current_bandwidth_hz,
        speed_filter_hz=drive.speed_filter_hz,
        speed_noise_rad_s=short(
            encoder_noise_rad_s(drive.encoder_counts, drive.speed_filter_hz, drive.inner_rate_hz)
        ),
        torque_noise_nm=short(_TORQUE_NOISE * motor.rated_torque_nm),
        period_s=network.period_s,
        delay_s=network.delay_max_s + drive.dead_time_s,
        load_nm=load_nm,
        command_noise_nm=command_noise_nm,
    )


@dataclass(frozen=True, slots=True, eq=False)
class DynamicResult(ABC):
    """A controller and what is known of it; a structure is a subclass, which has its design."""

    structure: ClassVar[str]
    proved: ClassVar[dict[str, str]]
    """In words: what ``gamma`` and other figures of its own are worth."""

    drive: PredictorDrive
    network: PredictorNetwork
    losses: Sequence[SampledAnalysis] = field(default=(), kw_only=True)
    """With ever fewer in a row, up to the most that are certified; empty: not looked at."""

    @property
    @abstractmethod
    def request(self) -> PredictorRequest:
        """What the design went by."""

    @property
    @abstractmethod
    def loop(self) -> LoopRobustness:
        """Figures of its loop."""

    @abstractmethod
    def own_figures(self) -> dict[str, Any]:
        """For JSON: of the controller alone."""

    @abstractmethod
    def own_robustness(self) -> dict[str, Any]:
        """For JSON: beside what every structure tells."""

    @abstractmethod
    def analysed(self, losses_max: int) -> SampledAnalysis:
        """Over every sequence with at most so many samples lost in a row. Raises NoSolution."""

    @abstractmethod
    def controller(self) -> Section:
        """The table [controller]."""

    def certified(self) -> Self:
        """The same with what is certified over lost samples. Raises NoSolution."""
        return replace(self, losses=with_losses(self.analysed, self.network.losses_max))

    @property
    def figures(self) -> dict[str, Any]:
        """For JSON."""
        request = self.request
        return {
            "feasible": True,
            "structure": self.structure,
            "current_bandwidth_hz": self.drive.current_bandwidth_hz,
            "period_s": self.network.period_s,
            "delay_s": self.network.period_s + self.network.delay_max_s,
            "dead_time_s": self.drive.dead_time_s,
            "speed_noise_rad_s": request.speed_noise_rad_s,
            **self.own_figures(),
            "load_nm": request.load_nm,
            "peak_floor_rad_s": request.floor_rad_s(),
            "gamma": finite(self.loop.gain),
            "certificate": {**self.proved, "losses": loss_figures(self.losses), "peaks": "none: by trial"},
            "robustness": self._robustness(),
        }

    def _robustness(self) -> dict[str, Any]:
        loop = self.loop
        return {
            "peak_over_floor": loop.peak_over_floor,
            "peak_over_floor_inertia_70_percent": loop.peak_over_floor_inertia_less,
            "peak_over_floor_inertia_130_percent": loop.peak_over_floor_inertia_more,
            f"peak_over_floor_{LOST}_lost": loop.peak_over_floor_lost,
            "gain_margin_db": finite(loop.margins.gain_margin_db),
            "phase_margin_deg": finite(loop.margins.phase_margin_deg),
            "modulus_margin": finite(loop.margins.modulus_margin),
            "delay_margin_s": loop.delay_margin_s,
            "inertia_70_percent": {"gamma_exact": finite(loop.gain_inertia_less)},
            "inertia_130_percent": {"gamma_exact": finite(loop.gain_inertia_more)},
            "current_bandwidth_50_percent": {"gamma_exact": finite(loop.gain_current_loop_slower)},
            **self.own_robustness(),
            "torque_noise_nm": finite(loop.command_noise_nm),
        }

    def told(self, norm: float | None = None) -> dict[str, Any]:
        """What the table [controller] of every structure says of how it was made and what it is worth."""
        motor, loop = self.request.motor, self.loop
        return {
            "inertia_kg_m2": motor.inertia_kg_m2,
            "viscous_friction_nm_s": motor.viscous_friction_nm_s,
            "made_for": self._made_for(),
            "certificate": loss_certificate(self.losses),
            "figures": LoopFigures(
                load_nm=self.request.load_nm,
                peak_over_floor=short(loop.peak_over_floor),
                peak_over_floor_inertia_70_percent=short(loop.peak_over_floor_inertia_less),
                peak_over_floor_inertia_130_percent=short(loop.peak_over_floor_inertia_more),
                norm=norm,
                gamma=short(loop.gain),
                delay_margin_us=short(loop.delay_margin_s * US_PER_S),
                torque_noise_nm=short(loop.command_noise_nm),
            ),
        }

    def _made_for(self) -> MadeFor:
        """With a certificate, for as many losses in a row as that covers."""
        network, (least, most) = self.network, self.loop.bandwidths
        hz = self.drive.current_bandwidth_hz
        made = MadeFor(
            delay_us=whole_us(network.period_s + network.delay_max_s),
            period_us=whole_us(network.period_s),
            plant=plant_of(self.request.motor),
            current_loop=CurrentLoop(
                bandwidth_hz=hz, bandwidth_min_hz=short(hz * least), bandwidth_max_hz=short(hz * most)
            ),
        )
        certified = certified_of(self.losses)
        if certified is None and not network.measured:
            return made
        held = {
            "losses_in_a_row_max": network.losses_max if certified is None else certified.network.losses_max,
            "delay_max_us": math.floor(network.delay_max_s * US_PER_S + 1e-6),
        }
        return made.model_copy(update=held)
