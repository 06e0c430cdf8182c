"""A linear loop with one constant delay in its feedback, and its characteristic function.

    x'(t) = A x(t) + B K x(t - eta) + E d(t)        z(t) = C x(t)

with one control input and one disturbance, [Ling2012] (2.15). Its transfer function from d to z is
a ratio of quasi-polynomials, which are found once, without forming matrix inverses:

    G(s) = n(s)/q(s),   q(s) = det(s I - A - B K e^{-s eta}) = a(s) - b(s) e^{-s eta}

Time is counted in ``time_unit_s`` inside the quasi-polynomials, so that their coefficients are of
like size whatever the plant's rates.

The speed loop of a field-oriented PMSM in error coordinates, [Ling2012] (2.5), (2.6) and (2.15).

    x = [i_q* - i_q, omega* - omega]        x' = A x + B1 u + B2 d        z = C x = e
    A = [-a, 0; K_t/J, -B_0/J]   B1 = [a, 0]'   B2 = [0, 1/J]'   u = K x(t - eta)

a is the rate of the drive's current loop, of first order: its PI cancels the pole of the winding. The
paper has a drive without one, whose current follows the voltage with R/L. K_t is the torque per q-axis
ampere at i_d = 0. With integral action the state is [e_q, e, integral of e] and
K = [K1 (A/A), K2 (A s/rad), K3 (A/rad)].

Behind a coupling (:mod:`servobench.design.mechanism`) two states more stand at the end, speed error of the
other side and twist; K feeds neither back, the load torque acts on the load, e is of the encoder's side.
"""

import math
from dataclasses import dataclass
from enum import Enum
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from servobench.design.mechanism import Coupling, Side
from servobench.design.motor import PmsmParameters

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class DelayLoop:
    """The loop above: A (n, n), B, K, E and C (n,), delay eta in s."""

    A: Array
    B: Array
    K: Array
    E: Array
    C: Array
    delay_s: float

    def __post_init__(self) -> None:
        n = len(self.A)
        if self.A.shape != (n, n) or any(v.shape != (n,) for v in (self.B, self.K, self.E, self.C)):
            raise ValueError(f"A is {self.A.shape}; B, K, E and C must be vectors of its size")
        if not (self.delay_s >= 0.0 and np.isfinite(self.delay_s)):
            raise ValueError(f"a delay of {self.delay_s} s")

    @property
    def BK(self) -> Array:
        """Matrix of the delayed state, (n, n)."""
        return np.outer(self.B, self.K)


@dataclass(frozen=True, slots=True, eq=False)
class QuasiPolynomial:
    """p(s) - r(s) e^{-s delay}; coefficients in ascending powers of s, (n + 1,) each."""

    plain: Array
    delayed: Array


@dataclass(frozen=True, slots=True, eq=False)
class LoopFunction:
    """G = numerator/denominator of a :class:`DelayLoop`, with time counted in ``time_unit_s``.

    ``delay``: the loop's delay in that unit. The denominator's plain part is monic of degree n.
    """

    numerator: QuasiPolynomial
    denominator: QuasiPolynomial
    delay: float
    time_unit_s: float

    def magnitude(self, w: Array) -> Array:
        """Return |G(j w)| at the frequencies ``w`` in rad per time unit."""
        s = np.asarray(1j * w, dtype=np.complex128)
        parts = [each for part in (self.numerator, self.denominator) for each in (part.plain, part.delayed)]
        coefficients = np.array(parts).reshape(2, 2, -1, *[1] * s.ndim)
        values = np.zeros((2, 2, *s.shape), dtype=np.complex128)
        for place in range(coefficients.shape[2] - 1, -1, -1):
            values = values * s + coefficients[:, :, place]
        n, q = values[:, 0] - np.exp(-s * self.delay) * values[:, 1]
        return np.asarray(np.abs(n / q))


def _resolvent(M: Array) -> tuple[Array, Array]:
    """Return det(s I - M), (m, n + 1), and adj(s I - M), (n, m, n, n), ascending, for each of M (m, n, n).

    By the recursion of Faddeev and LeVerrier, exact up to rounding for small n.
    """
    n = M.shape[-1]
    determinant, adjugate = np.ones((len(M), n + 1)), np.zeros((n, *M.shape))
    N = np.broadcast_to(np.eye(n), M.shape)
    for k in range(1, n + 1):
        adjugate[n - k] = N
        MN = M @ N
        determinant[:, n - k] = -np.trace(MN, axis1=1, axis2=2) / k
        N = MN + determinant[:, n - k, None, None] * np.eye(n)
    return determinant, adjugate


def loop_function(loop: DelayLoop, unit_s: float | None = None) -> LoopFunction:
    """Return the transfer function from d to z as quasi-polynomials; ``unit_s``: unit of time, if not the
    loop's own.

    q = det(s I - A) - K adj(s I - A) B e^{-s eta} is affine in e^{-s eta} because the feedback has rank one,
    and so is n = C adj(s I - A - B K e^{-s eta}) E: its value without delay gives the delayed part.
    """
    n = len(loop.A)
    determinant, adjugate = _resolvent(np.stack([loop.A, loop.A + loop.BK]))
    unit = unit_s or _time_unit_s(determinant, loop.delay_s)
    scale = unit ** np.arange(n, -1.0, -1.0)
    numerator = np.vstack([adjugate @ loop.E @ loop.C, np.zeros(2)]) * scale[:, None]
    returned = np.append(adjugate[:, 0] @ loop.B @ loop.K, 0.0) * scale
    return LoopFunction(
        QuasiPolynomial(numerator[:, 0], numerator[:, 0] - numerator[:, 1]),
        QuasiPolynomial(determinant[0] * scale, returned),
        loop.delay_s / unit,
        unit,
    )


def _time_unit_s(determinant: Array, delay_s: float) -> float:
    """Return the delay; the inverse of the fastest rate, within a small factor, where that is slower.

    ``determinant``: (m, n + 1) characteristic polynomials.
    """
    n = determinant.shape[1] - 1
    rate = float(np.max(np.abs(determinant[:, :n]) ** (1.0 / np.arange(n, 0.0, -1.0)), initial=0.0))
    return max(1.0 / rate if rate > 0.0 else 1.0, delay_s)


RAD_S_PER_RPM = math.tau / 60.0


class Units(Enum):
    """Conversion of a demand in percent of the speed into a gain of the model, whose speed is in rad/s."""

    SI = "si"
    """The speed is in rad/s throughout."""
    PUBLISHED = "published"
    """[Ling2012] (5.1): the gain is worked out in r/min per N m and then used as rad/s per N m."""


class Feedback(Enum):
    """States that the gain may use."""

    FULL = "full"
    SPEED = "speed"
    """Speed only, K1 = 0 (and its integral, where there is one)."""


@dataclass(frozen=True, slots=True, eq=False)
class SpeedModel:
    """The open loop above: A (n, n), B1, B2, C (n,); n = 2, or 3 with the integral of the speed error, and
    two more behind a coupling."""

    A: Array
    B1: Array
    B2: Array
    C: Array
    state_scale: Array
    """Size of each state at a speed error of 1 rad/s, for scaling only."""
    rigid: "SpeedModel | None" = None
    """The same without its coupling; None: it has none."""

    @property
    def gains(self) -> int:
        """How many states are fed back."""
        return len(self.A if self.rigid is None else self.rigid.A)

    @property
    def has_integral(self) -> bool:
        """True if the integral of the speed error is a state."""
        return self.gains == 3

    def whole(self, K: ArrayLike) -> Array:
        """Return the gains of all states, (n,): none for those behind a coupling."""
        given = np.asarray(K, dtype=float)
        return np.concatenate([given, np.zeros(len(self.A) - len(given))])

    def loop(self, K: ArrayLike, delay_s: float) -> DelayLoop:
        """Return the loop closed by u = K x(t - delay), from load torque (N m) to speed error (rad/s)."""
        return DelayLoop(self.A, self.B1, self.whole(K), self.B2, self.C, delay_s)

    def free_gains(self, feedback: Feedback) -> list[int]:
        """Return the indices of the entries of K that a design chooses; K3 follows K2 by the integral
        time."""
        return [0, 1] if feedback is Feedback.FULL else [1]

    def with_entries(self, K: Array, free: ArrayLike, entries: ArrayLike) -> Array:
        """Return K with other ``entries`` at the indices ``free``, its integral time K2/K3 unchanged."""
        changed = K.copy()
        changed[np.asarray(free)] = entries
        if self.has_integral:
            changed[2] = K[2] * changed[1] / K[1]
        return np.asarray(changed)

    @property
    def without_integral(self) -> "SpeedModel":
        """The model without that state."""
        if self.rigid is not None:
            kept = [0, 1, *range(self.gains, len(self.A))]
            B1, B2, C, scale = (each[kept] for each in (self.B1, self.B2, self.C, self.state_scale))
            return SpeedModel(self.A[np.ix_(kept, kept)], B1, B2, C, scale, self.rigid.without_integral)
        return SpeedModel(self.A[:2, :2], self.B1[:2], self.B2[:2], self.C[:2], self.state_scale[:2])

    def integral_time_s(self, delay_s: float) -> float:
        """Return the default integral time K2/K3 of a design.

        The norm alone would make the integral vanish: it only demands small errors, at whatever frequency.
        Four times the lags of the loop, its delay and its current loop, is the ratio of the symmetric
        optimum.
        """
        return 4.0 * (delay_s - 1.0 / float(self.A[0, 0]))


def current_rate_rad_s(motor: PmsmParameters, current_bandwidth_hz: float | None) -> float:
    """Return a: the rate of a current loop of that bandwidth; None: of the winding alone, R/L, as in
    [Ling2012]."""
    if current_bandwidth_hz is None:
        return motor.resistance_ohm / motor.inductance_q_h
    return math.tau * current_bandwidth_hz


def speed_model(
    motor: PmsmParameters, integral: bool = False, current_bandwidth_hz: float | None = None
) -> SpeedModel:
    """Return the model of ``motor``, with the integral of the speed error as third state if ``integral``.

    ``current_bandwidth_hz``: bandwidth of the drive's current loop; None: the winding's own, R/L, as in
    [Ling2012].
    """
    rigid = model_of(
        current_rate_rad_s(motor, current_bandwidth_hz),
        motor.torque_constant_nm_a,
        motor.inertia_kg_m2,
        motor.viscous_friction_nm_s,
        integral=integral,
    )
    mechanism = motor.mechanism
    if mechanism is None or mechanism.coupling is None:
        return rigid
    on_load = mechanism.friction is not None and mechanism.friction.side is Side.LOAD
    return behind_coupling(rigid, motor, mechanism.coupling, on_load)


def behind_coupling(
    rigid: SpeedModel, motor: PmsmParameters, coupling: Coupling, friction_on_load: bool = False
) -> SpeedModel:
    """Return the model of a shaft that twists; ``friction_on_load``: the viscous friction is there."""
    k, d, m, j = (
        coupling.stiffness_nm_rad,
        coupling.damping_nm_s,
        coupling.motor_kg_m2,
        coupling.load_kg_m2,
    )
    n, B = len(rigid.A), motor.viscous_friction_nm_s
    # The side that is fed back stands where a rigid shaft has its speed.
    turned, load = (n, 1) if coupling.encoder is Side.LOAD else (1, n)
    twist, rubbed = n + 1, load if friction_on_load else turned
    A = np.zeros((n + 2, n + 2))
    A[:n, :n] = rigid.A
    A[1] = 0.0
    A[turned, 0] = motor.torque_constant_nm_a / m
    for row, sign, inertia in ((turned, -1.0, m), (load, 1.0, j)):
        A[row, [turned, load, twist]] = sign * np.array([d, -d, k]) / inertia
    A[rubbed, rubbed] -= B / (j if friction_on_load else m)
    A[twist, [turned, load]] = 1.0, -1.0
    B2 = np.zeros(n + 2)
    B2[load] = 1.0 / j
    C = np.append(rigid.C, [0.0, 0.0])
    scale = np.append(rigid.state_scale, [1.0, 1.0 / (math.tau * coupling.resonance_hz)])
    return SpeedModel(A, np.append(rigid.B1, [0.0, 0.0]), B2, C, scale, rigid)


def model_of(
    rate_rad_s: float,
    torque_constant_nm_a: float,
    inertia_kg_m2: float,
    viscous_friction_nm_s: float,
    *,
    integral: bool,
) -> SpeedModel:
    """Return the model of these: a, K_t, J and B_0."""
    J = inertia_kg_m2
    A = np.array([[-rate_rad_s, 0.0], [torque_constant_nm_a / J, -viscous_friction_nm_s / J]])
    B1, B2, C = np.array([rate_rad_s, 0.0]), np.array([0.0, 1.0 / J]), np.array([0.0, 1.0])
    scale = np.array([0.05, 1.0])
    if integral:
        A = np.block([[A, np.zeros((2, 1))], [np.array([[0.0, 1.0, 0.0]])]])
        B1, B2, C = (np.append(v, 0.0) for v in (B1, B2, C))
        scale = np.append(scale, 0.05)
    return SpeedModel(A, B1, B2, C, scale)


def gain_for_error(
    error_percent: float, load_nm: float, speed_rad_s: float, units: Units = Units.SI
) -> float:
    """Return the gain, rad/s per N m, that keeps the error of ``load_nm`` within ``error_percent`` of the
    speed.

    [Ling2012] Definition 3.4 with ``load_nm`` the part of the nominal load that disturbs.
    """
    gain = error_percent / 100.0 * speed_rad_s / load_nm
    return gain if units is Units.SI else gain / RAD_S_PER_RPM


def percent_of_speed(gain: float, load_nm: float, speed_rad_s: float) -> float:
    """Invert :func:`gain_for_error`."""
    return gain / gain_for_error(1.0, load_nm, speed_rad_s)


_FLOOR_STEPS: Final = 200
"""Of the delay: a swing of 500 Hz within 20 ms is met to 1 % of its height."""


def peak_floor_rad_s(motor: PmsmParameters, delay_s: float) -> float:
    """Return the least peak speed deviation after a load step of 1 N m with any controller, rad/s per N m.

    Nothing acts before the delay has passed: until then inertia and friction alone meet the load,
    J omega' = -B_0 omega - 1. Behind a coupling so do both masses, and the error is of the encoder's side.
    """
    model = speed_model(motor)
    if model.rigid is not None:
        from scipy.linalg import expm  # an extra, that a run does without

        n = len(model.A)
        stepped = np.zeros((n + 1, n + 1))
        stepped[:n, :n], stepped[:n, n] = model.A, model.B2
        step = expm(stepped * delay_s / _FLOOR_STEPS)
        x, largest = np.append(np.zeros(n), 1.0), 0.0
        for _ in range(_FLOOR_STEPS):
            x = step @ x
            largest = max(largest, abs(float(model.C @ x[:n])))
        return largest
    B, J = motor.viscous_friction_nm_s, motor.inertia_kg_m2
    return delay_s / J if B == 0.0 else -math.expm1(-B * delay_s / J) / B
