"""The one reader for files that a user names: regular files only, with bounded size, depth and line length.

Every limit holds before a parser sees the text, so that no file can stop the parser or keep it busy; what
the parser has made of it is finite, fits 64 bits (TOML v1.0, "Integer") and can be printed.
"""

import difflib
import json
import math
import os
import re
import stat
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, NoReturn

from servobench.drivers.errors import BadInput, printable

SIZE_MAX_BYTES = 1_000_000
"""Far beyond any bench file; the parser takes less than a second for as much."""
LINE_MAX_BYTES = 4096
"""Ten times the longest line that a recording or a journal holds."""
DEPTH_MAX = 32
"""Nesting limit of tables and lists, and of parts in a dotted key; a bench file needs six. The parsers
recurse."""
WORD_MAX = 256
"""Characters in a key or number. Converting digits to an integer takes quadratic time, and CPython refuses
more than 4300."""
INTEGER_MIN, INTEGER_MAX = -(2**63), 2**63 - 1
"""The integer range of TOML v1.0."""

_TOKEN = re.compile(
    r"""(?P<text>\"\"\"|'''|"|')|(?P<comment>\#)|(?P<open>[\[{])|(?P<close>[\]}])|(?P<dot>\.)|(?P<gap>[,=:\n])"""
    rf"""|(?P<word>[\w+-]{{{WORD_MAX + 1}}})""",
    re.VERBOSE,
)
_REST_OF_TEXT = {
    '"""': re.compile(r'(?:[^\\"]|\\.|"(?!""))*+"""', re.DOTALL),
    "'''": re.compile(r"(?:[^']|'(?!''))*+'''"),
    '"': re.compile(r'(?:[^\\"\n]|\\.)*+"'),
    "'": re.compile(r"[^'\n]*+'"),
}
_LINE_END = re.compile(r"\n|\Z")


class NamedBy(NamedTuple):
    """Where a file was named: the place to blame if the file does not exist."""

    source: str
    """A file, or a command-line option."""
    key: str
    """Its key; empty for an option."""
    text: str
    """The text found there."""


@dataclass(eq=False)
class NoSuchFile(BadInput):
    """The named file does not exist: ``value`` is the path as written."""

    what: str = "file"
    """Its kind."""

    def __str__(self) -> str:
        kind = self.what[:1].upper() + self.what[1:]
        # The name of an argument, JOURNAL or MOTOR.toml, tells nothing that the kind of file does not.
        source = "" if self.source.partition(".")[0].isupper() and not self.key else self.source
        place = ": ".join(part for part in (source, self.key) if part and part != self.value)
        text = f"{place + ': ' if place else ''}{kind} not found: {self.value}"
        return printable(f"{text}; {self.remedy}" if self.remedy else text)


def read_bytes(
    path: Path, what: str, named_by: NamedBy | None = None, size_max_bytes: int = SIZE_MAX_BYTES
) -> bytes:
    """Return the contents of ``path``; ``what`` is the kind of file, for the message.

    Raises BadInput, and of it NoSuchFile.
    """
    with opened(path, what, named_by, size_max_bytes) as file:
        data = file.read(size_max_bytes + 1)
    if len(data) > size_max_bytes:
        _refuse_size(path, what, len(data), size_max_bytes)
    return data


def read_text(
    path: Path, what: str, named_by: NamedBy | None = None, size_max_bytes: int = SIZE_MAX_BYTES
) -> str:
    """Read ``path`` as UTF-8 text; otherwise like :func:`read_bytes`."""
    return _decoded(read_bytes(path, what, named_by, size_max_bytes), str(path), what, "")


def read_lines(
    path: Path, what: str, named_by: NamedBy | None = None, size_max_bytes: int = SIZE_MAX_BYTES
) -> Iterator[str]:
    """Yield the lines of ``path`` with their line ends, one by one: a long file is not held in memory."""
    with opened(path, what, named_by, size_max_bytes) as file:
        number = 0
        while line := file.readline(LINE_MAX_BYTES + 1):
            number += 1
            place = f"line {number}"
            if len(line) > LINE_MAX_BYTES:
                expected = f"at most {LINE_MAX_BYTES} bytes, as a {what} has"
                raise BadInput(str(path), place, "a longer line", expected)
            yield _decoded(line, str(path), what, place)


def read_toml(path: Path, what: str, named_by: NamedBy | None = None) -> dict[str, Any]:
    """Parse the TOML file ``path`` into a table. Raises BadInput."""
    if path.suffix == ".py" and path.is_file():
        raise BadInput(str(path), "", "a Python file", f"a {what}, in TOML")
    return parse_toml(read_text(path, what, named_by), str(path))


def parse_toml(text: str, source: str) -> dict[str, Any]:
    """Parse ``text``, read from the file ``source``, as TOML. Raises BadInput."""
    _check_form(text, source, "")
    try:
        tables = tomllib.loads(text)
    except ValueError as error:  # TOMLDecodeError, and a date that does not exist
        raise _no_toml(source, text, str(error)) from None
    _check_values(tables, source, "")
    return tables


def parse_json(text: str, source: str, what: str, place: str = "") -> Any:
    """Parse ``text``, found at ``place`` in the file ``source``, as JSON; ``what`` is what it should be.

    Raises BadInput.
    """
    _check_form(text, source, place)
    try:
        value = json.loads(text)
    except ValueError as error:
        raise BadInput(source, place, text[:60], what, str(error)) from None
    _check_values(value, source, place)
    return value


@contextmanager
def opened(path: Path, what: str, named_by: NamedBy | None, size_max_bytes: int) -> Iterator[BinaryIO]:
    """Open ``path`` for reading without blocking: opening a FIFO would wait for its writer."""
    blamed = named_by or NamedBy(str(path), "", "")
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    except (FileNotFoundError, NotADirectoryError):
        raise _no_such_file(path, what, blamed) from None
    except OSError as error:
        reason = error.strerror or str(error)
        raise BadInput(blamed.source, blamed.key, reason, f"a readable {what}", f"see {path}") from None
    except ValueError:  # a NUL in the name
        raise _no_such_file(path, what, blamed) from None
    try:
        status = os.fstat(descriptor)
        if not stat.S_ISREG(status.st_mode):
            kind = _kind(status.st_mode)
            inside = path / f"{what.split()[0]}.toml"
            remedy = f"did you mean {inside}?" if inside.is_file() else f"see {path}"
            raise BadInput(blamed.source, blamed.key, kind, f"a {what}, a regular file", remedy)
        if status.st_size > size_max_bytes:
            _refuse_size(path, what, status.st_size, size_max_bytes)
        with open(descriptor, "rb", closefd=False) as file:
            yield file
    finally:
        os.close(descriptor)


def _kind(mode: int) -> str:
    kinds = {
        stat.S_IFDIR: "a folder",
        stat.S_IFIFO: "a FIFO",
        stat.S_IFCHR: "a character device",
        stat.S_IFBLK: "a block device",
    }
    return kinds.get(stat.S_IFMT(mode), "no regular file")


def _refuse_size(path: Path, what: str, found_bytes: int, most_bytes: int) -> NoReturn:
    raise BadInput(str(path), "", f"{found_bytes} bytes", f"a {what} of at most {most_bytes} bytes")


def _decoded(data: bytes, source: str, what: str, place: str) -> str:
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        at = f"{place}, byte {error.start}" if place else f"byte {error.start}"
        raise BadInput(source, at, error.reason, f"a {what} in UTF-8") from None


def _no_such_file(path: Path, what: str, named_by: NamedBy) -> NoSuchFile:
    folder = path.parent
    siblings = (
        [item.name for item in folder.glob(f"*{path.suffix or '.toml'}")] if os.path.isdir(folder) else []
    )
    near = difflib.get_close_matches(path.name, siblings, n=1, cutoff=0.5)
    remedy = ""
    if near:
        remedy = f"did you mean {folder / near[0]}?"
    elif siblings:
        remedy = f"that folder holds {', '.join(sorted(siblings)[:6])}"
    elif not os.path.isdir(folder):
        remedy = f"there is no folder {folder}"
    return NoSuchFile(
        named_by.source, named_by.key, named_by.text or str(path), f"an existing {what}", remedy, what
    )


def _check_form(text: str, source: str, place: str) -> None:
    """Refuse brackets nested too deep, dotted keys with too many parts and words too long, in linear time.

    An unterminated string ends the check: the parser will not get past it either.
    """
    depth = dots = at = 0
    while (token := _TOKEN.search(text, at)) is not None:
        at, kind = token.end(), token.lastgroup
        if kind == "dot":
            dots += 1
        elif kind == "text" or kind == "comment":
            rest = _LINE_END if kind == "comment" else _REST_OF_TEXT[token[0]]
            end = rest.match(text, at) if kind == "text" else rest.search(text, at)
            if end is None:
                return
            at = end.end() if kind == "text" else end.start()
        else:
            depth += (kind == "open") - (kind == "close")
            dots = 0
        if kind == "word":
            what, expected = "a key or number without end", f"at most {WORD_MAX} characters"
        elif depth > DEPTH_MAX or dots > DEPTH_MAX:
            what, expected = "tables or lists in one another", f"at most {DEPTH_MAX} of them"
        else:
            continue
        line = f"line {text.count(chr(10), 0, token.start()) + 1}"
        raise BadInput(source, place or line, what, expected)


def _check_values(node: Any, source: str, place: str) -> None:
    """Refuse values that no key takes: integers beyond 64 bits, inf and nan, text with control characters."""
    waiting: list[tuple[str, Any]] = [(place, node)]
    while waiting:
        key, value = waiting.pop()
        if isinstance(value, dict):
            for name, item in value.items():
                if len(name) > WORD_MAX:
                    raise BadInput(source, key, f"a key of {len(name)} characters", f"at most {WORD_MAX}")
                waiting.append((f"{key}.{name}" if key else name, item))
        elif isinstance(value, list):
            waiting.extend((f"{key}[{index}]", item) for index, item in enumerate(value))
        elif isinstance(value, float) and not math.isfinite(value):
            raise BadInput(source, key, value, "a finite number")
        elif isinstance(value, int) and not INTEGER_MIN <= value <= INTEGER_MAX:
            raise BadInput(source, key, f"an integer of {value.bit_length()} bits", "one of at most 64 bits")
        elif isinstance(value, str) and printable(value) != value:
            raise BadInput(source, key, value[:60], "text without control characters")


def _no_toml(source: str, text: str, message: str) -> BadInput:
    place = re.search(r"line (\d+)", message)
    lines = text.splitlines()
    line = int(place.group(1)) if place else len(lines)
    at_fault = lines[line - 1].strip()[:60] if 0 < line <= len(lines) else ""
    return BadInput(source, f"line {line}", at_fault, "valid TOML", message)
