"""The mixed-sensitivity problem of Fig. 6 in [Azaiz2007]: z = [w1 e; w2 u; w3 i], y = e = i_ref - i.

|| [w1 S; w2 K S; w3 T] || < gamma,  S = 1/(1 + G K),  T = G K S        (40)

Weights of the mixed-sensitivity problem of [Azaiz2007] 3.2, from rules and as printed.

A bound 1/|w| on a closed-loop gain is drawn by its ends and its crossing: a first-order w is fixed by the
gain at low frequency, the gain at high frequency, and the frequency at which |w| = 1.

    w(s) = high (s + zero)/(s + pole)      w(0) = low      |w(j crossing)| = 1
    pole^2 (low^2 - 1) = crossing^2 (1 - high^2)      zero = pole low/high

The standard problem of [Azaiz2007] (2), its assumptions, and its normal form.

    x' = A x + B1 w + B2 u        z = C1 x + D11 w + D12 u        y = C2 x + D21 w + D22 u

A1  (A, B2) stabilisable and (A, C2) detectable
A2  D12 of full column rank and D21 of full row rank, here scaled and rotated to [0; I] and [0 I], (65)-(67)
A3  [A - jwI, B2; C1, D12] of full column rank for all w
A4  [A - jwI, B1; C2, D21] of full row rank for all w
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack

from servobench.design.errors import SingularPlant
from servobench.design.statespace import (
    Array,
    ComplexArray,
    StateSpace,
    append,
    balanced,
    connect,
    first_order,
    state_space,
)

_RANK = 1e-11
"""A singular value below this part of the largest one counts as zero."""
_ROUNDED = 1e-13
"""Relative error of matrix entries that the eigenvalues must tolerate."""


@dataclass(frozen=True, slots=True, eq=False)
class GeneralisedPlant:
    """``system`` has the inputs [w; u] and the outputs [z; y]; m2 = size of u, p2 = size of y."""

    system: StateSpace
    controls: int
    measurements: int

    def __post_init__(self) -> None:
        """Error: ValueError where no w, z, u or y is left, or for a sampled system."""
        p, m = self.system.D.shape
        if not (1 <= self.controls <= m - 1 and 1 <= self.measurements <= p - 1):
            raise ValueError(
                f"{self.controls} controls of {m} inputs, {self.measurements} measurements of {p} outputs: "
                "at least one of each kind must remain for w and z"
            )
        if self.system.period_s is not None:
            raise ValueError("a continuous plant is expected; map a sampled one with the bilinear transform")

    @property
    def w(self) -> slice:
        """Columns of the exogenous inputs."""
        return slice(0, self.system.D.shape[1] - self.controls)

    @property
    def u(self) -> slice:
        """Columns of the controls."""
        return slice(self.system.D.shape[1] - self.controls, None)

    @property
    def z(self) -> slice:
        """Rows of the errors."""
        return slice(0, self.system.D.shape[0] - self.measurements)

    @property
    def y(self) -> slice:
        """Rows of the measurements."""
        return slice(self.system.D.shape[0] - self.measurements, None)


@dataclass(frozen=True, slots=True, eq=False)
class NormalPlant:
    """The plant with D12 = [0; I], D21 = [0 I], D22 = 0, and time scaled; with the way back.

    K = left K_normal right, closed over D22, in the time of ``rate_rad_s``.
    """

    A: Array
    B1: Array
    B2: Array
    C1: Array
    C2: Array
    D11: Array
    left: Array
    right: Array
    D22: Array
    rate_rad_s: float


def normal_form(plant: GeneralisedPlant) -> NormalPlant:
    """Return the normal form of a regular ``plant``. Raises SingularPlant, which names the assumption.

    Time is scaled to the geometric mean of the modes, and states are balanced; w, z, u and y keep their
    sizes, because the norm is theirs.
    """
    system, rate = _scaled(plant)
    D = system.D
    D12, D21, D22 = D[plant.z, plant.u], D[plant.y, plant.w], D[plant.y, plant.u]
    (U, sigma, Vt), (U2, sigma2, Vt2) = np.linalg.svd(D12), np.linalg.svd(D21)
    _check_direct_gains(_rank(D12, sigma), _rank(D21, sigma2), plant)
    m2, p2 = plant.controls, plant.measurements
    rotate_z = np.vstack([U[:, m2:].T, U[:, :m2].T])
    scale_u = Vt.T / sigma
    rotate_w = np.hstack([Vt2[p2:].T, Vt2[:p2].T])
    scale_y = U2.T / sigma2[:, None]
    normal = NormalPlant(
        A=system.A,
        B1=system.B[:, plant.w] @ rotate_w,
        B2=system.B[:, plant.u] @ scale_u,
        C1=rotate_z @ system.C[plant.z],
        C2=scale_y @ system.C[plant.y],
        D11=rotate_z @ D[plant.z, plant.w] @ rotate_w,
        left=scale_u,
        right=scale_y,
        D22=D22,
        rate_rad_s=rate,
    )
    _check_modes(system, plant, rate)
    _check_axis(normal)
    return normal


def _scaled(plant: GeneralisedPlant) -> tuple[StateSpace, float]:
    system = plant.system
    rates = np.abs(system.poles())
    rates = rates[rates > rates.max(initial=0.0) * 1e-14]
    rate = float(2.0 ** np.round(np.mean(np.log2(rates)))) if len(rates) else 1.0
    return balanced(StateSpace(system.A / rate, system.B / rate, system.C, system.D)), rate


def _rank(matrix: Array, sigma: Array) -> int:
    """Return the rank: the number of singular values above rounding."""
    return int(np.sum(sigma > sigma[0] * max(matrix.shape) * np.finfo(float).eps))


def _check_direct_gains(rank_D12: int, rank_D21: int, plant: GeneralisedPlant) -> None:
    if rank_D12 < plant.controls:
        raise SingularPlant(
            "A2",
            f"D12 has rank {rank_D12}, {plant.controls} is needed: a control reaches no error at once",
            "give every control a weight that does not vanish at high frequency (w2 with a direct gain)",
        )
    if rank_D21 < plant.measurements:
        raise SingularPlant(
            "A2",
            f"D21 has rank {rank_D21}, {plant.measurements} is needed: a measurement has none at once",
            "let the reference or a small measurement noise enter every measurement directly",
        )


def _deficient(matrix: Array) -> bool:
    """Return True if a wide matrix lacks full row rank, each row measured by its own size."""
    size = np.linalg.norm(matrix, axis=1)
    if np.any(size == 0.0):
        return True
    values = np.linalg.svd(matrix / size[:, None], compute_uv=False)
    return bool(values[-1] <= _RANK * values[0]) if matrix.shape[1] >= matrix.shape[0] else True


def _check_modes(system: StateSpace, plant: GeneralisedPlant, rate: float) -> None:
    """Check A1 by the test of Popov, Belevitch and Hautus at every mode that does not decay by itself."""
    A = system.A
    values, errors = _modes(A)
    for value in values[values.real >= -errors]:
        pencil = A - value * np.eye(len(A))
        mode = f"the mode at s = {_text(value * rate)} 1/s"
        if _deficient(np.hstack([pencil, system.B[:, plant.u]])):
            raise SingularPlant(
                "A1",
                f"(A, B2) is not stabilisable: no control moves {mode}",
                "a weight outside of the loop must be stable: move an integrator to a slow pole; "
                "an unstable plant needs an actuator on that mode",
            )
        if _deficient(np.hstack([pencil.T, system.C[plant.y].T])):
            raise SingularPlant(
                "A1",
                f"(A, C2) is not detectable: no measurement shows {mode}",
                "a weight outside of the loop must be stable: move an integrator to a slow pole; "
                "an unstable plant needs a sensor on that mode",
            )


def _check_axis(normal: NormalPlant) -> None:
    """Check A3 and A4: no invariant zero of P12 or P21 on the imaginary axis; infinity is A2's."""
    m2, p2 = normal.B2.shape[1], normal.C2.shape[0]
    free_z, direct_z = normal.C1[:-m2], normal.C1[-m2:]
    free_w, direct_w = normal.B1[:, :-p2], normal.B1[:, -p2:]
    value = _hidden_on_axis(normal.A - normal.B2 @ direct_z, free_z)
    if value is not None:
        raise SingularPlant(
            "A3",
            f"[A - jwI, B2; C1, D12] loses column rank at w = {value * normal.rate_rad_s:.6g} rad/s: "
            "the errors do not see that motion",
            "weigh it: move a zero or pole of the plant or of a weight off the axis by a small real part",
        )
    value = _hidden_on_axis((normal.A - direct_w @ normal.C2).T, free_w.T)
    if value is not None:
        raise SingularPlant(
            "A4",
            f"[A - jwI, B1; C2, D21] loses row rank at w = {value * normal.rate_rad_s:.6g} rad/s: "
            "the disturbances do not excite that motion",
            "let a disturbance enter there, or give an integrator of a weight or plant a small real part",
        )


def _modes(A: Array) -> tuple[ComplexArray, Array]:
    """Return the eigenvalues of A, (n,), and how far each may move when every entry of A is off by
    ``_ROUNDED``.

    |y|' |A| |x| / |y' x| with its eigenvectors: small for a slow mode that stands apart from the fast ones,
    however fast these are, and large for one that is defective.
    """
    if not len(A):
        return np.zeros(0, dtype=complex), np.zeros(0)
    real, imaginary, left, right, failed = lapack.dgeev(A)
    if failed:
        raise np.linalg.LinAlgError("the eigenvalues did not converge")
    if imaginary.any():
        left, right = (_complex_columns(vectors, imaginary) for vectors in (left, right))
    spread = (np.abs(left) * (np.abs(A) @ np.abs(right))).sum(axis=0)
    across = np.abs((left.conj() * right).sum(axis=0))
    values = real + 1j * imaginary
    return values, _ROUNDED * spread / np.maximum(across, 1e-30)


def _complex_columns(vectors: Array, imaginary: Array) -> ComplexArray:
    """Join the real and imaginary columns in which LAPACK keeps a pair's eigenvector."""
    columns, pair = vectors.astype(complex), np.flatnonzero(imaginary > 0.0)
    columns[:, pair] += 1j * vectors[:, pair + 1]
    columns[:, pair + 1] = columns[:, pair].conj()
    return columns


def _hidden_on_axis(A: Array, C: Array) -> float | None:
    """Return |w| of a mode of A on the imaginary axis that C does not show, or None."""
    values, errors = _modes(A)
    for value in values[np.abs(values.real) <= errors]:
        if _deficient(np.hstack([(A - 1j * value.imag * np.eye(len(A))).T, C.T])):
            return float(abs(value.imag))
    return None


def _text(value: complex) -> str:
    return f"{value.real:.6g}" if value.imag == 0.0 else f"{value.real:.6g}{value.imag:+.6g}j"


@dataclass(frozen=True, slots=True)
class Weight:
    """high (s + zero)/(s + pole); rates in rad/s. A constant has zero = pole."""

    high: float
    zero_rad_s: float
    pole_rad_s: float

    def __post_init__(self) -> None:
        """Error: ValueError, naming the assumption that it breaks, for a weight out of its range."""
        shown = f"{self.high:g} (s + {self.zero_rad_s:g})/(s + {self.pole_rad_s:g})"
        if not self.high > 0.0:
            raise ValueError(
                f"weight {shown} breaks A2: it vanishes at high frequency, so that nothing is weighed there "
                "(D12 of w2 is 0); give it a gain above 0 there"
            )
        if not self.pole_rad_s > 0.0:
            raise ValueError(
                f"weight {shown} breaks A1: it is not stable, and nothing in the loop can stabilise it; give "
                "it a pole above 0 rad/s, for an integrator a slow one (static error above 0)"
            )
        if not self.zero_rad_s > 0.0:
            raise ValueError(
                f"weight {shown} breaks A3: it has a zero at or beyond the imaginary axis, where it weighs "
                "nothing; give it a zero above 0 rad/s"
            )

    @property
    def low(self) -> float:
        """Gain at rest."""
        return self.high * self.zero_rad_s / self.pole_rad_s

    @property
    def system(self) -> StateSpace:
        """The weight as a system with one state."""
        return first_order(self.high, self.zero_rad_s, self.pole_rad_s)

    def gain(self, omega: float) -> float:
        """Return |w(j omega)|."""
        return self.high * math.hypot(omega, self.zero_rad_s) / math.hypot(omega, self.pole_rad_s)


@dataclass(frozen=True, slots=True)
class Weights:
    """w1 on the error, w2 on the voltage (1/V per A), w3 on the current: Fig. 6."""

    error: Weight
    control: Weight
    output: Weight

    @property
    def by_function(self) -> dict[str, Weight]:
        """The weights by the closed-loop function that each applies to: S, K S or T."""
        return {"S": self.error, "KS": self.control, "T": self.output}


def crossing_weight(low: float, high: float, crossing_rad_s: float) -> Weight:
    """Return the weight with these gains at the ends and |w| = 1 at ``crossing_rad_s``.

    Error: ValueError unless 1 lies between ``low`` and ``high`` and the crossing is above 0.
    """
    if high <= 0.0:
        raise ValueError(
            f"gain {high:g} at high frequency breaks A2: nothing is weighed there (D12 of w2 is 0); give it "
            "a gain above 0"
        )
    if not (min(low, high) < 1.0 < max(low, high) and min(low, high) > 0.0 and crossing_rad_s > 0.0):
        raise ValueError(
            f"gains {low:g} and {high:g} with a crossing at {crossing_rad_s:g} rad/s: "
            "one gain below 1, the other above, and a crossing above 0 expected"
        )
    pole = crossing_rad_s * math.sqrt((1.0 - high**2) / (low**2 - 1.0))
    return Weight(high, pole * low / high, pole)


def slope_weight(low: float, high: float, slope_end_rad_s: float) -> Weight:
    """Return the weight with these gains whose slope ends at ``slope_end_rad_s``.

    That is the zero of a weight falling from ``low`` to ``high``; of a rising one the slope's start is the
    zero too. Error: ValueError for a gain or rate not above 0.
    """
    if not (low > 0.0 and slope_end_rad_s > 0.0):
        raise ValueError(f"gain {low:g} at rest, slope end {slope_end_rad_s:g}: both above 0 expected (A3)")
    return Weight(high, slope_end_rad_s, slope_end_rad_s * high / low)


def error_weight(crossing_rad_s: float, peak: float, static_error: float) -> Weight:
    """Return w1: 1/|w1| crosses 1 at ``crossing_rad_s``, ends at ``peak`` and starts at ``static_error``."""
    if static_error <= 0.0:
        raise ValueError(
            f"static error {static_error:g} breaks A1: w1 would be an integrator, which nothing in the loop "
            "can stabilise; ask for a small one above 0, 1e-4 say"
        )
    return crossing_weight(1.0 / static_error, 1.0 / peak, crossing_rad_s)


def axis_plant(resistance_ohm: float, inductance_h: float) -> StateSpace:
    """Return G = 1/(r + s L), A per V, (33), (34); the state is that of (50), i L."""
    return state_space([[-resistance_ohm / inductance_h]], [[1.0]], [[1.0 / inductance_h]], [[0.0]])


def mixed_sensitivity(G: StateSpace, weights: Weights) -> GeneralisedPlant:
    """Return the plant (2) with the states [G, w1, w2, w3] of (55); w = i_ref, u = v."""
    w1, w2, w3 = (weight.system for weight in weights.by_function.values())
    parts = append(G, w1, w2, w3)
    # inputs of the parts: v, e, u, i; outputs: i, e1, e2, e3; outside: [i_ref, u]
    feedback = np.zeros((4, 4))
    feedback[1, 0], feedback[3, 0] = -1.0, 1.0
    enter = np.array([[0.0, 1.0], [1.0, 0.0], [0.0, 1.0], [0.0, 0.0]])
    leave = np.vstack([np.eye(4)[1:], -np.eye(4)[:1]])
    system = connect(parts, feedback, enter, leave)
    D = system.D.copy()
    D[-1, 0] = 1.0
    return GeneralisedPlant(StateSpace(system.A, system.B, system.C, D), controls=1, measurements=1)


def loop_functions(G: StateSpace, K: StateSpace, frequency_rad_s: Array) -> dict[str, Array]:
    """Return |S|, |KS| and |T| at the k frequencies, each (k,)."""
    g = G.response(frequency_rad_s)[:, 0, 0]
    k = K.response(frequency_rad_s)[:, 0, 0]
    S = 1.0 / (1.0 + g * k)
    return {"S": np.abs(S), "KS": np.abs(k * S), "T": np.abs(g * k * S)}
