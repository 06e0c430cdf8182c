"""H-infinity output feedback of the speed: the sampled plant with its delay as states, its weights, a design.

    x+ = Phi x + Gamma_b c_(m+1) + Gamma_a c_m + Gamma_d d      c_1+ = u, c_2+ = c_1 ..      tau = m h + r
    q+ = q + (1 - e^(-omega_i h)) (w + nu n)                    y = q + w + nu n

x = [T, omega, w] of the predictor's plant; Gamma_b and Gamma_a: of the command in force for the first r of a
period and of its successor; c_0 is u. q: whatever controller is found for y, the speed error is integrated.

    from  d   load torque, N m                to  z1 = sigma y      the speed error and its integral
          n   noise on a sample               z2 = W u              W >= what the loop's uncertainty can be

d to z2 is W T but for current loop and delay, T the complementary sensitivity: where |W T| < 1 every inertia
within +-30 % and every delay within the margin leave the loop stable. The synthesis is that of continuous
plants, in the bilinear plane, where the norm is the same.
"""

import math
from dataclasses import dataclass

import numpy as np

from design.delay.delay_loop import Array
from design.hinf.bilinear import from_bilinear, to_bilinear
from design.hinf.plant import GeneralisedPlant
from design.hinf.synthesis import gamma_min, synthesise, verified_norm
from design.hinf.weights import Weight, crossing_weight
from design.speed.plant_loop import SHAFT, split
from design.speed.predictor_design import PredictorRequest
from design.speed.predictor_plant import FILTERED, LOAD
from design.statespace import StateSpace, balanced, series, state_space

_INERTIA_LEAST = 0.7
_UNCERTAIN_AT_REST = 1.0 / _INERTIA_LEAST - 1.0
"""Of the plant, by the least inertia."""
_UNCERTAIN_AT_MOST = 3.5
_TURN = 0.74
"""Of a radian, by the longest delay, where W is 1. The uncertainty |e^(-j phi)/0.7 - 1| is 1 at 0.78 and 2.43
at most; this weight of first order lies above it everywhere."""
_ABOVE_LEAST = 1.05
"""Times the least gamma: there the central controller has no poles that race away."""
_GAMMA_RELATIVE = 1e-3


@dataclass(frozen=True, slots=True)
class HinfWeights:
    """What the search is over."""

    error: float
    """sigma, per rad/s, with loads of 1 N m."""
    noise_rad_s: float
    """nu, of a sample."""
    integral_rad_s: float
    """omega_i."""


def uncertainty(request: PredictorRequest) -> Weight:
    """W: at every frequency above |e^(-j omega delay) /0.7 - 1| for the delays up to the margin."""
    crossing = _TURN / request.delay_margin_s
    return crossing_weight(_UNCERTAIN_AT_REST, _UNCERTAIN_AT_MOST, crossing)


def sampled_uncertainty(request: PredictorRequest) -> StateSpace:
    """W by Tustin's rule, which moves it down in frequency: so it still covers."""
    return from_bilinear(uncertainty(request).system, request.period_s)


def integral_of(request: PredictorRequest, weights: HinfWeights) -> StateSpace:
    """From the measured speed to y."""
    lead = -math.expm1(-weights.integral_rad_s * request.period_s)
    return state_space([[1.0]], [[lead]], [[1.0]], [[1.0]], request.period_s)


def generalised(request: PredictorRequest, weights: HinfWeights) -> StateSpace:
    """From [d, n, u] to [z1, z2, y]; states [x, c_1 .., q, that of W]."""
    shaft, W, q = shaft_of(request), sampled_uncertainty(request), integral_of(request, weights)
    n = shaft.order
    A, B = np.zeros((n + 2, n + 2)), np.zeros((n + 2, 3))
    A[:n, :n], A[n, :n], A[n, n], A[-1, -1] = shaft.A, q.B @ shaft.C, 1.0, W.A[0, 0]
    B[:n, [0, 2]], B[n, 1], B[-1, 2] = shaft.B, q.B[0, 0] * weights.noise_rad_s, W.B[0, 0]
    y = np.concatenate([shaft.C[0], [1.0, 0.0]])
    C = np.vstack([weights.error * y, np.append(np.zeros(n + 1), W.C[0, 0]), y])
    D = np.zeros((3, 3))
    D[0, 1], D[1, 2], D[2, 1] = weights.error * weights.noise_rad_s, W.D[0, 0], weights.noise_rad_s
    return StateSpace(A, B, C, D, request.period_s)


def shaft_of(request: PredictorRequest) -> StateSpace:
    """From [d, u] to the measured speed; states [x, c_1 .. c_(m+1)]. d is held over a period."""
    h, plant = request.period_s, request.plant
    whole, rest_s = split(request.delay_s, h)
    (_, before), (later, after) = plant.step(rest_s), plant.step(h - rest_s)
    full = plant.step(h)[0]
    n = SHAFT + whole + 1
    A, B, C = np.zeros((n, n)), np.zeros((n, 2)), np.zeros((1, n))
    A[:SHAFT, :SHAFT] = full[:SHAFT, :SHAFT]
    A[:SHAFT, -1] = (later @ before)[:SHAFT]
    A[SHAFT + 1 :, SHAFT:-1] = np.eye(whole)
    B[:SHAFT, 0], B[SHAFT, 1], C[0, FILTERED] = full[:SHAFT, LOAD], 1.0, 1.0
    if whole:
        A[:SHAFT, -2] = after[:SHAFT]
    else:
        B[:SHAFT, 1] = after[:SHAFT]
    return StateSpace(A, B, C, np.zeros((1, 2)), h)


@dataclass(frozen=True, slots=True, eq=False)
class HinfController:
    """u = K e with e the speed error, as found."""

    K: StateSpace
    gamma: float
    """Norm from [d, n] to [z1, z2], of the loop that is closed, as ``verified_norm`` computes it."""
    gamma_min: float
    """The least that any controller reaches."""


def design_controller(request: PredictorRequest, weights: HinfWeights) -> HinfController:
    """The central controller. Raises SingularPlant or InfeasibleDesign."""
    sampled = balanced(generalised(request, weights))
    plant = GeneralisedPlant(to_bilinear(sampled), controls=1, measurements=1)
    least = gamma_min(plant, _GAMMA_RELATIVE)
    central = synthesise(plant, _ABOVE_LEAST * least).controller
    K = series(from_bilinear(central, request.period_s), integral_of(request, weights)).scaled(-1.0)
    return HinfController(K, verified_norm(plant, central), least)


def weighted_norms(request: PredictorRequest, K: StateSpace, frequency_rad_s: Array) -> Array:
    """(k,) |W T| at the k frequencies, T of the loop cut at the command."""
    loop = shaft_of(request).part(slice(0, 1), slice(1, 2)).response(frequency_rad_s)[:, 0, 0]
    loop = loop * K.response(frequency_rad_s)[:, 0, 0]
    W = sampled_uncertainty(request).response(frequency_rad_s)[:, 0, 0]
    return np.asarray(np.abs(W * loop / (1.0 + loop)), dtype=float)
