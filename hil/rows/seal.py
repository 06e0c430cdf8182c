"""The seal of a recording: digests of its files, piece by piece as they grew, each chained to the previous
one.

A line of the file ``seal`` is a piece of a file, or says that the recording has ended, or that the rest was
sealed by ``hil recover``, not by the recorder:

    {"file": "records.arrow", "begin": 0, "end": 41008, "rows": 1000, "digest": "...", "chain": "..."}
    {"ended": true, "chain": "..."}
    {"recovered": true, "chain": "..."}

``digest``: BLAKE2b, 128 bit, of the bytes from ``begin`` to ``end``. ``chain``: of the chain of the line
before and this line up to its chain. ``rows``: cycle records from the begin of the file to there. It proves
that the files were recorded together; somebody who forges all of them can forge a seal too.
"""

import json
import re
from bisect import bisect_left, bisect_right
from collections.abc import Iterator, Mapping
from hashlib import blake2b
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple

from servobench.drivers.bounded_file import read_lines
from servobench.drivers.errors import BadInput
from servobench.hil.rows.run_files import (
    BENCH_FILE,
    DIRECTIONS_FILE,
    EVENTS_FILE,
    FAULTS_FILE,
    FORMAT,
    FRAMES_FILE,
    FRAMES_LOG,
    INDEX_FILE,
    LOAD_FILE,
    RECORDS_FILE,
    RERUN_FILE,
    SEAL_FILE,
    SUMMARY_FILE,
    UNSEALED_FORMAT_MAX,
    not_a_recording,
)

FIRST_CHAIN: Final = "servobench"
"""In place of a chain before the first line."""
OLDER: Final = "unsealed: recorded by an older version"
SEALED: Final = "sealed"
NOT_CHECKED: Final = "unsealed: requested by --unsealed"
READ: Final = frozenset(
    {
        BENCH_FILE, RECORDS_FILE, EVENTS_FILE, FRAMES_FILE, FRAMES_LOG, DIRECTIONS_FILE, INDEX_FILE,
        FAULTS_FILE, LOAD_FILE, RERUN_FILE, SUMMARY_FILE,
    }
)  # fmt: skip
"""Files read from a recording: none of them may exist without a piece of the seal."""
ENDED: Final = "ended"
RECOVERED: Final = "recovered"
_DIGEST_BYTES: Final = 16
_BLOCK_BYTES: Final = 1 << 20
SMALL_BYTES: Final = 1 << 22
"""Size of a file that costs nothing to check: 5 ms."""
_LINE: Final = re.compile(r'(\{.*), "chain": "([0-9a-f]{32})"\}\n')
_SHOWN: Final = "--unsealed shows what can be read of it"
_ENDED_BY_RECOVER: Final = f"hil recover ends it; {_SHOWN}"


def doubt(seal: str) -> str:
    """Return a suffix for a line based on a recording; empty if that is sealed."""
    return "" if seal == SEALED else f"; {seal}"


class Piece(NamedTuple):
    """A piece of a file."""

    file: str
    begin: int
    end: int
    rows: int | None
    digest: str


def sealed_line(plain: dict[str, Any], before: str) -> tuple[str, str]:
    """Return a line, and its chain; ``before``: that of the previous line."""
    text = json.dumps(plain)[:-1]
    chain = _chained(text, before)
    return f'{text}, "chain": "{chain}"}}\n', chain


def _chained(text: str, before: str) -> str:
    return blake2b(f"{before}{text}".encode(), digest_size=_DIGEST_BYTES).hexdigest()


def digest_of(file: BinaryIO, begin: int, end: int) -> str:
    """Return the digest of a file's bytes from ``begin`` to ``end``, or to its end if that comes first."""
    digest = blake2b(digest_size=_DIGEST_BYTES)
    file.seek(begin)
    while begin < end and (block := file.read(min(_BLOCK_BYTES, end - begin))):
        digest.update(block)
        begin += len(block)
    return digest.hexdigest()


def read_seal(
    folder: Path, remedy: str = _SHOWN, cut_remedy: str = _ENDED_BY_RECOVER
) -> Iterator[tuple[Piece | str, str]]:
    """Yield its pieces, :data:`ENDED` and :data:`RECOVERED`, each with its chain.

    Raises BadInput for a line outside the chain, or of no known form, with ``remedy``; for an incomplete last
    line, which a kill leaves, with ``cut_remedy``.
    """
    path, chain = folder / SEAL_FILE, FIRST_CHAIN
    for number, line in enumerate(read_lines(path, "seal"), 1):
        if not line.endswith("\n"):
            expected = "a whole last line: a kill leaves an incomplete one"
            raise BadInput(str(path), f"line {number}", line[:60], expected, cut_remedy)
        match = _LINE.fullmatch(line)
        if match is None or _chained(match[1], chain) != match[2]:
            raise BadInput(str(path), f"line {number}", line[:60], "a line of the chain", remedy)
        chain, meaning = match[2], _meaning(match[1] + "}")
        if not meaning:
            raise BadInput(str(path), f"line {number}", line[:60], "a piece of a file, or an end", remedy)
        yield meaning, chain


def _meaning(text: str) -> Piece | str:
    """Parse a line without its chain; empty: invalid, as the chain alone does not prove its origin."""
    try:
        plain = json.loads(text)
    except (ValueError, RecursionError):
        return ""
    match plain:
        case {"file": str(file), "begin": int(begin), "end": int(end), "digest": str(digest), **more}:
            rows = more.pop("rows", None)
            beside = not file.startswith("/") and ".." not in file.split("/")
            if more or not beside or not 0 <= begin <= end or not isinstance(rows, int | None):
                return ""
            return Piece(file, begin, end, rows, digest)
        case {"ended": True} | {"recovered": True} if len(plain) == 1:
            return str(next(iter(plain)))
    return ""


def has_seal(metadata: Mapping[str, str]) -> bool:
    """Return whether a recording of this format, by the metadata of its records, was made with a seal; of a
    later one it is not known."""
    told = metadata.get("format", "")
    return told.isdecimal() and UNSEALED_FORMAT_MAX < int(told) <= int(FORMAT)


def seal_of(folder: Path, *, unsealed: bool) -> str:
    """Check the seal of any folder first; see :func:`check_seal`; ``unsealed``: skip the check.

    Empty for a folder that holds no recording of a run. Raises BadInput.
    """
    if not is_recording(folder):
        return ""
    return NOT_CHECKED if unsealed else check_seal(folder)


def is_recording(folder: Path) -> bool:
    """Return True if the folder holds the recording of a run, which must have a seal."""
    return any((folder / name).exists() for name in (BENCH_FILE, RECORDS_FILE, SEAL_FILE))


def check_seal(folder: Path) -> str:
    """Check the files of a recording against its seal; return :data:`SEALED`, up to where, or :data:`OLDER`.

    Raises BadInput, naming file and place, for any change since the recording.
    """
    sealed = SealedFiles(folder)
    sealed.check_all()
    return sealed.told


class SealedFiles:
    """The files of a recording, checked against its seal piece by piece: all, or only those read.

    Every method raises BadInput, naming file and place, for any change since the recording.
    """

    def __init__(self, folder: Path) -> None:
        """Check the seal itself, and that each file exists."""
        self._folder = folder
        self._pieces: dict[str, list[Piece]] = {}
        self._checked: set[Piece] = set()
        self.told = SEALED
        """SEALED, or up to where, or :data:`OLDER`, which has no seal to check."""
        if not (folder / SEAL_FILE).is_file():
            from servobench.hil.rows.records_file import read_metadata  # pyarrow, which no loop needs

            records = folder / RECORDS_FILE  # who reads it refuses a later format
            if records.is_file() and not has_seal(read_metadata(records)):
                self.told = OLDER
                return
            if not records.is_file():
                raise not_a_recording(folder, RECORDS_FILE)
            raise BadInput(str(folder), "", f"no file {SEAL_FILE}", "a recording with its seal", _SHOWN)
        ended, rows = False, 0
        for piece, _ in read_seal(folder):
            ended = piece == ENDED
            if isinstance(piece, Piece):
                self._pieces.setdefault(piece.file, []).append(piece)
                rows = piece.rows or rows
            elif piece == RECOVERED:
                self.told = f"{SEALED} up to row {rows} of {RECORDS_FILE}; the rest was found by hil recover"
        if not ended:
            expected = "the end of the recording"
            raise BadInput(str(folder / SEAL_FILE), "", "no last line", expected, _ENDED_BY_RECOVER)
        for name in sorted(READ - self._pieces.keys()):
            if (folder / name).exists():
                raise BadInput(str(folder / name), "", "a file", "none: the recording had none", _SHOWN)
        for name in self._pieces:
            if not (folder / name).is_file():
                raise BadInput(str(folder / name), "", "no file", "one as it was recorded", _SHOWN)

    def check_all(self) -> None:
        """Check each file to its end."""
        for name, pieces in self._pieces.items():
            self._check(name, pieces)
            self._check_length(name)

    def check_small(self) -> None:
        """Check the small files; of each longer one its length, as the rest is checked where it is read."""
        for name, pieces in self._pieces.items():
            if pieces[-1].end <= SMALL_BYTES:
                self.check(name)
            self._check_length(name)

    def check_ends(self, name: str) -> None:
        """Check the first and the last piece of a file, which describe an Arrow file."""
        if pieces := self._pieces.get(name):
            self.check(name, 0, 1)
            self.check(name, pieces[-1].begin)

    def check(self, name: str, begin: int = 0, end: int | None = None) -> None:
        """Check the pieces of a file that contain bytes ``begin`` to ``end``; to its end if ``end`` is
        None."""
        pieces = self._pieces.get(name, [])
        first = bisect_right(pieces, begin, key=lambda piece: piece.end)
        last = len(pieces) if end is None else bisect_left(pieces, end, key=lambda piece: piece.begin)
        fresh = [piece for piece in pieces[first:last] if piece not in self._checked]
        if fresh:
            self._check(name, fresh, pieces[first - 1].rows if first else 0)
            self._checked.update(fresh)

    def _check(self, name: str, pieces: list[Piece], rows: int | None = 0) -> None:
        rows = rows or 0
        with (self._folder / name).open("rb") as file:
            for piece in pieces:
                if (now := digest_of(file, piece.begin, piece.end)) != piece.digest:
                    counted = piece.rows is not None and piece.rows > rows
                    place = (
                        f"rows {rows + 1} to {piece.rows}"
                        if counted
                        else f"bytes {piece.begin} to {piece.end}"
                    )
                    path, expected = str(self._folder / name), f"{piece.digest}, as recorded"
                    raise BadInput(path, place, f"BLAKE2b {now}", expected, _SHOWN)
                rows = piece.rows or rows

    def _check_length(self, name: str) -> None:
        path, end = self._folder / name, self._pieces[name][-1].end
        if more := path.stat().st_size - end:
            told = f"{abs(more)} bytes {'more' if more > 0 else 'less'}"
            raise BadInput(str(path), "", told, f"its end at byte {end}", _SHOWN)
