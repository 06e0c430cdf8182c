"""Loading a bench file and the motor, controller and fault files that it names, with every fault of each.

:class:`Bench` is a bench as the tables of its file, changeable before it is checked.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from functools import cache, cached_property, partial
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Final

from pydantic import ValidationError

from servobench.drivers.bounded_file import NamedBy, read_toml
from servobench.drivers.errors import BadInput, BenchError
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.configuration.config_checks import cross_faults
from servobench.hil.configuration.config_files import (
    bad_inputs_of,
    other_kind,
    raise_all,
    shown,
    translate,
    validated,
)
from servobench.hil.configuration.controller_files import load_current_controller
from servobench.hil.configuration.controller_kinds import (
    ControllerFile,
    ControllerSection,
    StateFeedbackController,
)
from servobench.hil.configuration.drive_file import load_drive_file
from servobench.hil.configuration.drive_model import load_drive_model
from servobench.hil.configuration.motor_file import load_motor
from servobench.hil.configuration.preset_files import could_name_a_preset
from servobench.hil.configuration.references import load_signal
from servobench.virtual_bus.faults.fates import read_recorded
from servobench.virtual_bus.faults.fault_plan import FaultPlan, load_fault_plan, read_fault_plan
from servobench.virtual_bus.hosting.injection import Faults

ENTRY_POINTS = "servobench.controllers"
"""Group of the entry points by which installed packages provide kinds of controllers and compensators."""


def load_bench(path: Path) -> BenchConfig:
    """Load the bench file at ``path``, with the files that it names. Raises BadInput or BadInputs."""
    if path.suffix == ".py" and path.is_file():
        remedy = f"hil run BENCH.toml --controller AXIS={path}:CLASS runs a controller of your own"
        raise BadInput(str(path), "", "a Python file", "a bench file, with [bench], [drive]", remedy)
    return bench_from(read_toml(path, "bench file"), str(path), path.parent)


def load_faults(path: Path, named_by: NamedBy | None = None) -> Faults:
    """Load the fault plan at ``path``, or a run's recorded faults. Raises BadInput or BadInputs."""
    if path.suffix == ".jsonl":
        return read_recorded(path, named_by)
    if path.suffix == ".arrow":
        from servobench.hil.rows.faults_file import read_faults  # pyarrow, which a plan does without

        return read_faults(path, named_by)
    tables = read_toml(path, "fault plan", named_by)
    if other := other_kind(tables):
        raise BadInput(str(path), "", f"a {other}", "a fault plan, with tables such as [[loss]] or [[delay]]")
    return faults_from(tables, str(path))


def faults_from(tables: Mapping[str, Any], source: str, prefix: str = "") -> FaultPlan:
    """Make a fault plan from the tables of a file, there under ``prefix``. Raises BadInput or BadInputs."""
    plan, errors = read_fault_plan(tables, source, prefix)
    if errors:
        raise_all(errors)
    return plan


def bench_from(raw: Mapping[str, Any], source: str, folder: Path) -> BenchConfig:
    """Make a bench from the tables of a file; paths in it start at ``folder``. Raises BadInput or
    BadInputs."""
    expansion = _Expansion(source, folder)
    tables = expansion.bench(raw)
    errors = expansion.errors
    try:
        config = BenchConfig.model_validate(tables)
    except ValidationError as error:
        faults = translate(error, source, tables, BenchConfig)
        raise_all(errors + [item for item in faults if not expansion.failed_at(item.key)])
    if errors:
        raise_all(errors)
    if errors := cross_faults(config, source):
        raise_all(errors)
    return config.named(source)


def load_controller(path: Path, named_by: NamedBy | None = None) -> ControllerSection:
    """Load the controller file at ``path``. Raises BadInput or BadInputs."""
    tables = dict(read_toml(path, "controller file", named_by))
    if isinstance(tables.get("controller"), Mapping):
        tables["controller"] = own_code_at(tables["controller"], path.parent)
    return validated(ControllerFile, tables, str(path)).controller


def own_code_at(tables: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """Return a controller's or compensator's table with its user class named from here.

    Kinds that an installed package provides under the entry point group :data:`ENTRY_POINTS` are classes too;
    none is imported for this.
    """
    own = dict(tables)
    if "object" not in own and (shipped := shipped_kinds().get(str(own.get("kind")))) is not None:
        own |= {"kind": "python", "object": shipped}
    name = own.get("object")
    if isinstance(name, str) and ".py:" in name:
        own["object"] = str(folder / name)
    return own


@cache
def shipped_kinds() -> dict[str, str]:
    """Return kinds of installed packages, and the places of their classes. Searching all packages takes 4
    ms."""
    return {each.name: each.value for each in entry_points(group=ENTRY_POINTS)}


def with_controllers(config: BenchConfig, asked: Sequence[str]) -> BenchConfig:
    """Return the bench with other controllers, each AXIS=FILE.py:NAME, AXIS=MODULE:NAME or AXIS=FILE.toml.

    Raises BadInput or BadInputs.
    """
    drives = dict(config.drive)
    for text in asked:
        axis, _, name = text.partition("=")
        if axis not in drives or not name:
            expected = "AXIS=FILE.py:NAME, AXIS=MODULE:NAME or AXIS=FILE.toml"
            remedy = f"the axes of this bench: {', '.join(config.axes)}"
            raise BadInput("--controller", "", text, expected, remedy)
        if name.endswith(".py"):
            raise BadInput("--controller", "", text, f"the class too: {text}:NAME")
        if name.endswith(".toml"):
            controller = load_controller(Path(name), NamedBy("--controller", "", text))
        else:
            tables = {"controller": {"kind": "python", "object": name}}
            controller = validated(ControllerFile, tables, "--controller").controller
        drives[axis] = drives[axis].model_copy(update={"controller": controller})
    return config.model_copy(update={"drive": drives})


def strategy_of(
    controller: Mapping[str, Any] | StateFeedbackController, source: str
) -> dict[str, Any] | None:
    """Return the compensator that a controller was made for; None if its file does not say. Raises BadInput.

    A table with other faults gives None too: its own errors are found later.
    """
    if isinstance(controller, Mapping):
        try:
            controller = StateFeedbackController.model_validate(controller)
        except ValidationError:
            return None
    made_for = controller.made_for
    if made_for is None or made_for.strategy is None:
        return None
    if made_for.strategy == "history":
        expected = "arrival or stamp: a reading on the bus carries one sample, history needs several"
        raise BadInput(source, "controller.made_for.strategy", made_for.strategy, expected)
    if made_for.strategy == "arrival":
        return {"kind": "arrival"}
    return {"kind": "stamp", "delay_us": made_for.agreed_delay_us}


_Reader = Callable[[Path, NamedBy], Any]
_FILES_OF_DRIVE: Final[Mapping[str, _Reader]] = {
    "motor": load_motor,
    "controller": load_controller,
    "commissioned": load_drive_file,
}
_FILES_OF_SIMULATION: Final = {"motor": load_motor, "believes": load_motor, "like": load_drive_model}
_FILES_OF_CURRENT_CONTROL: Final[Mapping[str, _Reader]] = {
    "controller": partial(load_current_controller, axis="q"),
    "controller_d": partial(load_current_controller, axis="d"),
}


class _Expansion:
    """Replaces the paths in a bench file by the files' tables, and collects errors."""

    def __init__(self, source: str, folder: Path) -> None:
        self.errors: list[BadInput] = []
        self._failed_keys: list[str] = []
        self._source = source
        self._folder = folder

    def failed_at(self, key: str) -> bool:
        """Return True if ``key`` lies in a file that could not be loaded, whose errors are already known."""
        return any(key == failed or key.startswith(f"{failed}.") for failed in self._failed_keys)

    def bench(self, raw: Mapping[str, Any]) -> dict[str, Any]:
        tables = dict(raw)
        drives = tables.get("drive")
        if isinstance(drives, Mapping):
            tables["drive"] = {name: self._drive(name, drive) for name, drive in drives.items()}
        for table in ("reference", "load"):
            profiles = tables.get(table)
            if isinstance(profiles, Mapping):
                tables[table] = {
                    name: self._entries(f"{table}.{name}", found) for name, found in profiles.items()
                }
        faults = tables.get("faults")
        if faults is not None:
            tables["faults"] = self._attempt("faults", lambda: self._faults(faults))
        return tables

    def _entries(self, key: str, entries: Any) -> Any:
        """Expand the entries of a reference or a load, with their files. A load is a step by default."""
        if not isinstance(entries, list | tuple):
            return entries
        expanded = []
        for index, entry in enumerate(entries):
            if isinstance(entry, Mapping):
                if key.startswith("load."):
                    entry = {"kind": "step", **entry}
                name = entry.get("path")
                if entry.get("kind") == "file" and isinstance(name, str):
                    named_by, path = NamedBy(self._source, f"{key}[{index}].path", name), self._folder / name
                    self._attempt(f"{key}[{index}]", partial(load_signal, path, named_by))
                    entry = {**entry, "path": str(path)}
            expanded.append(entry)
        return expanded

    def _drive(self, name: str, drive: Any) -> Any:
        if not isinstance(drive, Mapping):
            return drive
        tables = self._files_in(f"drive.{name}", drive, _FILES_OF_DRIVE)
        for part in ("controller", "compensator"):
            if isinstance(tables.get(part), Mapping):
                tables[part] = own_code_at(tables[part], self._folder)
        simulation = tables.get("simulation")
        if isinstance(simulation, Mapping):
            key = f"drive.{name}.simulation"
            tables["simulation"] = self._files_in(key, simulation, _FILES_OF_SIMULATION)
        for table in (tables, tables.get("simulation")):
            if isinstance(table, dict) and isinstance(table.get("eds"), str):
                table["eds"] = str(self._folder / table["eds"])
        controller = tables.get("controller")
        if "compensator" not in tables and isinstance(controller, Mapping | StateFeedbackController):
            made_for = self._attempt(
                f"drive.{name}.controller", partial(strategy_of, controller, self._source)
            )
            if made_for is not None:
                tables["compensator"] = made_for
        control = tables.get("current_control")
        if isinstance(control, Mapping):
            key = f"drive.{name}.current_control"
            tables["current_control"] = self._files_in(key, control, _FILES_OF_CURRENT_CONTROL)
        return tables

    def _files_in(self, key: str, table: Mapping[str, Any], readers: Mapping[str, _Reader]) -> dict[str, Any]:
        """Return ``table`` with the files that its keys name in place of their paths."""
        tables = dict(table)
        for part, read in readers.items():
            value = tables.get(part)
            if isinstance(value, str):
                named_by = NamedBy(self._source, f"{key}.{part}", value)
                tables[part] = self._attempt(named_by.key, partial(read, self._folder / value, named_by))
        return tables

    def _faults(self, tables: Any) -> Faults:
        if not isinstance(tables, Mapping):
            raise BadInput(self._source, "faults", shown(tables), "a table")
        if "plan" not in tables:
            return faults_from(tables, self._source, "faults")
        name = tables["plan"]
        if not isinstance(name, str):
            raise BadInput(self._source, "faults.plan", name, "the path of a fault plan in quotes")
        if others := sorted(set(tables) - {"plan"}):
            expected = "either plan or the plan's own tables"
            raise BadInput(self._source, "faults", f"plan and {', '.join(others)}", expected)
        path = self._folder / name
        return load_faults(path, NamedBy(self._source, "faults.plan", name))

    def _attempt(self, key: str, load: Callable[[], Any]) -> Any:
        try:
            return load()
        except BenchError as error:
            self.errors.extend(bad_inputs_of(error))
            self._failed_keys.append(key)
            return None


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
        """Replace a drive's file, or its preset, by its tables and return them."""
        if path[0] == "drive" and path[-1] in _FILES_OF_SIMULATION and could_name_a_preset(name):
            return {"preset": name}
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
