"""The seal of a campaign's store: a line for each version of each of its files, chained as in a recording's.

A file is written beside its place, its line into the seal, and then it is put in its place: who dies in
between leaves both, and who goes on puts it there. A campaign that is left in order ends its seal.
"""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

from servobench.drivers.errors import BadInput
from servobench.hil.machine.on_disk import sync_folder, write_synced
from servobench.hil.recording.append_file import AppendFile
from servobench.hil.rows.run_files import SEAL_FILE
from servobench.hil.rows.seal import ENDED, FIRST_CHAIN, Piece, digest_of, read_seal, sealed_line

SUFFIX: Final = ".writing"
_RESTORE: Final = "restore it, or begin a campaign in a folder of its own with --out"
_GOES_ON: Final = "--resume goes on with it"


class StoreSeal:
    """Writes the files of a store; its folder is locked meanwhile."""

    def __init__(self, folder: Path, *, fresh: bool) -> None:
        """``fresh``: a new store. Raises BadInput for a damaged seal."""
        self._folder = folder
        self._chain, self._ended = FIRST_CHAIN, False
        self.cut_short = ""
        """How the seal ended if no campaign had ended it; empty: it was left in order."""
        if not fresh:
            _require_seal(folder)
        size = 0 if fresh else (folder / SEAL_FILE).stat().st_size
        self._file = AppendFile(folder / SEAL_FILE, fresh=fresh)
        last = None
        for last, chain in () if fresh else read_seal(folder, _RESTORE):
            self._chain, self._ended = chain, last == ENDED
        if not fresh and not self._ended:
            whole = size == (folder / SEAL_FILE).stat().st_size
            self.cut_short = "no last line" if whole else "an incomplete last line"
        if isinstance(last, Piece):
            beside = (folder / last.file).with_suffix(SUFFIX)
            if beside.is_file() and _digest(beside) == last.digest:
                self._put_in_place(beside, last.file)

    def put(self, name: str, data: bytes) -> None:
        """Write a file, or its next version. Error: OSError."""
        beside = (self._folder / name).with_suffix(SUFFIX)
        with beside.open("wb") as file:
            write_synced(file, data)
        self._write({"file": name, "begin": 0, "end": len(data), "digest": _digest(beside)})
        self._put_in_place(beside, name)
        self._ended = False

    def close(self) -> None:
        """End the seal: everything is written. Error: OSError."""
        if not self._ended:
            self._write({ENDED: True})
        self._file.close()

    def _put_in_place(self, beside: Path, name: str) -> None:
        place = self._folder / name
        beside.rename(place)
        sync_folder(place.parent)

    def _write(self, plain: dict[str, Any]) -> None:
        line, self._chain = sealed_line(plain, self._chain)
        self._file.write(line.encode())
        self._file.sync()


def sealed_files(folder: Path, *, under_way: bool, among: str) -> Iterator[Path]:
    """Yield the files of a store in order of their first lines, each checked against its seal.

    ``under_way``: somebody writes to it, whose last file may not be in its place yet. ``among``: a pattern of
    names, of which none else may be there. Raises BadInput.
    """
    _require_seal(folder)
    versions: dict[str, list[str]] = {}
    last: Piece | str = ""
    for last, _ in read_seal(folder, _RESTORE, _GOES_ON):
        if isinstance(last, Piece):
            versions.setdefault(last.file, []).append(last.digest)
    if last != ENDED and not under_way:
        expected = "the end of a campaign that was left in order"
        raise BadInput(str(folder / SEAL_FILE), "", "no last line", expected, _GOES_ON)
    waiting = last.file if isinstance(last, Piece) and under_way else ""
    for path in sorted(folder.glob(among)):
        if str(path.relative_to(folder)) not in versions:
            raise BadInput(str(path), "", "a file", f"none: no line of {SEAL_FILE} has it", _RESTORE)
    for name, digests in versions.items():
        path = folder / name
        now = _digest(path) if path.is_file() else "no file"
        if now == digests[-1]:
            yield path
        elif name == waiting and now == ("no file" if len(digests) == 1 else digests[-2]):
            if len(digests) > 1:
                yield path
        else:
            raise BadInput(str(path), "", f"BLAKE2b {now}", f"{digests[-1]}, as it was written", _RESTORE)


def _require_seal(folder: Path) -> None:
    if not (folder / SEAL_FILE).is_file():
        expected = "a campaign with its seal: an older version had none"
        raise BadInput(str(folder / SEAL_FILE), "", "no file", expected, _RESTORE)


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return digest_of(file, 0, os.fstat(file.fileno()).st_size)
