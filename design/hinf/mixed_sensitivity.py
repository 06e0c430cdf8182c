"""The mixed-sensitivity problem of Fig. 6 in [Azaiz2007]: z = [w1 e; w2 u; w3 i], y = e = i_ref - i.

|| [w1 S; w2 K S; w3 T] || < gamma,  S = 1/(1 + G K),  T = G K S        (40)
"""

import numpy as np

from servobench.design.hinf.plant import GeneralisedPlant
from servobench.design.hinf.weights import Weights
from servobench.design.statespace import Array, StateSpace, append, connect, state_space


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
