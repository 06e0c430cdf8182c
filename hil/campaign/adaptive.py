"""Adaptive draws that concentrate where runs fail, with weights that correct for it: importance sampling in
rounds.

    round 0      from the distributions of the sweep
    round r + 1  from a proposal fitted to the runs of round r that were nearest to failing, or failed
    the rest     from the last proposal, which stays: only these count for the rate; at least half of all

Draws are looked at as z = Phi^-1(u), each key standard normal, whatever its distribution. A proposal is a
mixture: a share of it is the standard normal itself, so that no weight exceeds one over that share and no
way to fail that the rounds have missed is out of reach; the rest are normal kernels about the chosen runs.
The last proposal does not depend on the runs that it draws, so their weighted failures are independent and
their mean is unbiased [Rubinstein and Kroese, The Cross-Entropy Method, 2004, ch. 3; kernels: Zhang, JASA 91
(1996) 1245].
"""

from collections.abc import Iterable, Mapping
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp, ndtr, ndtri

from servobench.hil.campaign.sweep_file import Adaptive

Floats = NDArray[np.float64]

ELITE_SHARE: Final = 0.2
"""Share of a round to which the next one is fitted; when this many fail, the rounds have arrived."""
NOMINAL_SHARE: Final = {"failures": 0.1, "boundary": 0.5}
"""Share of the nominal distribution in a proposal, by focus: a proposal about the boundary leaves the region
beyond it to this share."""
_SPREAD: Final = 0.7
"""Width of a kernel relative to the runs it represents. Narrower ones shrink from round to round, and then
the rounds hardly advance."""
_LEAST_DEVIATION: Final = 0.3
"""Least width of a kernel, in standard deviations of a key: about as far as a normal reaches beyond three of
them."""


class Proposal(NamedTuple):
    """Distribution to draw from."""

    nominal_share: float
    centres: Floats
    """(k, keys), centres of the kernels."""
    shares: Floats
    """(k,), shares of the kernels, 1 together."""
    factor: Floats
    """(keys, keys), lower triangular: times its transpose the kernels' covariance."""

    def draw(self, count: int, stream: np.random.Generator) -> Floats:
        """Draw (count, keys) in standard normal space."""
        keys = self.factor.shape[0]
        noise = stream.standard_normal((count, keys))
        nominal = stream.random(count) < self.nominal_share
        kernel = stream.choice(self.shares.size, count, p=self.shares)
        drawn: Floats = np.where(nominal[:, None], noise, self.centres[kernel] + noise @ self.factor.T)
        return drawn

    def weights(self, z: Floats) -> Floats:
        """Return the (n,) density of the sweep's distributions over that of the proposal at ``z``, (n,
        keys)."""
        apart = z[:, None, :] - self.centres
        scaled = np.linalg.solve(self.factor, apart.reshape(-1, z.shape[1]).T).T.reshape(apart.shape)
        with np.errstate(divide="ignore"):
            log_shares = np.log(self.shares)
        log_kernels = logsumexp(log_shares - 0.5 * (scaled**2).sum(axis=2), axis=1)
        log_kernels -= np.log(np.diag(self.factor)).sum()
        log_ratio = log_kernels + 0.5 * (z**2).sum(axis=1)
        share = self.nominal_share
        weights: Floats = np.exp(-np.logaddexp(np.log(share), np.log1p(-share) + log_ratio))
        return weights


def fitted(z: Floats, weights: Floats, guide: Floats, failed: NDArray[np.bool_], focus: str) -> Proposal:
    """Fit a proposal to the runs of a round: (n, keys), (n,), (n,), (n,); ``guide``: the larger, the nearer
    to failing."""
    order = np.lexsort((guide, failed))
    count, fails = max(z.shape[1] + 2, round(ELITE_SHARE * len(z))), int(failed.sum())
    if focus == "boundary" and fails:
        passes = len(z) - fails
        chosen = order[max(0, passes - count // 2) : passes + count // 2]
    else:
        chosen = order[-max(count, fails) :]
    shares = np.sqrt(weights[chosen])  # half way to them alone, of which one often outweighs all others
    shares /= shares.sum()
    centres = z[chosen]
    apart = centres - shares @ centres
    covariance = (shares[:, None] * apart).T @ apart
    floor = np.eye(z.shape[1]) * _LEAST_DEVIATION**2
    factor = np.asarray(np.linalg.cholesky(_SPREAD**2 * covariance + floor), np.float64)
    return Proposal(NOMINAL_SHARE[focus], centres, shares, factor)


class Drawn(NamedTuple):
    """The draw of a run."""

    even: tuple[float, ...]
    """By key, in [0, 1) before its distribution."""
    weight: float
    counts: bool
    """True if it counts for the rate: its proposal preceded all runs that count."""


class Rounds:
    """The draws of a campaign, a function of the sweep and of the earlier rows."""

    def __init__(self, adaptive: Adaptive, nominal: Floats, seed: int) -> None:
        """``nominal``: (runs, keys) even draws of the sweep, of which round 0 takes the first."""
        self._adaptive, self._seed = adaptive, seed
        self._count = len(nominal)
        self._even = nominal[: adaptive.round_runs].copy()
        self._weights = np.ones(len(self._even))
        self._rows: list[tuple[float, bool]] = []
        self._round = 0
        self._first_counting = self._count
        self._begin = 0

    def take(self, rows: Iterable[Mapping[str, Any]]) -> None:
        """Take in rows in order of their number; one taken before changes nothing."""
        for row in rows:
            if row["run"] < len(self._rows):
                continue
            guide = row[self._adaptive.guide]
            self._rows.append((np.inf if guide is None else guide, not row["passed"]))
            if len(self._rows) == len(self._even) < self._count:
                self._next_round()

    @property
    def known(self) -> int:
        """Number of runs with known draws."""
        return len(self._even)

    def drawn(self, number: int) -> Drawn:
        """Return the draw of run ``number``, below :attr:`known`."""
        even = tuple(self._even[number].tolist())
        return Drawn(even, float(self._weights[number]), number >= self._first_counting)

    def _next_round(self) -> None:
        last = slice(self._begin, len(self._rows))
        guide = np.array([each[0] for each in self._rows[last]])
        failed = np.array([each[1] for each in self._rows[last]])
        z = _normal(self._even[last])
        proposal = fitted(z, self._weights[last], guide, failed, self._adaptive.focus)
        self._round, self._begin = self._round + 1, len(self._rows)
        arrived = failed.mean() >= ELITE_SHARE or (self._adaptive.focus == "boundary" and failed.any())
        size = self._adaptive.round_runs
        if arrived or self._begin + size > self._count // 2:
            self._first_counting, size = self._begin, self._count - self._begin
        size = min(size, self._count - self._begin)
        drawn = proposal.draw(size, np.random.default_rng([self._seed, self._round]))
        self._even = np.concatenate([self._even, ndtr(drawn)])
        self._weights = np.concatenate([self._weights, proposal.weights(drawn)])


def _normal(even: Floats) -> Floats:
    tiny, near_one = np.finfo(np.float64).tiny, 1.0 - np.finfo(np.float64).epsneg
    normal: Floats = ndtri(np.clip(even, tiny, near_one))
    return normal
