"""Prepares the recording of a bench: its plan, and copies of the user's files.

With copies of data sheets, of the files of references and loads, and of user code a recording can repeat its
run by itself.
"""

import json
import shutil
from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path

from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.drivers.timebase import NS_PER_US, duration_s
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.configuration.config_axis import DriveConfig
from servobench.hil.configuration.references import Load, Reference, SignalFile
from servobench.hil.execution.assembly import AxisCode
from servobench.hil.recording.logger_process import RecordingFailed
from servobench.hil.rows.recording_plan import (
    AxisPlan,
    CertifiedPlan,
    ObservedDrive,
    ObservedSignal,
    PlannedSetPoint,
    RecordingPlan,
    ReviewPlan,
)
from servobench.hil.verdict.metrics import VerdictLimits


def _kept_bench(config: BenchConfig, code: Mapping[str, AxisCode]) -> tuple[BenchConfig, dict[str, Path]]:
    """Return the bench of the recording, with copies in place of the files that it names; and those files, by
    the names of their copies."""
    files: dict[str, Path] = {}
    drives = dict(config.drive)
    for axis, each in code.items():
        for key, own in each.own.items():
            name = f"{axis}-{key}.py"
            files[name] = own.file
            _, _, class_name = own.name.rpartition(":")
            kept = getattr(drives[axis], key).model_copy(update={"object": f"{name}:{class_name}"})
            drives[axis] = drives[axis].model_copy(update={key: kept})
    for axis, drive in drives.items():
        simulation = drive.simulation
        kept_sheets: dict[str, object] = {"eds": _kept_sheet(drive.eds, f"{axis}-eds", files)}
        simulated = _kept_sheet(simulation.eds, f"{axis}-simulation-eds", files)
        kept_sheets["simulation"] = simulation.model_copy(update={"eds": simulated})
        drives[axis] = drive.model_copy(update=kept_sheets)
    tables: dict[str, object] = {"drive": drives}
    for table in ("reference", "load"):
        tables[table] = {
            axis: tuple(
                _kept(entry, f"{axis}-{table}-{number}", files) for number, entry in enumerate(entries)
            )
            for axis, entries in getattr(config, table).items()
        }
    return config.model_copy(update=tables), files


def _kept_sheet(path: str | None, name: str, files: dict[str, Path]) -> str | None:
    """Return the name of a data sheet's copy, and note it."""
    if path is None:
        return None
    copy = f"{name}{Path(path).suffix}"
    files[copy] = Path(path)
    return copy


def _kept(entry: Reference | Load, name: str, files: dict[str, Path]) -> Reference | Load:
    """Return an entry with the copy in place of its file, and note it."""
    if not isinstance(entry, SignalFile):
        return entry
    path = Path(entry.path)
    files[f"{name}{path.suffix}"] = path
    return entry.model_copy(update={"path": f"{name}{path.suffix}"})


def keep_files(config: BenchConfig, code: Mapping[str, AxisCode], folder: Path) -> None:
    """Copy the files that the bench names into the recording. Raises RecordingFailed."""
    _, files = _kept_bench(config, code)
    for name, file in files.items():
        try:
            shutil.copyfile(file, folder / name)
        except OSError as error:
            raise RecordingFailed(f"{folder / name}: {error.strerror}") from error


def review_plan(
    config: BenchConfig, certified: Mapping[str, CertifiedPlan], *, real_time: bool
) -> ReviewPlan:
    """Return the plan for figures and verdict of a run of the bench.

    ``certified``: of the axes whose controllers have certificates.
    """
    axes = tuple(
        AxisPlan(
            name,
            drive.limits.torque_max_nm / drive.motor.parameters.inertia_kg_m2,
            drive.motor.parameters.rated_torque_nm,
            certified.get(name),
            drive.limits.torque_max_nm,
            drive.limits.speed_max_rpm * RAD_S_PER_RPM,
            config.quantity(name).value,
            drive.mode,
        )
        for name, drive in sorted(config.drive.items())
    )
    return ReviewPlan(
        axes,
        _limits(config, certified.values(), real_time),
        config.verdict.settling,
        config.verdict.settling_band_percent,
        config.loop.period,
    )


def recording_plan(
    config: BenchConfig,
    folder: Path | None,
    code: Mapping[str, AxisCode],
    certified: Mapping[str, CertifiedPlan],
    *,
    real_time: bool,
) -> RecordingPlan:
    """Return the plan of a recording of the bench.

    ``folder``: None if no files are to be kept. ``certified``: of the axes whose controllers have
    certificates.
    """
    kept, _ = _kept_bench(config, code)
    channels = {axis: tuple(each.controller.channels()) for axis, each in code.items()}
    sources = {
        f"{axis}.{key}": {"object": own.name, "blake2b": own.digest}
        for axis, each in code.items()
        for key, own in each.own.items()
    }
    return RecordingPlan(
        folder=folder,
        name=config.bench.name,
        seed=config.bench.seed,
        bus=config.bus.spec,
        real_time=real_time,
        deadline=config.loop.deadline,
        review=review_plan(config, certified, real_time=real_time),
        bench_toml="" if folder is None else kept.resolved_text(),
        frames=config.recording.frames,
        segments=tuple(segment.name for segment in config.bus.segment),
        faults=config.faults is not None,
        period_us=config.loop.period_us,
        set_points=_set_points(config),
        channels={axis: names for axis, names in channels.items() if names},
        observed=_observed_drives(config),
        sources=json.dumps(sources),
        notes=_notes(config),
    )


def _observed_drives(config: BenchConfig) -> dict[str, ObservedDrive]:
    """Return the objects that drives send for the recording alone."""
    segments = [None, *(segment.name for segment in config.bus.segment)]
    return {
        axis: ObservedDrive(
            drive.node,
            segments.index(drive.segment),
            tuple(
                ObservedSignal(each.key, each.entry.code, each.title, each.told_unit, each.factor)
                for each in drive.observe
            ),
            drive.observe_every_cycles * config.loop.period_us * NS_PER_US,
        )
        for axis, drive in sorted(config.drive.items())
        if drive.observe
    }


def _notes(config: BenchConfig) -> dict[str, str]:
    """Return notes to show with the verdict, for each axis if they differ."""
    drives = {axis: config.drive[axis] for axis in config.axes}
    notes: dict[str, dict[str, str]] = {
        "motor": {axis: drive.motor.motor.name for axis, drive in drives.items()},
        "controller": {axis: drive.controller.kind for axis, drive in drives.items()},
        "compensator": {axis: drive.compensator.kind for axis, drive in drives.items()},
        "current loops": {axis: _current_loops(drive) for axis, drive in drives.items()},
    }
    shown = {key: _by_axis(by_axis) for key, by_axis in notes.items() if any(by_axis.values())}
    return {"bus": config.bus.spec, **shown}


def _current_loops(drive: DriveConfig) -> str:
    """Describe a simulated drive's current loops, if they are not its PI loops."""
    loops = drive.current_control
    own = {"q": loops.controller, "d": loops.controller_d}
    return ", ".join(f"{axis} {each.kind}" for axis, each in own.items() if each is not None)


def _by_axis(told: Mapping[str, str]) -> str:
    if len(set(told.values())) == 1:
        return next(iter(told.values()))
    return ", ".join(f"{axis} {text or '-'}" for axis, text in told.items())


def _limits(config: BenchConfig, certified: Collection[CertifiedPlan], real_time: bool) -> VerdictLimits:
    """Return the bench file's limits, with the torque limits of the controllers' files; the smallest of
    several.

    The controllers' computing time is judged only where the drives wait for it.
    """
    limits = config.verdict.limits
    asked = [limits.torque_rms_nm_max, *(plan.torque_rms_nm_max for plan in certified)]
    return replace(
        limits if real_time else replace(limits, compute_us_max=None),
        torque_rms_nm_max=min((each for each in asked if each is not None), default=None),
    )


def _set_points(config: BenchConfig) -> tuple[PlannedSetPoint, ...]:
    """Return the planned references and loads of each axis, in words."""
    planned: list[PlannedSetPoint] = []
    for number, axis in enumerate(config.axes):
        profiles = (("reference", config.reference.get(axis, ())), ("load", config.load.get(axis, ())))
        for what, entries in profiles:
            for entry in entries:
                text = f"{axis}: {what} {entry.describe()}"
                planned.append(PlannedSetPoint(duration_s(entry.at_s), number, text))
                if isinstance(entry, SignalFile) and not entry.repeats:
                    text = f"{axis}: {what} of {Path(entry.path).name} ends"
                    planned.append(PlannedSetPoint(duration_s(entry.ends_s), number, text))
    return tuple(sorted(planned))
