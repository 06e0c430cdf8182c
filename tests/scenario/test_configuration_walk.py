"""The way of a bench's configuration from its file to its run stays short."""

import sys
import tomllib
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

from servobench.hil.configuration.bench_file import bench_from
from servobench.hil.configuration.config_files import Section
from servobench.hil.execution.bench import run_bench

ROOT = Path(__file__).parents[2]
ROOMS = {"drivers": 0, "virtual_bus": 100, "hil": 200}
"""Of no floor: one that is below all of its room."""
STAYS_MAX, CLIMBS_MAX, NAMES_MAX = 25, 3, 50


def floors() -> dict[tuple[str, str], int]:
    """How high a folder or module of a room lies, by the import rules."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    rules = [each for each in contracts if each["name"].startswith("The floors")]
    return {
        (each["containers"][0].split(".")[1], name.strip()): height
        for each in rules
        for height, line in enumerate(reversed(each["layers"]))
        for name in line.split("|")
    }


class Walk:
    """Files whose functions are handed the configuration or a part of it, in order; as ``sys.setprofile``."""

    def __init__(self) -> None:
        self.stays: list[Path] = []
        self.names: set[str] = set()
        self._floors = floors()

    def __call__(self, frame: FrameType, event: str, _: object) -> None:
        code = frame.f_code
        if event != "call" or ("servobench" not in code.co_filename and str(ROOT) not in code.co_filename):
            return
        names = code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]
        handed = {name for name in names if name != "self" and _is_part(frame.f_locals.get(name))}
        path = Path(code.co_filename).resolve()
        if not handed or not path.is_relative_to(ROOT) or path.relative_to(ROOT).parts[0] not in ROOMS:
            return
        self.names |= handed
        if self.stays[-1:] != [path]:
            self.stays.append(path)

    @property
    def climbs(self) -> Iterator[tuple[Path, Path]]:
        """Steps from a lower floor to an upper one."""
        return ((a, b) for a, b in pairwise(self.stays) if self._height(a) < self._height(b))

    def _height(self, path: Path) -> int:
        room, *below = path.relative_to(ROOT).with_suffix("").parts
        return ROOMS[room] + self._floors.get((room, below[0]), -1)


def _is_part(value: Any) -> bool:
    several = value.values() if isinstance(value, dict) else value if isinstance(value, list | tuple) else ()
    return isinstance(next(iter(several), value), Section)


def test_a_configuration_goes_one_way(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    example = ROOT / "examples" / "ling2012.toml"
    tables = tomllib.loads(example.read_text(encoding="utf-8"))
    tables["bench"]["duration_s"] = 0.05
    tables = {
        key: value for key, value in tables.items() if key not in ("reference", "load", "verdict", "faults")
    }
    walk, before = Walk(), sys.getprofile()
    sys.setprofile(walk)
    try:
        run_bench(bench_from(tables, example.name, example.parent), keep=False)
    finally:
        sys.setprofile(before)
    shown = "\n".join(str(path.relative_to(ROOT)) for path in walk.stays)
    assert 10 < len(walk.stays) <= STAYS_MAX, f"{len(walk.stays)} stays:\n{shown}"
    climbs = list(walk.climbs)
    assert len(climbs) <= CLIMBS_MAX, climbs
    assert len(walk.names) <= NAMES_MAX, walk.names
