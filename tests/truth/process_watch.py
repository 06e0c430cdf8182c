"""How much memory and how many descriptors the processes of a long run hold, read beside it."""

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Final

PROC: Final = Path("/proc")
EVERY_S: Final = 5.0
SETTLED_AFTER_S: Final = 60.0
"""Until then a process imports, compiles and fills its rings."""


@dataclass(slots=True)
class Holding:
    """What one process held: once settled, at most after that, and when last seen."""

    name: str
    settled: tuple[int, int] = (0, 0)
    """Resident memory in kB, descriptors."""
    most: tuple[int, int] = (0, 0)
    last: tuple[int, int] = (0, 0)

    def see(self, now: tuple[int, int], settled: bool) -> None:
        self.last = now
        if not settled or self.settled == (0, 0):
            self.settled = now
        self.most = (max(self.most[0], now[0]), max(self.most[1], now[1]))


@contextmanager
def watching() -> Iterator[list[Holding]]:
    """The list is filled with this process's children, and theirs, as long as the context lasts."""
    found: dict[int, Holding] = {}
    holdings: list[Holding] = []
    ended = threading.Event()

    def watch() -> None:
        seen_s = dict[int, float]()
        while not ended.wait(EVERY_S):
            for process in _descendants(os.getpid()):
                now = _holds(process)
                if now is None:
                    continue
                if process not in found:
                    found[process] = Holding(_name(process))
                    holdings.append(found[process])
                seen_s[process] = seen_s.get(process, 0.0) + EVERY_S
                found[process].see(now, seen_s[process] > SETTLED_AFTER_S)

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield holdings
    finally:
        ended.set()
        thread.join()


def _descendants(process: int) -> list[int]:
    children: list[int] = []
    for task in (PROC / str(process) / "task").iterdir():
        try:
            children += map(int, (task / "children").read_text().split())
        except OSError:  # it has ended since
            continue
    return [*children, *(below for child in children for below in _descendants_or_none(child))]


def _descendants_or_none(process: int) -> list[int]:
    try:
        return _descendants(process)
    except OSError:
        return []


def _holds(process: int) -> tuple[int, int] | None:
    folder = PROC / str(process)
    try:
        status = (folder / "status").read_text()
        descriptors = len(list((folder / "fd").iterdir()))
    except OSError:
        return None
    resident = [int(line.split()[1]) for line in status.splitlines() if line.startswith("VmRSS:")]
    return (resident[0], descriptors) if resident else None


def _name(process: int) -> str:
    words = (PROC / str(process) / "cmdline").read_text().split("\0")
    told = [Path(word).name for word in words if word and not word.startswith("-")]
    return " ".join(told[1:4])
