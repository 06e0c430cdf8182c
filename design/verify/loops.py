"""The loop of a controller's file, rebuilt from its numbers, which are read as the rationals that they are.

    xi' = F xi + E d, z = C xi       between two operations; d: load torque, z: speed error

Each step from one sample to the next is a chain of operations on xi: a jump, or a flow of some length.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

from flint import arb, arb_mat

from servobench.design.verify.balls import NotProved, cut, number, unit

Operation = tuple[str, Any]
"""("jump", J) or ("flow", length in us)."""


@dataclass(frozen=True, slots=True)
class RebuiltStep:
    """A period from node to node.

    ``windows``: (back, first us, last us) of each sample that begins to act in it, the oldest first; or else
    ``chains``: its operations, one chain for each corner of the filter's gain.
    """

    source: int
    target: int
    windows: tuple[tuple[int, Fraction, Fraction], ...] = ()
    chains: tuple[tuple[Operation, ...], ...] = ()

    @property
    def delivers(self) -> bool:
        """True if a sample begins to act."""
        return bool(self.windows or self.chains)


@dataclass(frozen=True, slots=True, eq=False)
class RebuiltLoop:
    """xi' = F xi + E d, z = C xi between two operations; the last entry of xi counts within a period only."""

    F: arb_mat
    E: arb_mat
    C: arb_mat
    period_us: Fraction
    size: int
    kept: int
    count: int
    """Nodes; 0 is that of a sample that has just begun to act, or the newest of these."""
    steps: list[RebuiltStep]
    idle: tuple[Operation, ...]
    """A period in which no sample begins to act."""
    applying: list[arb_mat]
    """The jump when the sample of so many periods ago begins to act."""
    inputs: list[list[arb]]
    """The row of xi, at the begin of the period, that is the input then; the input in force comes last."""
    uneven_us: Fraction = Fraction(0)
    """Largest departure of a period from ``period_us``."""

    @property
    def shortest_us(self) -> Fraction:
        """Shortest period."""
        return self.period_us - self.uneven_us


def uneven_of(file: dict[str, Any]) -> Fraction:
    """Return by how much the distance of two SYNCs may depart from the period, us."""
    return Fraction(file["made_for"].get("sync_within_us", 0))


def motor_of(file: dict[str, Any]) -> tuple[arb, arb, arb, arb]:
    """Return rate of the current loop, 1/s, J, B and K_t."""
    made = file["made_for"]
    plant = {key: number(value) for key, value in made["plant"].items() if key != "coupling"}
    rate = plant["resistance_ohm"] / plant["inductance_q_h"]
    if "current_loop" in made:
        rate = 2 * arb.pi() * number(made["current_loop"]["bandwidth_hz"])
    return rate, plant["inertia_kg_m2"], plant["viscous_friction_nm_s"], plant["torque_constant_nm_a"]


def state_feedback(file: dict[str, Any]) -> RebuiltLoop:
    """Rebuild the loop of u = K x over a network: xi = [x, w, v_0 .. v_m]."""
    made, K = file["made_for"], [number(entry) for entry in file["gain"]]
    rate, J, B, Kt = motor_of(file)
    n, zero = len(K), arb(0)
    A = [row[:n] for row in [[-rate, zero, zero], [Kt / J, -B / J, zero], [zero, arb(1), zero]][:n]]
    loaded = [zero, 1 / J, zero][:n]
    if "coupling" in made["plant"]:
        A, loaded = coupled(made["plant"]["coupling"], A, B, Kt)
        K, n = [*K, zero, zero], n + 2
    F = arb_mat([[*row, rate if i == 0 else zero] for i, row in enumerate(A)] + [[zero] * (n + 1)])
    E = [[entry] for entry in [*loaded, zero]]
    C = [[arb(1) if place == 1 else zero] for place in range(n + 1)]
    h, T, D = Fraction(made["period_us"]), Fraction(made["delay_max_us"]), made["losses_in_a_row_max"]
    arrival, uneven = made["strategy"] == "arrival", uneven_of(file)
    latest = T if arrival else Fraction(made["agreed_delay_us"])
    shortest = h - uneven if arrival else h
    behind = max(0, math.ceil(latest / shortest) - 1) if arrival else int(latest // h)
    if arrival and uneven and behind > 1:
        raise NotProved("a sample may act after two of the shortest periods")
    offset, size = latest - behind * shortest, n + 2 + behind
    sampled = unit(size, *((place, place - 1) for place in range(n + 2, size)))
    sampled[n + 1] = [*K, *[zero] * (size - n)]
    begin: Operation = ("jump", arb_mat(sampled))
    applying = [arb_mat(unit(size, (n, n + 1 + back))) for back in range(behind + 1)]
    if arrival:
        count = D + 1 + behind
        steps = [step for node in range(count) for step in arrivals(node, count, behind, offset, shortest)]
    else:
        count = 1 if made["strategy"] == "history" else D + 1
        chain = (begin, ("flow", offset), ("jump", applying[behind]), ("flow", h - offset))
        steps = [RebuiltStep(node, 0, chains=(chain,)) for node in range(count)]
        steps += [RebuiltStep(node, node + 1) for node in range(count - 1)]
    inputs = [sampled[n + 1], *(unit(size)[n + back] for back in range(1, behind + 1)), unit(size)[n]]
    idle: tuple[Operation, ...] = (begin, ("flow", h))
    return RebuiltLoop(
        F, arb_mat(E), arb_mat(C), h, size, size - 1, count, steps, idle, applying, inputs, uneven
    )


def coupled(
    file: dict[str, Any], rigid: list[list[arb]], B: arb, Kt: arb
) -> tuple[list[list[arb]], list[arb]]:
    """Return A of a shaft that twists, and where a load torque enters: behind the states of the rigid one the
    other side's speed and the twist. That of the encoder is state 1."""
    m, j, k, d = (
        number(file[key]) for key in ("motor_kg_m2", "load_kg_m2", "stiffness_nm_rad", "damping_nm_s")
    )
    n, zero = len(rigid), arb(0)
    rotor, load = (n, 1) if file["encoder"] == "load" else (1, n)
    A = [[*row, zero, zero] for row in rigid] + [[zero] * (n + 2) for _ in range(2)]
    A[1] = [zero] * (n + 2)
    A[rotor][0] = Kt / m
    for row, sign, inertia in ((rotor, -1, m), (load, 1, j)):
        A[row][rotor] += sign * d / inertia
        A[row][load] += -sign * d / inertia
        A[row][n + 1] = sign * k / inertia
    rubbed, inertia = (load, j) if file["friction"] == "load" else (rotor, m)
    A[rubbed][rubbed] -= B / inertia
    A[n + 1][rotor], A[n + 1][load] = arb(1), arb(-1)
    return A, [1 / j if place == load else zero for place in range(n + 2)]


def arrivals(node: int, count: int, behind: int, offset: Fraction, h: Fraction) -> Iterator[RebuiltStep]:
    """Yield the steps from the node at which the acting sample was taken ``node`` + 1 periods ago."""
    last = node == count - 1  # one of D + 1 samples comes
    if not last:
        yield RebuiltStep(node, node + 1)
    windows = [
        (back, Fraction(0), offset if back == behind else h) for back in range(min(node, behind), -1, -1)
    ]
    for through in range(1, len(windows) + 1):
        chosen = tuple(windows[:through])
        yield RebuiltStep(node, chosen[-1][0], chosen)
        if through > 1 and chosen[0][0] == behind and not last and offset < h:
            # the oldest is lost, and the next comes after its last instant
            yield RebuiltStep(node, chosen[-1][0], chosen[1:])


def shaft(rate: arb, J: arb, B: arb, filter_hz: Any) -> tuple[arb_mat, arb_mat]:
    """Return A (4, 4) and B (4, 1) of torque, speed, filtered speed and load."""
    f, zero = 2 * arb.pi() * number(filter_hz), arb(0)
    A = [[-rate, zero, zero, zero], [1 / J, -B / J, zero, -1 / J], [zero, f, -f, zero], [zero] * 4]
    return arb_mat(A), arb_mat([[rate], [zero], [zero], [zero]])


def of_samples(
    file: dict[str, Any], A: arb_mat, B: arb_mat, size: int, command: int, delay: Fraction,
    sampled: Sequence[Sequence[arb_mat]], lost: arb_mat, end: Sequence[Operation] = (), n: int = 3,
) -> RebuiltLoop:  # fmt: skip
    """Return the loop xi = [T, omega, w | u in force | ...], commands from place ``command`` on; of ``n`` = 4
    the fourth state is the angle.

    ``delay``: from a sample to its command's instant, us; ``sampled``: the jumps of a sample after 0, 1 ..
    losses, one for each corner of its gain; ``end``: what follows at a period's end.
    """
    h = Fraction(file["made_for"]["period_us"])
    behind = int(delay // h)
    offset = delay - behind * h
    rates = [[*(A[i, j] for j in range(3)), *[arb(0)] * (n - 3), B[i, 0]] for i in range(3)]
    rates += [[arb(int(j == 1)) for j in range(n + 1)] for _ in range(n - 3)]
    F = arb_mat([*rates, [arb(0)] * (n + 1)])
    E, C = ([[arb(0)], [entry], *[[arb(0)]] * (n - 1)] for entry in (A[1, 3], arb(1)))
    acting = arb_mat(unit(size, (n, command + behind)))
    after: tuple[Operation, ...] = (("flow", offset), ("jump", acting), ("flow", h - offset), *end)
    came: list[tuple[tuple[Operation, ...], ...]] = [
        tuple((("jump", J), *after) for J in corners) for corners in sampled
    ]
    count = len(came)
    steps = [RebuiltStep(node, 0, chains=chains) for node, chains in enumerate(came)]
    steps += [RebuiltStep(node, node + 1) for node in range(count - 1)]
    idle = (("jump", lost), *after)
    uneven = uneven_of(file)
    if uneven and end:
        raise NotProved("uneven periods of a controller that knows them")
    return RebuiltLoop(F, arb_mat(E), arb_mat(C), h, size, size - 1, count, steps, idle, [], [], uneven)


def hinf(file: dict[str, Any]) -> RebuiltLoop:
    """Rebuild the loop of x+ = A x + B e + L u, u = C x + D e: xi = [.. | x | e held | commands]."""
    proof = file["certificate"]
    A = [[number(entry) for entry in row] for row in file["A"]]
    B, L, C = ([number(entry) for entry in file[key]] for key in "BLC")
    D = number(file["D"])
    delay = Fraction(file["made_for"]["delay_max_us"]) + Fraction(proof["dead_time_us"])
    h = Fraction(file["made_for"]["period_us"])
    m, behind = len(C), int(delay // h)
    if uneven_of(file) and behind != file["made_for"]["delay_max_us"] // h:
        raise NotProved("commands act in the period after that of their instant")
    held, command = 4 + m, 5 + m
    size = command + behind + 1

    def jump(*, came: bool) -> arb_mat:
        rows = unit(size, *((place, place - 1) for place in range(command + 1, size)))
        error = [arb(-1 if came and j == 2 else 1 if not came and j == held else 0) for j in range(size)]
        state = unit(size)[4:held]
        rows[held] = error
        rows[command] = [
            sum((c * x[j] for c, x in zip(C, state, strict=True)), D * error[j]) for j in range(size)
        ]
        for i in range(m):
            rows[4 + i] = [
                sum(
                    (a * x[j] for a, x in zip(A[i], state, strict=True)),
                    B[i] * error[j] + L[i] * rows[command][j],
                )
                for j in range(size)
            ]
        return arb_mat(rows)

    plant = shaft(*motor_of(file)[:3], proof["speed_filter_hz"])
    sampled = [[jump(came=True)]] * (proof["losses_in_a_row_max"] + 1)
    return of_samples(file, *plant, size, command, delay, sampled, jump(came=False))


def predictor(file: dict[str, Any]) -> RebuiltLoop:
    """Rebuild the loop of a filter, a prediction and a feedback: xi = [.. | x^ (4) | commands]."""
    corners = file["certificate"]["filter_gains"]
    zero = arb(0)
    return predicting(
        file, [[[(zero, zero), *((zero, number(g)) for g in gains)] for gains in each] for each in corners], 3
    )


def fused(file: dict[str, Any]) -> RebuiltLoop:
    """Rebuild the same on count and speed: xi = [T, omega, w, angle beyond the estimated one | ..]."""
    zero, sampled = arb(0), []
    for each in file["gains"][: file["certificate"]["losses_in_a_row_max"] + 1]:
        speed, filtered, angle, load = ([number(gain) for gain in row] for row in each)
        sampled.append([[(zero, zero), speed, filtered, load, angle]])
    return predicting(file, sampled, 4)


def moved(A: arb_mat, B: arb_mat, length: Fraction) -> arb_mat:
    """Return how [T, omega, w, T_L, u, angle] go under a command that is held for ``length`` us."""
    rates: list[list[Any]] = [[*row, entry, 0] for row, (entry,) in zip(A.tolist(), B.tolist(), strict=True)]
    rates += [[0] * 6, [0, 1, 0, 0, 0, 0]]
    return (arb_mat(rates) * (number(length) / 10**6)).exp()


def predicting(file: dict[str, Any], corners: Sequence[Sequence[Any]], n: int) -> RebuiltLoop:
    """Rebuild a predictor's loop around a plant of ``n`` states.

    ``corners``: gains of T, omega, w, T_L, and of ``n`` = 4 of the angle, each for count and filtered speed.
    """
    own = (number(file[key]) for key in ("current_bandwidth_hz", "inertia_kg_m2", "viscous_friction_nm_s"))
    bandwidth_hz, inertia, friction = own
    A, B = shaft(2 * arb.pi() * bandwidth_hz, inertia, friction, file["speed_filter_hz"])
    kT, kw = number(file["torque_gain"]), number(file["speed_gain_nm_s_rad"])
    F = arb_mat([[kT, kw, arb(0), -1 - kT]])
    h, delay = Fraction(file["made_for"]["period_us"]), Fraction(file["made_for"]["delay_max_us"])
    delay += Fraction(file["dead_time_us"])
    behind, offset = int(delay // h), delay % h
    first_state = n + 1
    command, count = first_state + 4, behind + 2
    size = command + count

    def step(length: Fraction) -> tuple[arb_mat, arb_mat]:
        """Return the model's transition and input."""
        both = moved(A, B, length)
        return cut(both, 4), arb_mat([[both[i, 4]] for i in range(4)])

    ahead, entered = step(offset)
    columns = {behind: entered}
    whole, input_ = step(h)
    for place in range(behind - 1, -1, -1):
        ahead = whole * ahead
        columns = {key: whole * column for key, column in columns.items()}
        columns[place] = input_
    of_state, of_commands = F * ahead, {key: (F * column)[0, 0] for key, column in columns.items()}

    def jump(gains: Sequence[Sequence[arb]]) -> arb_mat:
        rows = unit(size, *((place, place - 1) for place in range(command + 1, size)))
        for i, (of_count, of_speed) in enumerate(gains):
            row, sign = (rows[first_state + i], 1) if i < 4 else (rows[3], -1)
            row[2] += sign * of_speed
            row[first_state + 2] -= sign * of_speed
            if n == 4:
                row[3] += sign * of_count
        rows[command] = [
            -sum(
                (of_state[0, i] * rows[first_state + i][j] for i in range(4)),
                of_commands.get(j - command, arb(0)),
            )
            for j in range(size)
        ]
        return arb_mat(rows)

    (first, held), (second, fresh) = step(offset), step(h - offset)
    follows = unit(size)
    for i in range(4):
        follows[first_state + i][first_state:command] = [(second * first)[i, j] for j in range(4)]
        follows[first_state + i][command + behind] += fresh[i, 0]
        follows[first_state + i][command + behind + 1] += (second * held)[i, 0]
    if n == 4:  # the model's angle: under the command before, then under the new one
        early, late = moved(A, B, offset), moved(A, B, h - offset)
        of_first = arb_mat([[late[5, i] for i in range(4)]])
        for j in range(4):
            follows[3][first_state + j] -= early[5, j] + (of_first * first)[0, j]
        follows[3][command + behind] -= late[5, 4]
        follows[3][command + behind + 1] -= early[5, 4] + (of_first * held)[0, 0]
    sampled = [[jump(gains) for gains in each] for each in corners]
    plant = shaft(*motor_of(file)[:3], file["speed_filter_hz"])
    lost, end = jump([(arb(0), arb(0))] * 4), [("jump", arb_mat(follows))]
    return of_samples(file, *plant, size, command, delay, sampled, lost, end, n)
