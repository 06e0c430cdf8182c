"""Writes the seal of a recording while its files grow, see :mod:`servobench.hil.rows.seal`."""

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

from servobench.hil.recording.append_file import AppendFile
from servobench.hil.rows.run_files import LOGGER_LOG, PRINTED_FILE, RECORDS_FILE, RESERVE_FILE, SEAL_FILE
from servobench.hil.rows.seal import ENDED, FIRST_CHAIN, Piece, digest_of, read_seal, sealed_line

_LEFT_OUT: Final = frozenset({SEAL_FILE, RESERVE_FILE, LOGGER_LOG, PRINTED_FILE})
"""Files written beside the recording, as long as the processes live."""
_PASSING: Final = (".tail", ".part")
"""Endings of files that are gone when a recording has ended."""


class Sealer:
    """Takes what is new in the files of a folder. Every method may raise OSError."""

    def __init__(self, folder: Path, *, fresh: bool = True) -> None:
        """``fresh``: a new recording; else it goes on behind the last whole line. Raises BadInput for a seal
        that is damaged."""
        self._folder = folder
        self._chain = FIRST_CHAIN
        self._ends: dict[str, int] = {}
        self._file = AppendFile(folder / SEAL_FILE, fresh=fresh)
        for piece, chain in () if fresh else read_seal(folder):
            self._chain = chain
            if isinstance(piece, Piece):
                self._ends[piece.file] = piece.end

    def grow(self, names: Iterable[str], rows: int = 0, *, empty: bool = False) -> None:
        """A piece of each of these files that is there and has grown, of new ones also if they are ``empty``;
        ``rows``: those in records.arrow."""
        lines = []
        for name in names:
            begin, path = self._ends.get(name, 0), self._folder / name
            size = path.stat().st_size if path.is_file() else -1
            if size <= begin and not (empty and size == 0 and name not in self._ends):
                continue
            with path.open("rb") as file:
                digest = digest_of(file, begin, size)
            counted = {"rows": rows} if name == RECORDS_FILE and rows else {}
            piece = {"file": name, "begin": begin, "end": size, **counted, "digest": digest}
            lines.append(self._line(piece))
            self._ends[name] = size
        if lines:
            self._file.write("".join(lines).encode())

    def mark(self, what: str) -> None:
        """:data:`servobench.hil.rows.seal.RECOVERED` or :data:`servobench.hil.rows.seal.ENDED`."""
        self._file.write(self._line({what: True}).encode())

    def finish(self, rows: int = 0) -> None:
        """All files of the folder, and that it was the end."""
        names = sorted(entry.name for entry in os.scandir(self._folder) if entry.is_file())
        self.grow(
            [name for name in names if name not in _LEFT_OUT and not name.endswith(_PASSING)],
            rows,
            empty=True,
        )
        self.mark(ENDED)
        self._file.close()

    def _line(self, plain: dict[str, Any]) -> str:
        line, self._chain = sealed_line(plain, self._chain)
        return line
