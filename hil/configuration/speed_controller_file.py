"""What a speed controller's file says beside its gain: the network and drive it was made for, and the proof.

``hil design speed --out`` writes it, a bench file names it as ``controller``, and ``hil run`` holds the
drive of the bench and the network that it measures against it.
"""

from typing import Annotated, Literal

from pydantic import Field

from servobench.hil.configuration.config_files import Section
from servobench.hil.configuration.quantities import (
    Coefficient,
    Inductance,
    Inertia,
    Resistance,
    ViscousFriction,
)

_ROUNDING = 1e-4
"""Of a bandwidth that somebody wrote into a file with four digits: far below what would change a figure."""

Rows = Annotated[tuple[Annotated[tuple[Coefficient, ...], Field(strict=False)], ...], Field(strict=False)]


class DesignPlant(Section):
    """The motor as the design saw it."""

    resistance_ohm: Resistance
    inductance_q_h: Inductance
    inertia_kg_m2: Inertia
    viscous_friction_nm_s: ViscousFriction
    torque_constant_nm_a: float = Field(gt=0)


class CurrentLoop(Section):
    """``current_loop``: the drive's, as the design saw it, and where the certificates hold."""

    order: Literal[1] = 1
    """A PI that cancels the pole of the winding makes it one of first order."""
    bandwidth_hz: float = Field(gt=0)
    bandwidth_min_hz: float = Field(gt=0)
    bandwidth_max_hz: float = Field(gt=0)

    def covers(self, bandwidth_hz: float) -> bool:
        """Whether the certificates hold for a drive whose current loop has ``bandwidth_hz``."""
        slack = _ROUNDING * self.bandwidth_hz
        return self.bandwidth_min_hz - slack <= bandwidth_hz <= self.bandwidth_max_hz + slack

    def is_that_of_the_design(self, bandwidth_hz: float) -> bool:
        """Whether ``bandwidth_hz`` is what the design reckoned with."""
        return abs(bandwidth_hz - self.bandwidth_hz) <= _ROUNDING * self.bandwidth_hz


class MadeFor(Section):
    """``made_for``: for what the certificate holds."""

    delay_us: int = Field(ge=0, description="the constant delay of the continuous design, us")
    strategy: Literal["arrival", "stamp", "history"] | None = None
    """When a sample is applied; absent: only the constant delay was looked at."""
    period_us: int | None = Field(default=None, gt=0)
    losses_in_a_row_max: int | None = Field(default=None, ge=0)
    delay_max_us: int | None = Field(default=None, ge=0)
    """From sample to actuator."""
    agreed_delay_us: int | None = Field(default=None, gt=0)
    """At which stamp and history apply a sample."""
    torque_rms_nm_max: float | None = Field(default=None, gt=0)
    """What the torque may swing about its mean at steady reference and load: judged like the bench's own
    ``verdict.torque_rms_nm_max``, of which the smaller counts."""
    plant: DesignPlant | None = None
    current_loop: CurrentLoop | None = None
    """Absent: a drive without one, whose current follows the voltage by R/L of ``plant``, [Ling2012]."""


class SequenceProof(Section):
    """``sequences``: what holds under every admissible loss and delay, beside the worst that was found."""

    gain_certified: float = Field(gt=0)
    """From load torque to speed error, rad/s per N m."""
    gain_certified_all_bandwidths: float | None = Field(default=None, gt=0)
    """The same for every bandwidth of ``current_loop``."""
    gain_found: float = Field(gt=0)
    step_peak_certified_rad_s: float | None = Field(default=None, gt=0)
    """Speed error that no sequence exceeds after a load step of 1 N m; absent: none was proved."""
    step_peak_found_rad_s: float | None = Field(default=None, gt=0)
    decay_certified_per_s: float = Field(gt=0)
    decay_certified_all_bandwidths_per_s: float | None = Field(default=None, gt=0)
    decay_found_per_s: float = Field(gt=0)
    min_margin: float
    gain_matrices: Annotated[tuple[Rows, ...], Field(strict=False)]
    decay_matrices: Annotated[tuple[Rows, ...], Field(strict=False)]
    """Of the quadratic function of each node at which a sample has just come
    (``design/sampled/sequence_graph.py``), in the coordinates of ``design/sampled/held_loop.py``; of a
    predictor and of H-infinity in those of ``design/speed/loss_certificate.py``."""


class LossCertificate(Section):
    """``certificate`` of a controller with states of its own: what holds over every sequence of lost samples.

    At the delay of ``made_for`` and no other, with its plant and the bandwidth of its current loop, and with
    every command arriving.
    """

    losses_in_a_row_max: int = Field(ge=0)
    solver: str
    sequences: SequenceProof

    @property
    def gain(self) -> float:
        """Certified from load torque to speed error, rad/s per N m."""
        return self.sequences.gain_certified


class LoopFigures(Section):
    """``figures`` of a controller with states of its own: what the design found; see docs/control.md."""

    load_nm: float = Field(gt=0)
    """The step of the load that it was designed for."""
    peak_over_floor: float = Field(gt=0)
    """After that step, at the worst instant between two samples."""
    peak_over_floor_inertia_70_percent: float = Field(gt=0)
    peak_over_floor_inertia_130_percent: float = Field(gt=0)
    norm: float | None = Field(default=None, gt=0)
    """Of H-infinity alone: of the weighted problem."""
    gamma: float = Field(gt=0)
    """L2 gain from load torque to speed error, rad/s per N m, of the sampled loop without losses."""
    delay_margin_us: float = Field(ge=0)
    torque_noise_nm: float = Field(ge=0)
    """Rms of the command by the encoder's noise."""


class Certificate(Section):
    """``certificate``: what is proved of the loop with the constant delay, and of the sampled one."""

    method: Literal["exact", "lmi", "ccl"]
    target: Literal["constant", "sampled"] = "constant"
    """Which of the two was made best; of the other less may be known."""
    gamma: float | None = Field(default=None, gt=0)
    """Certified gain from load torque to speed error with the constant delay, rad/s per N m."""
    gamma_all_bandwidths: float | None = Field(default=None, gt=0)
    """The same for every bandwidth of ``current_loop``; absent: of that the sampled loop's figures tell."""
    gamma_exact: float | None = Field(default=None, gt=0)
    order: int | None = Field(default=None, ge=0)
    """Of the functional; 0 is [Ling2012] Theorem 3.3."""
    solver: str
    status: str
    min_margin: float | None = None
    sequences: SequenceProof | None = None

    @property
    def gain(self) -> float | None:
        """Certified from load torque to speed error, rad/s per N m, of the loop that runs: over every
        sequence where that is known, else with the constant delay; over every bandwidth where that is."""
        if self.sequences is None:
            return self.gamma_all_bandwidths or self.gamma
        return self.sequences.gain_certified_all_bandwidths or self.sequences.gain_certified
