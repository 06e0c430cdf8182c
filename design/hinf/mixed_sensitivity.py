"""The mixed-sensitivity problem of Fig. 6 in [Azaiz2007]: z = [w1 e; w2 u; w3 i], y = e = i_ref - i.

|| [w1 S; w2 K S; w3 T] || < gamma,  S = 1/(1 + G K),  T = G K S        (40)

Weights of the mixed-sensitivity problem of [Azaiz2007] 3.2, from rules and as printed.

A bound 1/|w| on a closed-loop gain is drawn by its ends and its crossing: a first-order w is fixed by the
gain at low frequency, the gain at high frequency, and the frequency at which |w| = 1.

    w(s) = high (s + zero)/(s + pole)      w(0) = low      |w(j crossing)| = 1
    pole^2 (low^2 - 1) = crossing^2 (1 - high^2)      zero = pole low/high
"""

import math
from dataclasses import dataclass

import numpy as np

from servobench.design.hinf.plant import GeneralisedPlant
from servobench.design.statespace import Array, StateSpace, append, connect, first_order, state_space


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
