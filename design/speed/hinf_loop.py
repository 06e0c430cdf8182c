"""A conditioned controller's loop as it runs: sampled, held, with a delay that is no whole period.

    xi = [T, omega, w | u in force | b_1 .. b_n | x_c]        b_1: the newest command, b_2 the one before ...

A sample is taken: its command is b_1, and the controller advances. r into the period the command of m periods
ago begins to act, tau = m h + r. The plant may be another than that of the design, and so may its delay.

A sampled controller that receives the command sent: coprime factors, and their reduction.

    K = (A, B, C, D):      x+ = A x + B e + L (u_sent - C x - D e)      u = C x + D e

If the command is sent unchanged it is K. If a limit clips it the states follow the value sent, with A - L C:
L is that of the normalised left coprime factors, so this is stable whether K is or not (Vidyasagar, Control
System Synthesis, 1985; Hanus, Kinnaert, Henrotte, Automatica 23(6), 1987). These factors are truncated, as K
may have unstable poles.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.linalg

from servobench.design.delay.delay_loop import Array
from servobench.design.hinf.margins import Margins
from servobench.design.sampled.held_loop import Operation
from servobench.design.speed.plant_loop import INPUT, PlantLoop, split
from servobench.design.speed.predictor_loop import WITHIN
from servobench.design.speed.predictor_plant import FILTERED, LOAD, SPEED, PredictorPlant
from servobench.design.statespace import StateSpace

_MODES_APART = 1e8
"""Condition of the eigenvectors beyond which the states are left unchanged."""


@dataclass(frozen=True, slots=True, eq=False)
class Conditioned:
    """x+ = A x + B e + L u_sent,  u = C x + D e."""

    A: Array
    """(n, n)."""
    B: Array
    """(n,)."""
    L: Array
    """(n,)."""
    C: Array
    """(n,)."""
    D: float
    period_s: float

    @property
    def order(self) -> int:
        """Number of states."""
        return len(self.A)

    @property
    def K(self) -> StateSpace:
        """From e to u, if every command is sent unchanged."""
        A = self.A + np.outer(self.L, self.C)
        B = (self.B + self.L * self.D)[:, None]
        return StateSpace(A, B, self.C[None, :], np.array([[self.D]]), self.period_s)

    def _steady(self) -> "Conditioned":
        """Return the controller whose steady command needs no error: K integrates exactly."""
        gain = self.C @ np.linalg.solve(np.eye(self.order) - self.A, self.L)
        return Conditioned(self.A, self.B, self.L / gain, self.C, self.D, self.period_s)


def conditioned(K: StateSpace, error_size: float) -> Conditioned:
    """Make a conditioned controller. ``error_size``: an error equivalent to a command of 1, rad/s per N m."""
    assert K.period_s is not None
    B, C, D = K.B[:, 0] * error_size, K.C[0], float(K.D[0, 0]) * error_size
    R = np.array([[1.0 + D * D]])
    X = scipy.linalg.solve_discrete_are(K.A.T, C[:, None], np.outer(B, B), R, s=(B * D)[:, None])
    L = (K.A @ X @ C + B * D) / (1.0 + D * D + C @ X @ C)
    return Conditioned(
        K.A - np.outer(L, C), (B - L * D) / error_size, L, C, D / error_size, K.period_s
    )._steady()


def truncated(full: Conditioned, error_size: float) -> list[Conditioned]:
    """Return reductions to 2, 3 .. states, balanced, in modal states; ``error_size`` as in
    :func:`conditioned`."""
    B = np.stack([full.B * error_size, full.L], axis=1)
    R = _factor(full.A, B)
    S = _factor(full.A.T, full.C[:, None])
    U, sigma, Vt = np.linalg.svd(S.T @ R)
    shorter = []
    for order in range(2, full.order + 1):
        if sigma[order - 1] <= 1e-12 * sigma[0]:
            break
        root = np.sqrt(sigma[:order])
        V, W = R @ Vt[:order].T / root, S @ U[:, :order] / root
        part = Conditioned(W.T @ full.A @ V, W.T @ full.B, W.T @ full.L, full.C @ V, full.D, full.period_s)
        shorter.append(modal(part)._steady())
    return shorter


def _factor(A: Array, B: Array) -> Array:
    """Return (n, n) R with R R' = A R R' A' + B B'."""
    values, vectors = np.linalg.eigh(scipy.linalg.solve_discrete_lyapunov(A, B @ B.T))
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0)))


def modal(full: Conditioned) -> Conditioned:
    """Return the controller in states whose A has a number per real mode and a 2 by 2 per pair: few products
    a cycle."""
    values, vectors = np.linalg.eig(full.A)
    columns = []
    for value, vector in zip(values, vectors.T, strict=True):
        if value.imag > 0.0:
            columns += [vector.real, vector.imag]
        elif value.imag == 0.0:
            columns.append(vector.real)
    V = np.array(columns).T
    if np.linalg.cond(V) > _MODES_APART:
        return full
    A = np.linalg.solve(V, full.A @ V)
    A[np.abs(A) < 1e-9 * np.max(np.abs(A))] = 0.0
    return Conditioned(
        A, np.linalg.solve(V, full.B), np.linalg.solve(V, full.L), full.C @ V, full.D, full.period_s
    )


_BUFFER = INPUT + 1


class HinfLoop(PlantLoop):
    """The loop of ``controller`` around ``plant``, whose commands act ``delay_s`` after their samples."""

    def __init__(self, controller: Conditioned, plant: PredictorPlant, delay_s: float) -> None:
        self.controller = controller
        self.first_state = _BUFFER + split(delay_s, controller.period_s)[0] + 1
        """Place of x_c in xi."""
        size = self.first_state + controller.order
        super().__init__(plant, controller.period_s, delay_s, _BUFFER, size)

    def chain(self) -> list[Operation]:
        """Return a period that begins with a sample."""
        return self.period(self._sampled())

    def _sampled(self) -> Array:
        J, c, at = np.eye(self.size), self.controller, self.first_state
        J[_BUFFER:] = 0.0
        J[_BUFFER, FILTERED], J[_BUFFER, at:] = -c.D, c.C
        for place in range(_BUFFER + 1, at):
            J[place, place - 1] = 1.0
        J[at:, FILTERED], J[at:, at:] = -(c.B + c.L * c.D), c.A + np.outer(c.L, c.C)
        return J

    def spectral_radius(self) -> float:
        """Return the largest magnitude of a pole."""
        return float(np.max(np.abs(np.linalg.eigvals(self.transition(self.chain())))))

    def torque_noise_nm(self, speed_noise_rad_s: float) -> float:
        """Return the rms of the command caused by white noise on each sample; inf if unstable."""
        if self.spectral_radius() >= 1.0:
            return math.inf
        noise = self._sampled()[:, FILTERED] * speed_noise_rad_s
        noise[:_BUFFER] = 0.0
        return self.command_rms_nm(self.chain(), np.outer(noise, noise))

    def margins(self) -> Margins:
        """Return the margins of the loop cut where commands begin to act, between samples of the plant."""
        return self.margins_with(self.controller.K)

    def load_steps(self, load_nm: float, periods: int, phases: Sequence[float], lost: int = 0) -> Array:
        """Return (instants, phases) speeds of the shaft, four a period and where commands begin to act.

        From rest; the load comes a phase of a period after a sample. The first ``lost`` samples after it are
        lost, so that the last one before it is held.
        """
        h, c, behind, acts_s = self.period_s, self.controller, self.behind, self.acts_s
        x = np.zeros((LOAD + 1, len(phases)))
        for place, phase in enumerate(phases):
            x[:, place] = self.plant.step((1.0 - phase) * h)[0][:, LOAD] * load_nm
        state = np.zeros((c.order, len(phases)))
        sent = [np.zeros(len(phases))] * (behind + 2)
        instants = {h * (part + 1) / WITHIN for part in range(WITHIN)} | ({acts_s} if acts_s else set())
        looks = [self.plant.look(acts_s, at_s) for at_s in sorted(instants)]
        speeds = [x[SPEED]]
        for number in range(periods):
            error = np.zeros(len(phases)) if number < lost else -x[FILTERED]
            sent = [c.C @ state + c.D * error, *sent[:-1]]
            state = c.A @ state + np.outer(c.B, error) + np.outer(c.L, sent[0])
            ends = [
                first @ x + np.outer(held, sent[behind + 1]) + np.outer(entered, sent[behind])
                for first, held, entered in looks
            ]
            speeds += [end[SPEED] for end in ends]
            x = ends[-1]
        return np.array(speeds)
