"""The controllers and compensators of a run: made before anything moves; what its recording keeps of them."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from drivers.errors import BadInput
from hil.configuration.config import BenchConfig
from hil.configuration.controller_kinds import ArrivalCompensator, OwnCode
from hil.control.own_code import source_of
from hil.execution.assembly import setup_of
from hil.execution.kept_signals import keep_copy
from hil.loop.axis_roles import Compensator, Controller


@dataclass(frozen=True, slots=True)
class AxisCode:
    """Of one axis."""

    controller: Controller
    compensator: Compensator
    own: Mapping[str, "KeptSource"] = field(default_factory=dict)
    """Classes of one's own, by their key in the bench file: controller, compensator."""


@dataclass(frozen=True, slots=True)
class KeptSource:
    """The file of a class of one's own."""

    name: str
    """Of the class, as the bench file has it."""
    file: Path
    digest: str
    """BLAKE2b, 128 bit, hex."""


def axis_code(
    config: BenchConfig, given: Mapping[str, Controller], *, real_time: bool
) -> dict[str, AxisCode]:
    """Of every axis; ``given``: by axis, a controller in place of the bench's.

    It runs code of one's own, if the bench names any. Raises BadInput.
    """
    return {name: _of_axis(config, name, given.get(name), real_time) for name in config.axes}


def _of_axis(config: BenchConfig, name: str, given: Controller | None, real_time: bool) -> AxisCode:
    drive, setup = config.drive[name], setup_of(config, name, real_time=real_time)
    sections = {"compensator": drive.compensator} if given else _sections(config, name)
    own = {key: _kept(config, name, key, part) for key, part in sections.items() if isinstance(part, OwnCode)}
    controller = given or drive.controller.build(setup)
    observer = controller.observer()
    if observer is None:
        return AxisCode(controller, drive.compensator.build(setup), own)
    if not isinstance(drive.compensator, ArrivalCompensator):
        expected = "none, as the controller has its own"
        raise BadInput(setup.source, f"drive.{name}.compensator", drive.compensator.kind, expected)
    return AxisCode(controller, observer, own)


def _sections(config: BenchConfig, name: str) -> dict[str, object]:
    drive = config.drive[name]
    return {"controller": drive.controller, "compensator": drive.compensator}


def _kept(config: BenchConfig, name: str, key: str, part: OwnCode) -> KeptSource:
    try:
        file, digest = source_of(part.object)
    except ValueError as error:
        expected = "MODULE:NAME of an installed module, or FILE.py:NAME of a file beside the bench file"
        raise BadInput(
            config.source or "bench", f"drive.{name}.{key}.object", part.object, expected, str(error)
        ) from error
    return KeptSource(part.object, file, digest)


def kept_name(axis: str, key: str) -> str:
    """Of the copy in the recording's folder."""
    return f"{axis}-{key}.py"


def keep_sources(code: Mapping[str, AxisCode], folder: Path) -> None:
    """Copy the files into the recording. Raises RecordingFailed."""
    for axis, each in code.items():
        for key, kept in each.own.items():
            keep_copy(kept.file, folder / kept_name(axis, key))


def with_kept_sources(config: BenchConfig, code: Mapping[str, AxisCode]) -> BenchConfig:
    """The bench as its recording has it: with the copies in place of what it names."""
    drives = dict(config.drive)
    for axis, each in code.items():
        for key, kept in each.own.items():
            section = getattr(drives[axis], key)
            name = f"{kept_name(axis, key)}:{kept.name.rpartition(':')[2]}"
            drives[axis] = drives[axis].model_copy(update={key: section.model_copy(update={"object": name})})
    return config.model_copy(update={"drive": drives})


def channels_of(code: Mapping[str, AxisCode]) -> dict[str, tuple[str, ...]]:
    """Names of the values that controllers tell of their own, by axis; axes without are left out."""
    named = {axis: tuple(each.controller.channels()) for axis, each in code.items()}
    return {axis: names for axis, names in named.items() if names}


def sources_text(code: Mapping[str, AxisCode]) -> str:
    """For the recording's metadata: what ran, JSON."""
    return json.dumps(
        {
            f"{axis}.{key}": {"object": kept.name, "blake2b": kept.digest}
            for axis, each in code.items()
            for key, kept in each.own.items()
        }
    )
