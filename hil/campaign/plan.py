"""From a sweep to its runs: run k of a campaign is the same whoever runs it, and when.

    run k:  replicate k // points, point k % points
    replicate r:  draw r, seed first_seed + r

Every point of the grid meets the same draws and seeds in the same order, so that two of them can be compared
in pairs, and a campaign that ends early has seen all points equally often. At one point no two runs share a
seed: it alone determines the lost frames, and runs that lose the same frames are not independent.
"""

import hashlib
import itertools
import json
from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm, qmc

from servobench.drivers.bounded_file import NamedBy, read_toml
from servobench.drivers.errors import BadInput
from servobench.hil.campaign.adaptive import Drawn, Rounds
from servobench.hil.campaign.identity import Identity, SourceFiles, program
from servobench.hil.campaign.sweep_file import RUNS_MAX, Draw, OwnFunctions, SweepFile, Vary, sweep_from
from servobench.hil.configuration.bench_file import Bench
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.verdict.arguments import checked

Changes = dict[str, Any]


class GridAxis(NamedTuple):
    """One axis of the grid."""

    title: str
    """Its key; the first of several."""
    choices: tuple[Changes, ...]
    labels: tuple[str, ...]
    numbers: tuple[float, ...] | None
    """The values; None if they are no numbers."""


class PlannedRun(NamedTuple):
    """The parameters of one run of a campaign."""

    number: int
    point: int
    replicate: int
    seed: int
    changes: Changes
    """Changes of the bench, without the seed."""
    labels: dict[str, float | str]
    """Varied values, for tables: numbers as they are, everything else by its label."""
    weight: float = 1.0
    """Weight of its draw, if draws are adaptive."""
    counts: bool = True
    """True if it counts for the rate."""


class CampaignPlan:
    """All runs of a sweep."""

    def __init__(self, sweep: SweepFile, source: Path, files: SourceFiles | None = None) -> None:
        """``source``: the sweep file; ``files``: known digests of it and its files.

        Raises BadInput or BadInputs: the bench, a key that it lacks, a file that has changed.
        """
        self.sweep = sweep
        self.source = source.absolute()
        """Absolute, independent of later changes of the working directory."""
        self.files = files or SourceFiles(self.source)
        with self.files.noting():
            self._read(sweep, self.source)

    def _read(self, sweep: SweepFile, source: Path) -> None:
        self.own = OwnFunctions(sweep.own, source)
        self.axes = tuple(_axis(vary) for vary in sweep.vary)
        self._points = list(itertools.product(*(range(len(axis.choices)) for axis in self.axes)))
        self.points = len(self._points)
        """Number of grid points."""
        self.count = self.points * sweep.campaign.seeds
        """Number of runs, unless something ends it early."""
        if self.count > RUNS_MAX:
            raise BadInput(str(source), "campaign", f"{self.count} runs", f"at most {RUNS_MAX}")
        path = source.parent / sweep.campaign.bench
        tables = read_toml(path, "bench file", NamedBy(str(source), "campaign.bench", sweep.campaign.bench))
        self.bench = Bench(tables, source=str(path), folder=path.parent).changed(sweep.change)
        refuse_real_time(self.bench.config, str(path))
        adaptive = sweep.adaptive
        self.rounds = None if adaptive is None else Rounds(adaptive, self._even, sweep.drawing.seed)
        """Rounds of adaptive draws; to be given the rows in order."""
        self._check_choices()

    @classmethod
    def load(cls, path: Path, identity: Identity | None = None) -> "CampaignPlan":
        """Load the sweep file at ``path``; ``identity``: that of the campaign it must belong to.

        Raises BadInput or BadInputs.
        """
        files = SourceFiles(path, None if identity is None else identity["files"])
        with files.noting():
            sweep = sweep_from(read_toml(path, "sweep file"), str(path))
        return cls(sweep, path, files)

    @property
    def known(self) -> int:
        """Number of runs with known draws; those of later ones depend on their rows."""
        return self.count if self.rounds is None else self.rounds.known

    @checked
    def drawn(self, number: int) -> Drawn:
        """Return the draw of run ``number``, below :attr:`known`."""
        if self.rounds is not None:
            return self.rounds.drawn(number)
        return Drawn(tuple(self._even[number // self.points].tolist()), 1.0, True)

    @checked
    def run(self, number: int, drawn: Drawn | None = None) -> PlannedRun:
        """Return run ``number``, counted from 0; ``drawn``: result of :meth:`drawn`, if already known."""
        drawn = drawn or self.drawn(number)
        replicate, point = divmod(number, self.points)
        seed = self.sweep.campaign.first_seed + replicate
        changes: Changes = self.own.changes(seed)
        labels: dict[str, float | str] = {}
        for axis, place in zip(self.axes, self._points[point], strict=True):
            changes |= axis.choices[place]
            labels[axis.title] = axis.labels[place] if axis.numbers is None else axis.numbers[place]
        for each, even in zip(self.sweep.draw, drawn.even, strict=True):
            value = _spread(each, even)
            changes[each.key] = round(value) if each.whole else value
            labels[each.key] = float(changes[each.key])
        return PlannedRun(number, point, replicate, seed, changes, labels, drawn.weight, drawn.counts)

    @checked
    def point_title(self, point: int) -> str:
        """Describe a point of the grid; empty if there is only one."""
        labels = self.run(point).labels
        shown = {axis.title: labels[axis.title] for axis in self.axes}
        return ", ".join(
            f"{key} = {value if isinstance(value, str) else format(value, 'g')}"
            for key, value in shown.items()
        )

    @property
    def identity(self) -> Identity:
        """Content that its rows depend on, for the files opened so far: a resumed campaign must match it."""
        return {"sweep": self._sweep_digest, "program": dict(program()), "files": dict(self.files.digests)}

    def require(self, identity: Identity) -> None:
        """Raise BadInput if the sweep, or a file opened by runs, differs from ``identity``."""
        self.files.require(identity["files"])
        if identity["sweep"] != self._sweep_digest:
            expected = "the sweep as it was when the campaign began"
            raise BadInput(str(self.source), "", f"BLAKE2b {self._sweep_digest}", expected)

    @cached_property
    def _sweep_digest(self) -> str:
        said = json.dumps(self.sweep.model_dump(mode="json"), sort_keys=True)
        return hashlib.blake2b(said.encode(), digest_size=16).hexdigest()

    def _check_choices(self) -> None:
        """Check each choice, the others at their first: no unknown key, no value out of range."""
        first = self.run(0).changes
        for choice in [choice for axis in self.axes for choice in axis.choices] or [{}]:
            _ = self.bench.changed({**first, **choice}).config

    @cached_property
    def _even(self) -> NDArray[np.float64]:
        """(replicates, keys) in [0, 1), before their distributions."""
        drawing, keys, count = self.sweep.drawing, len(self.sweep.draw), self.sweep.campaign.seeds
        if not keys:
            return np.empty((count, 0))
        stream = np.random.default_rng(drawing.seed)
        if drawing.method == "random":
            return stream.random((count, keys))
        if drawing.method == "sobol":
            return np.asarray(qmc.Sobol(keys, scramble=True, rng=stream).random(count))
        return np.asarray(qmc.LatinHypercube(keys, rng=stream).random(count))


def _spread(draw: Draw, even: float) -> float:
    """Map an even value in [0, 1) to the distribution."""
    if draw.distribution == "normal":
        tiny = np.finfo(np.float64).tiny  # Sobol points may be 0, whose quantile is -infinity
        return float(norm.ppf(max(even, tiny), draw.mean, draw.deviation))
    low, high = draw.low or 0.0, draw.high or 0.0
    if draw.distribution == "uniform":
        return low + (high - low) * even
    return float(low * (high / low) ** even)


def _axis(vary: Vary) -> GridAxis:
    keys = vary.keys or (vary.key or "",)
    rows = vary.rows or tuple((value,) for value in vary.values or _range(vary))
    choices = tuple(dict(zip(keys, row, strict=True)) for row in rows)
    plain = all(len(row) == 1 and type(row[0]) in (int, float) for row in rows)
    numbers = tuple(float(row[0]) for row in rows) if plain and not vary.labels else None
    labels = vary.labels or tuple(", ".join(_label(value) for value in row) for row in rows)
    return GridAxis(keys[0], choices, labels, numbers)


def _range(vary: Vary) -> tuple[float | int, ...]:
    assert vary.start is not None
    assert vary.to is not None
    spread = np.geomspace if vary.spacing == "log" else np.linspace
    values = spread(vary.start, vary.to, vary.count or 2).tolist()
    return tuple(round(value) for value in values) if vary.whole else tuple(values)


def _label(value: Any) -> str:
    if isinstance(value, Mapping):
        return str(value.get("kind") or value.get("plan") or json.dumps(value, sort_keys=True))
    return Path(value).stem if isinstance(value, str) else json.dumps(value)


def refuse_real_time(config: BenchConfig, source: str) -> None:
    """Raise BadInput for a bench on a bus in real time, whose drives may be real."""
    spec = config.bus.spec
    if spec != "simulated":
        raise BadInput(source, "bus.spec", spec, "'simulated': a campaign runs in simulated time")
