"""Files of designed controllers.

``hil design speed --out`` writes, besides the gain, network and drive that it is made for, and the proof; a
bench file names the file as ``controller``, and ``hil run`` compares the bench's drive and the measured
network with it. A simulated drive runs the current controller that ``hil design current --out`` writes.
"""

import math
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from servobench.design.statespace import StateSpace, from_zpk
from servobench.drivers.bounded_file import NamedBy
from servobench.drivers.errors import BadInput
from servobench.hil.configuration.config_files import Section, load_file
from servobench.hil.configuration.quantities import (
    WHOLE,
    Coefficient,
    Inductance,
    Inertia,
    Resistance,
    ViscousFriction,
)

_ROUNDING = 1e-4
"""Relative rounding of a bandwidth written with four digits: far too small to change a figure."""

Rows = Annotated[tuple[Annotated[tuple[Coefficient, ...], Field(strict=False)], ...], Field(strict=False)]

FilterGains = Annotated[tuple[Rows, ...], Field(strict=False)]


class DesignCoupling(Section):
    """``coupling`` of a plant: two masses, the load's behind a spring with a damper."""

    motor_kg_m2: float = Field(gt=0)
    load_kg_m2: float = Field(gt=0)
    stiffness_nm_rad: float = Field(gt=0)
    damping_nm_s: float = Field(ge=0)
    encoder: Literal["motor", "load"]
    friction: Literal["motor", "load"]
    """Side of the viscous friction."""

    @property
    def resonance_hz(self) -> float:
        """At which both masses swing against each other."""
        per_inertia = 1.0 / self.motor_kg_m2 + 1.0 / self.load_kg_m2
        return math.sqrt(self.stiffness_nm_rad * per_inertia) / math.tau


class DesignPlant(Section):
    """The motor as the design saw it."""

    resistance_ohm: Resistance
    inductance_q_h: Inductance
    inertia_kg_m2: Inertia
    viscous_friction_nm_s: ViscousFriction
    torque_constant_nm_a: float = Field(gt=0)
    coupling: DesignCoupling | None = None
    """Absent: a rigid shaft."""


class CurrentLoop(Section):
    """``current_loop``: the drive's, as the design saw it, and the range of the certificates."""

    order: Annotated[Literal[1], WHOLE] = 1
    """A PI that cancels the pole of the winding makes it first order."""
    bandwidth_hz: float = Field(gt=0)
    bandwidth_min_hz: float = Field(gt=0)
    bandwidth_max_hz: float = Field(gt=0)

    @model_validator(mode="after")
    def _lies_in_its_range(self) -> Self:
        if not self.covers(self.bandwidth_hz):
            raise ValueError("bandwidth_hz: from bandwidth_min_hz to bandwidth_max_hz")
        return self

    def covers(self, bandwidth_hz: float) -> bool:
        """Return True if the certificates hold for a drive whose current loop has ``bandwidth_hz``."""
        slack = _ROUNDING * self.bandwidth_hz
        return self.bandwidth_min_hz - slack <= bandwidth_hz <= self.bandwidth_max_hz + slack

    def is_that_of_the_design(self, bandwidth_hz: float) -> bool:
        """Return True if ``bandwidth_hz`` is the design's."""
        return abs(bandwidth_hz - self.bandwidth_hz) <= _ROUNDING * self.bandwidth_hz


class MadeFor(Section):
    """``made_for``: conditions of the certificate."""

    delay_us: int = Field(ge=0, description="the constant delay of the continuous design, us")
    strategy: Literal["arrival", "stamp", "history"] | None = None
    """Instant at which a sample is applied; absent: only the constant delay was analysed."""
    period_us: int | None = Field(default=None, gt=0)
    losses_in_a_row_max: int | None = Field(default=None, ge=0)
    delay_max_us: int | None = Field(default=None, ge=0)
    """From sample to actuator."""
    agreed_delay_us: int | None = Field(default=None, gt=0)
    """Age at which stamp and history apply a sample."""
    sync_within_us: int | None = Field(default=None, gt=0)
    """Largest departure of the distance of two SYNCs from ``period_us``; absent: the period is constant."""
    torque_rms_nm_max: float | None = Field(default=None, gt=0)
    """Torque swing about its mean allowed at steady reference and load: judged like the bench's own
    ``verdict.torque_rms_nm_max``, of which the smaller counts."""
    plant: DesignPlant | None = None
    current_loop: CurrentLoop | None = None
    """Absent: a drive without one, whose current follows the voltage by R/L of ``plant``, [Ling2012]."""


class SequenceProof(Section):
    """``sequences``: guarantees under every admissible loss and delay, with the worst case found."""

    gain_certified: float = Field(gt=0)
    """From load torque to speed error, rad/s per N m."""
    gain_certified_all_bandwidths: float | None = Field(default=None, gt=0)
    """The same for every bandwidth of ``current_loop``."""
    gain_found: float = Field(gt=0)
    step_peak_certified_rad_s: float | None = Field(default=None, gt=0)
    """Speed error that no sequence exceeds after a load step of 1 N m; absent: not proved."""
    step_peak_found_rad_s: float | None = Field(default=None, gt=0)
    decay_certified_per_s: float = Field(gt=0)
    decay_certified_all_bandwidths_per_s: float | None = Field(default=None, gt=0)
    decay_found_per_s: float = Field(gt=0)
    min_margin: float
    gain_matrices: Annotated[tuple[Rows, ...], Field(strict=False)]
    decay_matrices: Annotated[tuple[Rows, ...], Field(strict=False)]
    """Matrices of the quadratic function of each node at which a sample has just come
    (``design/sampled/sequence_graph.py``), in the coordinates of ``design/sampled/held_loop.py``; for a
    predictor and H-infinity in those of ``design/speed/loss_certificate.py``."""
    digest: str | None = None
    """SHA-256 over the whole table [controller] but this key, as ``hil design`` wrote it."""


class LossCertificate(Section):
    """``certificate`` of a controller with its own states: guarantees over every sequence of lost samples.

    Valid at the delay of ``made_for`` only, with its plant and the bandwidth of its current loop, and if
    every command arrives.
    """

    losses_in_a_row_max: int = Field(ge=0)
    solver: str
    speed_filter_hz: float | None = Field(default=None, gt=0)
    """Corner of the filter behind the drive's speed; a predictor's own key has it."""
    dead_time_us: float | None = Field(default=None, ge=0)
    """Dead time of the drive, likewise."""
    filter_gains: FilterGains | None = None
    """Corners of the hull of all gains of a predictor's filter, [speed, filtered speed, load] each, after
    0, 1 .. lost samples."""
    sequences: SequenceProof

    @property
    def gain(self) -> float:
        """Certified from load torque to speed error, rad/s per N m."""
        return self.sequences.gain_certified


class LoopFigures(Section):
    """``figures`` of a controller with its own states: results of the design; see docs/control.md."""

    load_nm: float = Field(gt=0)
    """The load step that it was designed for."""
    peak_over_floor: float = Field(gt=0)
    """After that step, at the worst instant between two samples."""
    peak_over_floor_inertia_70_percent: float = Field(gt=0)
    peak_over_floor_inertia_130_percent: float = Field(gt=0)
    norm: float | None = Field(default=None, gt=0)
    """Norm of the weighted problem; H-infinity only."""
    gamma: float = Field(gt=0)
    """L2 gain from load torque to speed error, rad/s per N m, of the sampled loop without losses."""
    delay_margin_us: float = Field(ge=0)
    torque_noise_nm: float = Field(ge=0)
    """Rms of the command by the encoder's noise."""


class Certificate(Section):
    """``certificate``: proofs for the loop with the constant delay, and for the sampled one."""

    method: Literal["exact", "lmi", "ccl"]
    target: Literal["constant", "sampled"] = "constant"
    """The loop that was optimised; less may be known about the other."""
    gamma: float | None = Field(default=None, gt=0)
    """Certified gain from load torque to speed error with the constant delay, rad/s per N m."""
    gamma_all_bandwidths: float | None = Field(default=None, gt=0)
    """The same for every bandwidth of ``current_loop``; absent: see the sampled loop's figures."""
    gamma_exact: float | None = Field(default=None, gt=0)
    order: int | None = Field(default=None, ge=0)
    """Order of the functional; 0 is [Ling2012] Theorem 3.3."""
    solver: str
    status: str
    min_margin: float | None = None
    sequences: SequenceProof | None = None

    @property
    def gain(self) -> float | None:
        """Certified from load torque to speed error, rad/s per N m, for the loop as it runs: over every
        sequence if known, else with the constant delay; over every bandwidth if known."""
        if self.sequences is None:
            return self.gamma_all_bandwidths or self.gamma
        return self.sequences.gain_certified_all_bandwidths or self.sequences.gain_certified


ORDER_MAX = 64
"""Roots; a drive runs three or four of them 16 000 times a second."""
Root = Annotated[tuple[Coefficient, Coefficient], Field(strict=False)]
Roots = Annotated[tuple[Root, ...], Field(strict=False, max_length=ORDER_MAX)]


class ContinuousController(Section):
    """gain * prod(s - zeros)/prod(s - poles), volts per ampere; sampled by Tustin's rule where it runs."""

    kind: Literal["continuous"]
    axis: Literal["d", "q"] = Field(description="'d' or 'q'")
    gain: Coefficient = Field(description="the gain of the zero-pole form")
    zeros_rad_s: Roots = Field(description="[real, imaginary] of each zero, rad/s")
    poles_rad_s: Roots = Field(description="[real, imaginary] of each pole, rad/s")
    prewarp_rad_s: Coefficient = Field(default=0.0, ge=0)
    """Frequency at which Tustin's rule is exact: the loop's crossover."""

    def at_rate(self, rate_hz: int) -> StateSpace:
        """Return the sampled controller. Error: ValueError for roots without their conjugate or too low a
        rate."""
        from servobench.design.statespace import tustin  # with scipy: a third of a second, for who has one

        return tustin(self.continuous(), rate_hz, self.prewarp_rad_s)

    def continuous(self) -> StateSpace:
        """Return the controller itself. Error: ValueError for roots without their conjugate."""
        return from_zpk(_numbers(self.zeros_rad_s), _numbers(self.poles_rad_s), self.gain)


class SampledController(Section):
    """gain * prod(z - zeros)/prod(z - poles), made for one inner rate only."""

    kind: Literal["sampled"]
    axis: Literal["d", "q"] = Field(description="'d' or 'q'")
    gain: Coefficient = Field(description="the gain of the zero-pole form")
    zeros_z: Roots = Field(description="[real, imaginary] of each zero in the z plane")
    poles_z: Roots = Field(description="[real, imaginary] of each pole in the z plane")
    sample_rate_hz: int = Field(gt=0, description="the inner rate that it was made for, Hz")

    def at_rate(self, rate_hz: int) -> StateSpace:
        """Return the controller. Error: ValueError for another rate than its own."""
        if rate_hz != self.sample_rate_hz:
            raise ValueError(f"made for {self.sample_rate_hz} Hz, the drive's inner rate is {rate_hz} Hz")
        return from_zpk(_numbers(self.zeros_z), _numbers(self.poles_z), self.gain, 1.0 / rate_hz)

    def continuous(self) -> StateSpace:
        """Return the continuous system that Tustin's rule maps to this controller."""
        from servobench.design.statespace import to_bilinear

        return to_bilinear(self.at_rate(self.sample_rate_hz))


def _numbers(roots: tuple[tuple[float, float], ...]) -> list[complex]:
    return [complex(*root) for root in roots]


CurrentController = Annotated[ContinuousController | SampledController, Field(discriminator="kind")]


class CurrentControllerFile(Section):
    """A whole file."""

    current_controller: CurrentController = Field(
        description="the table [current_controller] with kind = 'continuous' or 'sampled'"
    )


class CurrentControl(Section):
    """``current_control``: controllers that the simulated drive runs instead of its PI current loops."""

    controller: CurrentController | None = None
    """Path of the controller on the q axis, which makes the torque; default: PI."""
    controller_d: CurrentController | None = None
    """Path of the controller on the d axis; default: PI."""


def load_current_controller(path: Path, named_by: NamedBy, axis: str) -> CurrentController:
    """Load the controller file at ``path``, made for ``axis``. Raises BadInput or BadInputs."""
    controller = read_current_controller(path, named_by)
    if controller.axis != axis:
        raise BadInput(
            named_by.source,
            named_by.key,
            f"a controller for the {controller.axis} axis",
            f"one for the {axis} axis",
        )
    return controller


def read_current_controller(path: Path, named_by: NamedBy) -> CurrentController:
    """Load the controller file at ``path``, for either axis. Raises BadInput or BadInputs."""
    file = load_file(CurrentControllerFile, path, "current controller file", named_by)
    controller = file.current_controller
    try:
        controller.at_rate(controller.sample_rate_hz if controller.kind == "sampled" else 1_000_000)
    except ValueError as error:
        raise BadInput(str(path), "current_controller", str(error), "a controller that can be run") from None
    return controller
