"""What a speed controller's file says beside its gain: the network it was made for, and the proof.

``hil design speed --out`` writes it, a bench file names it as ``controller``, and ``hil run`` holds the
network that it measures against it.
"""

from typing import Annotated, Literal

from pydantic import Field

from hil.configuration.config_files import Section
from hil.configuration.quantities import Coefficient, Inductance, Inertia, Resistance, ViscousFriction

Rows = Annotated[tuple[Annotated[tuple[Coefficient, ...], Field(strict=False)], ...], Field(strict=False)]


class Plant(Section):
    """The motor as the design saw it."""

    resistance_ohm: Resistance
    inductance_q_h: Inductance
    inertia_kg_m2: Inertia
    viscous_friction_nm_s: ViscousFriction
    torque_constant_nm_a: float = Field(gt=0)


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
    plant: Plant | None = None


class SequenceProof(Section):
    """``sequences``: the sampled loop decays at ``decay_per_s`` under every admissible loss and delay."""

    decay_per_s: float
    gamma_sampled: float = Field(ge=0)
    """Largest gain under d lost of every d + 1, rad/s per N m."""
    min_margin: float
    P: Annotated[tuple[Rows, ...], Field(strict=False)]
    """The matrix of each node's quadratic function, in the coordinates of ``design/held_loop.py``."""


class Certificate(Section):
    """``certificate``: what is proved of the loop with the constant delay, and of the sampled one."""

    method: Literal["exact", "lmi", "ccl"]
    target: Literal["constant", "sampled"] = "constant"
    """Which of the two was made best; of the other less may be known."""
    gamma: float | None = Field(default=None, gt=0)
    """Certified gain from load torque to speed error with the constant delay, rad/s per N m."""
    gamma_exact: float | None = Field(default=None, gt=0)
    order: int | None = Field(default=None, ge=0)
    """Of the functional; 0 is [Ling2012] Theorem 3.3."""
    solver: str
    status: str
    min_margin: float | None = None
    sequences: SequenceProof | None = None
