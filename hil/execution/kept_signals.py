"""The files of references and loads: what a recording keeps of them, so that it repeats its run by itself."""

import shutil
from collections.abc import Iterator
from pathlib import Path

from hil.configuration.config import BenchConfig
from hil.configuration.references import SignalFile
from hil.recording.logger_process import RecordingFailed

_TABLES = ("reference", "load")


def _name(table: str, axis: str, number: int, path: str) -> str:
    """Of the copy in the recording's folder."""
    return f"{axis}-{table}-{number}{Path(path).suffix}"


def keep_signals(config: BenchConfig, folder: Path) -> None:
    """Copy the files into the recording. Raises RecordingFailed."""
    for table, axis, number, entry in _files(config):
        keep_copy(Path(entry.path), folder / _name(table, axis, number, entry.path))


def keep_copy(file: Path, place: Path) -> None:
    """Into the recording. Raises RecordingFailed."""
    try:
        shutil.copyfile(file, place)
    except OSError as error:
        raise RecordingFailed(f"{place}: {error.strerror}") from error


def with_kept_signals(config: BenchConfig) -> BenchConfig:
    """The bench as its recording has it: with the copies in place of what it names."""
    tables = {table: dict(getattr(config, table)) for table in _TABLES}
    for table, axis, number, entry in _files(config):
        entries = list(tables[table][axis])
        entries[number] = entry.model_copy(update={"path": _name(table, axis, number, entry.path)})
        tables[table][axis] = tuple(entries)
    return config.model_copy(update=tables)


def _files(config: BenchConfig) -> Iterator[tuple[str, str, int, SignalFile]]:
    for table in _TABLES:
        for axis, entries in getattr(config, table).items():
            for number, entry in enumerate(entries):
                if isinstance(entry, SignalFile):
                    yield table, axis, number, entry
