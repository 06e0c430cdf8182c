"""State-space algebra, margins and norms beside python-control's, and both beside the formula of the roots.

The loops are those of [Azaiz2007], drawn anew: a pole near the origin, one at 1e6 to 3e7 rad/s and a winding
between. docs/decisions/0020 quotes what this prints with ``pytest -s``.
"""

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import pytest
from scipy.optimize import brentq

from servobench.design.current.current_design import complementary
from servobench.design.hinf.margins import margins
from servobench.design.hinf.system_norm import hinf_norm
from servobench.design.statespace import Array, ComplexArray, StateSpace, from_zpk, series, zeros

control = pytest.importorskip("control")

LOOPS = 40


class DrawnLoop(NamedTuple):
    """L = K G by its roots."""

    K: StateSpace
    G: StateSpace
    zeros: list[float]
    poles: list[float]
    gain: float
    crossing_rad_s: float

    def at(self, omega: Array) -> ComplexArray:
        """L(j omega), factor by factor."""
        s = 1j * np.asarray(omega)
        over = np.prod([s - zero for zero in self.zeros], axis=0)
        return np.asarray(self.gain * over / np.prod([s - pole for pole in self.poles], axis=0))

    def logarithm(self, omega: float) -> float:
        """log |L(j omega)|."""
        return math.log(abs(self.at(np.array([omega]))[0]))


def _drawn(count: int) -> Iterator[DrawnLoop]:
    """Of a seed."""
    draw = np.random.default_rng(20)
    for _ in range(count):
        inductance, rate = 10 ** draw.uniform(-4, -2), 10 ** draw.uniform(1.5, 4)
        K_zeros = [-(10 ** draw.uniform(1.5, 3)), -(10 ** draw.uniform(4, 5))]
        K_poles = [-(10 ** draw.uniform(a, b)) for a, b in ((-3, -1), (3, 4), (6, 7.5))]
        crossing = 10 ** draw.uniform(1.5, 3)
        unit = DrawnLoop(
            from_zpk(K_zeros, K_poles, 1.0), from_zpk([], [-rate], 1.0 / inductance), K_zeros,
            [*K_poles, -rate], 1.0 / inductance, crossing,
        )  # fmt: skip
        gain = 1.0 / abs(unit.at(np.array([crossing]))[0])
        yield unit._replace(K=from_zpk(K_zeros, K_poles, gain), gain=gain / inductance)


def theirs(system: StateSpace) -> Any:
    return control.ss(system.A, system.B, system.C, system.D)


def test_a_loop_joined_by_both_is_that_of_its_roots() -> None:
    omega = np.logspace(-4, 9, 1000)
    own, other = [], []
    for loop in _drawn(LOOPS):
        exact = loop.at(omega)
        own.append(np.max(np.abs(series(loop.G, loop.K).response(omega)[:, 0, 0] / exact - 1.0)))
        joined = theirs(loop.G) * theirs(loop.K)
        other.append(np.max(np.abs(joined(1j * omega) / exact - 1.0)))
        assert np.sort(zeros(series(loop.G, loop.K)).real) == pytest.approx(sorted(loop.zeros), rel=1e-9)
    print(f"\nresponse: own {max(own):.1e} off at most, python-control {max(other):.1e}")
    assert max(own) < 1e-11
    assert max(other) < 1e-3  # the same loop; its matrices are not balanced


def test_margins_and_norms_are_those_of_python_control() -> None:
    off = []
    for loop in _drawn(LOOPS):
        about = loop.crossing_rad_s
        crossing = brentq(loop.logarithm, 0.999 * about, 1.001 * about, xtol=1e-12)
        phase_deg = 180.0 + math.degrees(np.angle(loop.at(np.array(crossing))))
        own = margins(series(loop.G, loop.K))
        assert own.phase_margin_rad_s == pytest.approx(crossing, rel=1e-9)
        assert own.phase_margin_deg == pytest.approx(phase_deg, rel=1e-8)
        _, phase, _, at = control.margin(theirs(loop.G) * theirs(loop.K))
        T = complementary(loop.G, loop.K)
        norm, _ = control.linfnorm(control.feedback(theirs(loop.G) * theirs(loop.K), 1))
        off.append((phase / phase_deg - 1.0, at / crossing - 1.0, norm / hinf_norm(T).gain - 1.0))
    worst = np.max(np.abs(off), axis=0)
    print("\npython-control off: phase margin {:.1e}, its place {:.1e}, norm {:.1e}".format(*worst))
    assert np.all(worst < 1e-5)
