"""The inequalities of a certificate, for every edge i -> j between two samples that begin to act.

    value of the stretch from i to j of xi' P_j xi  <  xi' P_i xi       the L2 gain is proved
    e^{2 alpha t} M' P_j M < P_i,  P_i > 0                              the decay alpha is proved

The value of a flow is Q + Phi' S (I - W S)^{-1} Phi: its matrices are blocks of the exponential of the
Hamiltonian matrix. It is finite where the flow's own gain is below that of the file, and the trace of W S
below 1; a flow is cut into parts until both hold.
"""

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from fractions import Fraction
from typing import Any

from flint import arb, arb_mat

from servobench.design.verify.balls import (
    NotProved,
    cut,
    embedded,
    number,
    of_doubles,
    of_rows,
    require_positive,
    rounded,
    unit,
    whitening,
)
from servobench.design.verify.loops import Operation, RebuiltLoop, RebuiltStep
from servobench.design.verify.uneven import Ends

EPS = 1.4e-5
"""Share of a value that may be lost between two instants of a grid: half of it is lost in gain, and a smaller
one needs more instants."""
PARTS_MAX = 64
"""Parts of a flow: two suffice for the loops of docs/control.md, and what is beyond every bound stays so."""
REMEMBERED_MAX = 5
"""Samples that nodes may remember, one more than the design's do."""
BEYOND = "a disturbance within a period reaches beyond every bound"


class Proof(ABC):
    """The inequalities of one set of matrices."""

    def __init__(self, loop: RebuiltLoop, rows: Sequence[Any], gain: arb | None, decay: arb) -> None:
        self.loop, self.gain, self.decay, self.eps = loop, gain, decay, EPS
        self.P = [of_rows(each) for each in rows]
        self.P = [(each + each.transpose()) / 2 for each in self.P]
        if any(each.nrows() != loop.kept for each in self.P):
            raise NotProved(f"matrices of {self.P[0].nrows()} rows, expected {loop.kept}")
        self.edges = stretches(loop, len(self.P))
        self.whitened = [whitening(rounded(each).mid) for each in self.P]
        for node, matrix in enumerate(self.P):
            self.require(matrix, f"the matrix of node {node}", node)

    @abstractmethod
    def prove(self) -> None:
        """Show every inequality. Raises NotProved."""

    def require(self, matrix: arb_mat, where: str, node: int) -> None:
        """Show that ``matrix`` is positive definite, in coordinates in which P of ``node`` is of size 1."""
        X = of_doubles(self.whitened[node])
        require_positive(rounded(X.transpose() * matrix * X), where)

    def growth(self, periods: int) -> arb:
        """Return e^{2 alpha t}, of the longest periods."""
        longest_us = self.loop.period_us + self.loop.uneven_us
        return (2 * self.decay * number(longest_us) / 10**6 * periods).exp()

    def ends(self, target: int) -> list[arb_mat]:
        """Return bounds of the value of P_j before each end of an uneven period, after the shortest one."""
        squared = None if self.gain is None else self.gain**2
        return Ends(self.loop, squared).before(self.P[target])

    def flow(self, length_us: Fraction, spread: bool = False) -> tuple[arb_mat, arb_mat, arb_mat, int]:
        """Return Phi, W, Q of a part of a flow, and how many parts. ``spread``: at gain/(1 + eps)^{1/2}."""
        loop, m, length = self.loop, self.loop.F.nrows(), number(length_us) / 10**6
        if self.gain is None:
            return (loop.F * length).exp(), arb_mat(m, m), arb_mat(m, m), 1
        squared, parts = self.gain**2 / (1 + number(self.eps)) if spread else self.gain**2, 1
        while not self._is_short(length / parts, squared):
            parts *= 2
        EE, CC = loop.E * loop.E.transpose() / squared, loop.C * loop.C.transpose()
        rows = [[*loop.F.table()[i], *EE.table()[i]] for i in range(m)]
        rows += [[-entry for entry in (*CC.table()[i], *loop.F.transpose().table()[i])] for i in range(m)]
        H = arb_mat(rows)
        G = (H * (length / parts)).exp()
        inverse = cut(G, m, m, m).inv()
        return inverse.transpose(), cut(G, m, 0, m) * inverse, inverse * cut(G, m, m, 0) * -1, parts

    def _is_short(self, length: arb, squared: arb) -> bool:
        """Return True if the integral of the impulse response, which bounds the gain, is below the file's."""
        loop, parts, total = self.loop, 16, arb(0)
        near = (loop.F * (length / parts * arb(0.5, 0.5))).exp()
        step, begun = (loop.F * (length / parts)).exp(), loop.E
        for _ in range(parts):
            total += (loop.C.transpose() * near * begun)[0, 0].abs_upper() * length / parts
            begun = step * begun
        return bool(total**2 < squared)


class Timed(Proof):
    """Of a loop whose samples begin to act at one instant of a period, or are lost."""

    def __init__(self, loop: RebuiltLoop, rows: Sequence[Any], gain: arb | None, decay: arb) -> None:
        super().__init__(loop, rows, gain, decay)
        self._flows: dict[Fraction, tuple[arb_mat, arb_mat, arb_mat, int]] = {}

    def prove(self) -> None:
        loop = self.loop
        ends = {target: self.ends(target) for _, target, _, _ in self.edges} if loop.uneven_us else {}
        for source, target, idle, step in self.edges:
            for whole in step.chains or (loop.idle,):
                # the last flow of the chain is the one whose length varies
                chain = (*whole[:-1], ("flow", whole[-1][1] - loop.uneven_us)) if ends else whole
                for S in ends.get(target, [self.P[target]]):
                    for period in (chain, *[loop.idle] * idle):
                        S = embedded(S, loop.size)
                        for operation in reversed(period):
                            S = self._before(S, operation)
                        S = cut(S, loop.kept)
                    slack = self.P[source] - S * self.growth(idle + 1)
                    self.require(slack, f"from node {source} to {target} after {idle} losses", source)

    def _before(self, S: arb_mat, operation: Operation) -> arb_mat:
        """Return the value before an operation, S (n, n) after it."""
        kind, what = operation
        return arb_mat(what.transpose() * S * what) if kind == "jump" else self._over(S, what)

    def _over(self, S: arb_mat, length_us: Fraction, parts_max: int = PARTS_MAX) -> arb_mat:
        """Return the value before a flow, S after it; by its halves where its disturbance reaches too far."""
        size = self.loop.size
        if length_us not in self._flows:
            Phi, W, Q, parts = self.flow(length_us)
            self._flows[length_us] = embedded(Phi, size, 1), embedded(W, size), embedded(Q, size), parts
        Phi, W, Q, parts = self._flows[length_us]
        for _ in range(parts):
            reach = W * S
            if reach.trace() < 1:
                S = Q + Phi.transpose() * S * (arb_mat(unit(size)) - reach).inv() * Phi
            elif parts_max > 1:
                for _ in range(2):
                    S = self._over(S, length_us / parts / 2, parts_max // 2)
            else:
                raise NotProved(BEYOND)
        return S


def stretches(loop: RebuiltLoop, matrices: int) -> list[tuple[int, int, int, RebuiltStep]]:
    """Return (from, to, idle periods before, step) between nodes at which a sample has just begun to act; of
    uneven periods between all nodes.

    Where there are more matrices than such nodes, they remember from which nodes the steps of that sample and
    of as many as needed before it went out.
    """
    for remembered in range(REMEMBERED_MAX + 1):
        memories = loop.count**remembered
        walks = [
            (
                (step.source, memory),
                (step.target, (memory * loop.count + step.source) % memories if step.delivers else memory),
                step,
            )
            for memory in range(memories)
            for step in loop.steps
        ]
        while True:
            entered = {target for _, target, _ in walks}
            kept = [walk for walk in walks if walk[0] in entered]
            if len(kept) == len(walks):
                break
            walks = kept
        nodes = {target for _, target, step in walks if step.delivers or loop.uneven_us}
        delivered = sorted(nodes, key=lambda node: node[::-1])
        if len(delivered) == matrices and loop.uneven_us:
            places = [(delivered.index(one), delivered.index(other)) for one, other, _ in walks]
            return [(*place, 0, step) for place, (_, _, step) in zip(places, walks, strict=True)]
        if len(delivered) == matrices:
            return list(_between(walks, delivered))
        if len(delivered) > matrices:
            break
    raise NotProved(f"{matrices} matrices do not belong to this network")


def _between(walks: list[Any], delivered: list[Any]) -> Iterator[tuple[int, int, int, RebuiltStep]]:
    for number_, node in enumerate(delivered):
        stack = [(node, 0)]
        while stack:
            at, idle = stack.pop()
            for source, target, step in walks:
                if source == at:
                    if step.delivers:
                        yield number_, delivered.index(target), idle, step
                    else:
                        stack.append((target, idle + 1))
