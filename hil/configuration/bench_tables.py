"""A bench as the tables of its file: what may be changed in it before it is checked."""

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
    """The tables of a bench file, and where paths in them start; changes give another one.

    Nothing is checked before :attr:`config` is asked for.
    """

    def __init__(
        self, tables: Mapping[str, Any], *, source: str = "bench", folder: Path | None = None
    ) -> None:
        """``tables``: as of a bench file. ``source``: its name in errors. ``folder``: where paths in it
        start, else the working directory."""
        self.tables = tables
        self.source = source
        self.folder = folder or Path()

    @classmethod
    def load(cls, path: PathLike) -> "Bench":
        """The bench file at ``path``. Raises BadInput."""
        file = Path(path)
        return cls(read_toml(file, "bench file"), source=str(file), folder=file.parent)

    @classmethod
    def of(cls, bench: "Bench | PathLike | Mapping[str, Any]") -> "Bench":
        """A bench as a caller has it: the path of a bench file, its tables, or the bench itself."""
        if isinstance(bench, Bench):
            return bench
        return cls(bench) if isinstance(bench, Mapping) else cls.load(bench)

    def changed(self, changes: Mapping[str, Any]) -> "Bench":
        """With values at dotted keys, e.g. ``{"loop.deadline_us": 1500, "faults.loss.0.probability": 0.1}``.

        What is not there yet is added; a number counts the entries of an array of tables, None takes a key
        away. A key may lead into a file that the bench names: motor, controller, commissioned drive, fault
        plan. Raises BadInput for one that leads nowhere; what the value is worth :attr:`config` says.
        """
        tables = deepcopy(dict(self.tables))
        for key, value in changes.items():
            self._change(tables, key, value)
        return Bench(tables, source=self.source, folder=self.folder)

    @cached_property
    def config(self) -> BenchConfig:
        """It, checked, with what its paths name. Raises BadInput or BadInputs."""
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
        """The tables of the file that a drive names, in its place."""
        if len(path) != 3 or path[0] != "drive" or path[2] not in _DRIVE_FILES:
            return name
        key = ".".join(path)
        file = self.folder / name
        tables = read_toml(file, _DRIVE_FILES[path[2]], NamedBy(self.source, key, name))
        if path[2] == "controller" and isinstance(tables.get("controller"), Mapping):
            return dict(own_code_at(tables["controller"], file.parent.absolute()))
        return deepcopy(dict(tables))

    def _open_plan(self, faults: dict[str, Any]) -> None:
        """The tables of a fault plan in place of its path."""
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
"""What a drive may name instead of having it."""


def _put(place: Any, entry: int | str, value: Any) -> None:
    if value is None and isinstance(place, dict):
        place.pop(entry, None)
    else:
        place[entry] = value
