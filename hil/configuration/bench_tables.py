"""A bench as the tables of its file, changeable before it is checked."""

import os
from collections.abc import Mapping
from copy import deepcopy
from functools import cached_property
from pathlib import Path
from typing import Any

from servobench.drivers.bounded_file import NamedBy, read_toml
from servobench.drivers.errors import BadInput
from servobench.hil.configuration.bench_file import bench_from, own_code_at
from servobench.hil.configuration.config import BenchConfig
from servobench.virtual_bus.faults.fault_plan import load_fault_plan

PathLike = str | os.PathLike[str]


class Bench:
    """The tables of a bench file, and the folder of its paths; changes give a new one.

    Nothing is checked before :attr:`config` is read.
    """

    def __init__(
        self, tables: Mapping[str, Any], *, source: str = "bench", folder: Path | None = None
    ) -> None:
        """``tables``: those of a bench file. ``source``: its name in errors. ``folder``: start of its paths,
        default the working directory."""
        self.tables = tables
        self.source = source
        self.folder = folder or Path()

    @classmethod
    def load(cls, path: PathLike) -> "Bench":
        """Load the bench file at ``path``. Raises BadInput."""
        file = Path(path)
        return cls(read_toml(file, "bench file"), source=str(file), folder=file.parent)

    @classmethod
    def of(cls, bench: "Bench | PathLike | Mapping[str, Any]") -> "Bench":
        """Make a bench from a caller's value: the path of a bench file, its tables, or a bench."""
        if isinstance(bench, Bench):
            return bench
        return cls(bench) if isinstance(bench, Mapping) else cls.load(bench)

    def changed(self, changes: Mapping[str, Any]) -> "Bench":
        """Return a bench with values at dotted keys, e.g. ``{"loop.deadline_us": 1500,
        "faults.loss.0.probability": 0.1}``.

        A missing key is added; a number counts the entries of an array of tables, None removes a key. A key
        may lead into a file that the bench names: motor, controller, commissioned drive, fault plan. Raises
        BadInput for one that leads nowhere; :attr:`config` checks the value.
        """
        tables = deepcopy(dict(self.tables))
        for key, value in changes.items():
            self._change(tables, key, value)
        return Bench(tables, source=self.source, folder=self.folder)

    @cached_property
    def config(self) -> BenchConfig:
        """The checked bench, with the files that it names. Raises BadInput or BadInputs."""
        return bench_from(self.tables, self.source, self.folder)

    def _change(self, tables: dict[str, Any], key: str, value: Any) -> None:
        path = key.split(".")
        place: Any = tables
        for depth, part in enumerate(path):
            last = depth == len(path) - 1
            if path[0] == "faults" and depth == 1 and part != "plan":
                self._open_plan(place)
            if isinstance(place, list):
                if not part.isdecimal() or int(part) >= len(place):
                    expected = f"a number below {len(place)}, that of an entry of {'.'.join(path[:depth])}"
                    raise BadInput(self.source, key, part, expected)
                entry: int | str = int(part)
            elif isinstance(place, dict):
                entry = part
            else:
                expected = f"a key of the bench; {'.'.join(path[:depth])} is no table"
                raise BadInput(self.source, key, value, expected)
            if last:
                _put(place, entry, value)
                return
            if isinstance(place, dict):
                place.setdefault(part, {})
            if isinstance(place[entry], str):
                place[entry] = self._opened(path[: depth + 1], place[entry])
            place = place[entry]

    def _opened(self, path: list[str], name: str) -> Any:
        """Replace a drive's file by its tables and return them."""
        if len(path) != 3 or path[0] != "drive" or path[2] not in _DRIVE_FILES:
            return name
        key = ".".join(path)
        file = self.folder / name
        tables = read_toml(file, _DRIVE_FILES[path[2]], NamedBy(self.source, key, name))
        if path[2] == "controller" and isinstance(tables.get("controller"), Mapping):
            return dict(own_code_at(tables["controller"], file.parent.absolute()))
        return deepcopy(dict(tables))

    def _open_plan(self, faults: dict[str, Any]) -> None:
        """Replace the path of a fault plan by its tables."""
        name = faults.get("plan")
        if not isinstance(name, str):
            return
        if name.endswith(".jsonl"):
            raise BadInput(self.source, "faults.plan", name, "a fault plan: recorded faults have no keys")
        file = self.folder / name
        tables = read_toml(file, "fault plan", NamedBy(self.source, "faults.plan", name))
        del faults["plan"]
        faults |= deepcopy(load_fault_plan(tables, str(file)).as_tables())


_DRIVE_FILES = {"motor": "motor file", "controller": "controller file", "commissioned": "commissioned drive"}
"""Parts of a drive that may be named by a path instead."""


def _put(place: Any, entry: int | str, value: Any) -> None:
    if value is None and isinstance(place, dict):
        place.pop(entry, None)
    else:
        place[entry] = value
