"""A log of whatever program as a stream of frames: candump's, pcap, pcapng, and those that python-can reads.

It is read as it goes, so its length costs no memory. What is no frame is counted, and the first told.
"""

import gzip
import io
import os
import stat
import sys
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, Final, cast

from servobench.drivers.errors import MISSING, BadInput
from servobench.drivers.printable import printable
from servobench.hil.reviewing.trace.capture_file import (
    PCAP_MAGICS,
    PCAPNG_MAGIC,
    BrokenCapture,
    OtherPacket,
    capture_packets,
)
from servobench.hil.reviewing.trace.frame_columns import Hold, LogWindow, held_against_nothing
from servobench.hil.reviewing.trace.log_frame import LogFrame
from servobench.hil.reviewing.trace.log_lines import (
    HEAD_MAX,
    SUFFIXES,
    BrokenLog,
    LineReader,
    frame_of_line,
    is_remark,
    kind_of,
    lines_of_window,
    other_frames,
    reader_of,
)

STDIN: Final = Path("-")
KINDS: Final = f"a log of candump or SavvyCAN, a pcap or pcapng, or one of {', '.join(SUFFIXES)}"
"""Readable formats, for an error."""
_GZIP_MAGIC: Final = b"\x1f\x8b"
_LINE_MAX: Final = 1024
"""A line of candump -x -a with 64 bytes has 330."""
_SHOWN_MAX: Final = 60
"""Characters shown of a line that is no frame: enough to recognize it, on one line of the terminal."""


class BusLog:
    """The frames of a log, and what in it was none."""

    def __init__(
        self,
        path: Path,
        differences: bool = False,
        *,
        window: LogWindow | None = None,
        hold: Hold = held_against_nothing,
    ) -> None:
        """``differences``: each stamp counts from the frame before (candump -t d).

        ``window``: of a log in order of time only the frames in there, and what they rest on, are read;
        ``hold``: told of its bytes before they are.
        """
        self._path = path
        self._window = window
        self._hold = hold
        self._differences = differences
        self.frames = 0
        """Read so far."""
        self.malformed = 0
        """Lines or packets that are no CAN frame."""
        self.first_malformed = ""
        """Where the first of them is, and how it begins."""
        self.damage = ""
        """Why the file could not be read to its end."""
        self.backwards = 0
        """Frames whose time lies before that of the frame before."""

    def __iter__(self) -> Iterator[LogFrame]:
        """Raises BadInput if the file cannot be opened."""
        total_ns, before_ns = 0, 0
        with _opened(self._path) as file:
            for frame in self._frames(file):
                at_ns = frame.at_ns
                self.frames += 1
                if at_ns is not None and self._differences:
                    total_ns += at_ns
                    yield frame._replace(at_ns=total_ns)
                    continue
                if at_ns is not None:
                    self.backwards += at_ns < before_ns
                    before_ns = at_ns
                yield frame

    def notes(self) -> list[str]:
        """Return remarks on the log for the reader of the frames."""
        told = []
        if self.malformed:
            one = self.malformed == 1
            first = "" if one else ", the first "
            told.append(
                f"{self.malformed} {'line or packet is' if one else 'lines or packets are'} no CAN frame"
                f"{first or ': '}{self.first_malformed}"
            )
        if self.damage:
            told.append(f"it cannot be read to its end: {self.damage}")
        if self.backwards:
            told.append(
                f"the time goes back {self.backwards} times; a log of candump -t d is read with --differences"
            )
        return told

    def _frames(self, file: io.BufferedReader) -> Iterator[LogFrame]:
        try:
            start = file.peek(4)[:4]
            if start in PCAP_MAGICS or start == PCAPNG_MAGIC:
                yield from self._captured(file)
                return
            reader = reader_of(file.peek(HEAD_MAX)[:HEAD_MAX])
            if reader is not None:
                file.readline()
                yield from self._listed(reader, _lines(file, 1))
            elif kind_of(self._path):
                yield from other_frames(self._path)
            else:
                yield from self._listed(frame_of_line, self._lines(file))
        except (BrokenCapture, BrokenLog) as error:
            self.damage = str(error)
        except (EOFError, OSError, zlib.error) as error:
            self.damage = str(error) or type(error).__name__

    def _lines(self, file: io.BufferedReader) -> Iterator[tuple[int, bytes]]:
        if self._window is None:
            return _lines(file)
        return lines_of_window(self._path, self._window, self._hold)

    def _captured(self, file: io.BufferedReader) -> Iterator[LogFrame]:
        for packet in capture_packets(cast(BinaryIO, file)):
            if isinstance(packet, OtherPacket):
                self._count(f"packet {packet.number}", b"")
            else:
                yield packet

    def _listed(self, reader: LineReader, lines: Iterator[tuple[int, bytes]]) -> Iterator[LogFrame]:
        for number, line in lines:
            frame = reader(line, number) if len(line) < _LINE_MAX or line.endswith(b"\n") else None
            if frame is not None:
                yield frame
            elif not is_remark(line):
                self._count(f"line {number}", line)

    def _count(self, place: str, line: bytes) -> None:
        self.malformed += 1
        if self.malformed == 1:
            text = printable(line[:_SHOWN_MAX].decode("utf-8", "replace").rstrip())
            self.first_malformed = f"{place}: {text!r}" if text else place


def _lines(file: io.BufferedReader, number: int = 0) -> Iterator[tuple[int, bytes]]:
    """Each with its number, which follows ``number``; of a longer one than any of candump its beginning."""
    while line := file.readline(_LINE_MAX):
        number += 1
        yield number, line
        while not line.endswith(b"\n") and len(line) == _LINE_MAX:
            line = file.readline(_LINE_MAX)


@contextmanager
def _opened(path: Path) -> Iterator[io.BufferedReader]:
    """The log, unpacked if it is packed."""
    if path == STDIN:
        yield cast(io.BufferedReader, sys.stdin.buffer)
        return
    try:
        if stat.S_ISDIR(os.stat(path).st_mode):
            raise BadInput(str(path), "", "a folder", f"a recording, or {KINDS}")
        file = path.open("rb")
    except OSError as error:
        found = MISSING if isinstance(error, FileNotFoundError) else error.strerror
        raise BadInput(str(path), "", found, KINDS) from None
    with file:
        if file.peek(2)[:2] == _GZIP_MAGIC:
            with gzip.open(file) as unpacked:
                yield io.BufferedReader(cast(io.RawIOBase, unpacked))
        else:
            yield file
