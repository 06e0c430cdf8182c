"""What ``hil design current`` is asked for."""

from dataclasses import dataclass

from design.hinf.reduction import Method
from design.hinf.weights import Weights
from design.motor import PmsmParameters
from design.statespace import StateSpace


@dataclass(frozen=True, slots=True, eq=False)
class OtherAxis:
    """The continuous controller of the axis that is not designed, and its crossover."""

    controller: StateSpace
    crossover_rad_s: float

    def pair(self, axis: str, own: StateSpace) -> tuple[StateSpace, StateSpace]:
        """(K_d, K_q), ``own`` being that of ``axis``."""
        return (own, self.controller) if axis == "d" else (self.controller, own)


@dataclass(frozen=True, slots=True)
class CurrentRequest:
    """What was asked for."""

    motor: PmsmParameters
    axis: str
    weights: Weights | None = None
    gamma: float | None = None
    gamma_factor: float | None = None
    structure: str = "full"
    order: int | None = None
    method: Method = Method.TRUNCATE
    rate_hz: float | None = None
    delay_samples: int = 1
    discrete: bool = False
    """Whether the controller is made for the sampled plant itself."""
    modulus_margin: float | None = None
    other: OtherAxis | None = None
    """The other axis' continuous controller; by the rules if absent."""
    speed_max_rad_s: float | None = None
    """Up to which the coupled axes are looked at; the rated speed if absent."""
    decoupling_factor: float = 1.0
    """The inductances that the drive decouples with, beside the motor's."""
    advance_periods: float | None = None
    """Angle advance of the drive; the right one if absent."""
