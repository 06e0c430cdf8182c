"""The largest speed error after a load step in a loop that never switches: by simulation.

Where every period is the same step, each beginning of the load has one trajectory. Errors are evaluated at
instants of every period, for beginnings across one; between two instants, and between two beginnings, they
depart from their chords by bounded amounts, and both grow denser until these are small. The simulation ends
when what is left, in a norm that every further period diminishes, cannot change the result.
"""

import numpy as np
from scipy.linalg import cholesky, solve_discrete_lyapunov

from servobench.design.delay.delay_loop import Array
from servobench.design.errors import NoSolution
from servobench.design.sampled.admissible_steps import Family, families
from servobench.design.sampled.held_loop import HeldLoop
from servobench.design.sampled.peak_steps import (
    LoadedSteps,
    PeakBound,
    between_instants,
    first_states,
    loaded_steps,
    rest_under_load,
    start_curvature,
)
from servobench.design.sampled.step_maps import corners_of

_CLOSE = 3e-4
"""Share of the error by which the bound may lie above what is reached."""
_DENSEST = 512
_LEFT = 1e-5
"""Share of the error that may be left when the simulation ends."""
_PERIODS_MAX = 200_000


def only_step(loop: HeldLoop) -> Family | None:
    """Return the step of every period of a loop that never switches; None if the network leaves a choice."""
    steps = families(loop.network)
    fixed = len(steps) == 1 and all(window.first_s == window.last_s for window in steps[0].windows)
    return steps[0] if fixed else None


def unswitched_peak(loop: HeldLoop, step: Family) -> PeakBound:
    """Return the largest error, certified and reached, rad/s per N m. Raises NoSolution for an unstable
    loop."""
    parts = 32
    while True:
        bound = _simulated(loop, step, parts)
        if bound.certified <= (1.0 + _CLOSE) * bound.reached or parts >= _DENSEST:
            return bound
        parts *= 2


def _simulated(loop: HeldLoop, family: Family, parts: int) -> PeakBound:
    """Simulate with so many instants in a period, and beginnings of the load."""
    step = loaded_steps(loop, 0, 0, corners_of(loop, family, np.eye(loop.kept), np.inf), parts)
    M, n, rest = step.M[0], len(loop.model.A), rest_under_load(loop)
    bend = np.zeros(loop.kept)
    bend[:n] = (loop.network.period_s / parts) ** 2 / 8.0 * start_curvature(loop.model, loop.network.period_s)
    T, rows = _falling(M), step.rows
    sizes = float(np.linalg.norm(rows @ np.linalg.inv(T), axis=1).max())
    error = float(loop.model.C @ rest[:n])
    apart = first_states(loop, parts) - rest
    certified = reached = abs(error)
    for _ in range(_PERIODS_MAX):
        largest = float(np.abs(error + apart @ rows.T).max())
        reached = max(reached, largest)
        between = _between(loop, step, apart + rest, parts) + float((np.abs(rows) @ np.abs(bend)).max())
        certified = max(certified, largest + between)
        left = sizes * float(np.linalg.norm(apart @ T.T, axis=1).max() + np.linalg.norm(T @ bend))
        if abs(error) + left <= max(reached, (1.0 + _LEFT) * abs(error)):
            return PeakBound(max(certified, abs(error) + left), reached)
        apart, bend = apart @ M.T, M @ bend
    raise NoSolution("simulation of the load step", f"no rest within {_PERIODS_MAX} periods")


def _falling(M: Array) -> Array:
    """Return T with |T M y| < |T y| for every y. Raises NoSolution if M is unstable."""
    try:
        T = np.asarray(cholesky(solve_discrete_lyapunov(M.T, np.eye(len(M)))))
    except (np.linalg.LinAlgError, ValueError):
        raise NoSolution("simulation of the load step", "the loop is unstable") from None
    if not np.linalg.norm(T @ M @ np.linalg.inv(T), 2) < 1.0:
        raise NoSolution("simulation of the load step", "no norm falls in every period")
    return T


def _between(loop: HeldLoop, step: LoadedSteps, states: Array, parts: int) -> float:
    """Return how far the error of any of ``states`` may depart from its chords between the instants."""
    x = np.abs(states[:, : len(loop.model.A)]).max(axis=0)
    return between_instants(loop, x, float(np.abs(states @ step.inputs.T).max()), parts)
