"""Hands out runs in chunks of like cost, and passes their rows on in order of their number.

Results come in any order, so nothing after this file can depend on who ran what.
"""

from collections import deque
from collections.abc import Iterable, Iterator
from typing import Any, Final

from servobench.drivers.errors import BenchError
from servobench.drivers.timebase import NS_PER_S
from servobench.hil.campaign.plan import CampaignPlan
from servobench.hil.campaign.worker import Row

CHUNK_NS: Final = NS_PER_S // 2
"""Duration of a chunk: a thousand times its overhead, and little to lose with a worker."""
AHEAD_MIN: Final = 64
"""Chunks that may be done before a missing one, with few workers: bounds the rows waiting in memory."""
EACH_HOLDS: Final = 2
"""Chunks that a worker has at a time, so that it does not wait for the next."""


class WorkerDied(BenchError):
    """A run kills its process, or no process can start: the campaign ends before its runs are done."""

    exit_status = 6


class RunRefused(BenchError):
    """A run of the sweep cannot be run: because of its bench, its controller's certificate, or user code;
    with its exit status in the worker."""

    exit_status = 2

    def __init__(self, text: str, exit_status: int) -> None:
        super().__init__(text)
        self.exit_status = exit_status


class Chunks:
    """Runs left to do, and rows done before their turn."""

    def __init__(self, plan: CampaignPlan, numbers: range) -> None:
        self._plan = plan
        self._fresh = deque(numbers)
        self._again: deque[list[int]] = deque()
        """Chunks of workers that died."""
        self._done: dict[int, Row] = {}
        self._due, self._end = numbers.start, numbers.stop
        self._cost_ns = CHUNK_NS
        """Measured cost of a run; before the first a chunk is one run."""

    @property
    def left(self) -> bool:
        """True while rows are still to come."""
        return self._due < self._end

    def next(self, workers: int) -> list[int] | None:
        """Return the next chunk; None: there is none, or not before others are done."""
        if self._again:
            return self._again.popleft()
        size = max(1, CHUNK_NS // max(1, self._cost_ns))
        ahead = max(AHEAD_MIN, 2 * EACH_HOLDS * workers)
        if not self._fresh or self._fresh[0] - self._due > ahead * size:
            return None
        known = self._plan.known - self._fresh[0]
        return [self._fresh.popleft() for _ in range(min(size, known, len(self._fresh)))] or None

    def drawn(self, chunk: Iterable[int]) -> list[Any]:
        """Return a chunk as a worker takes it; see
        :meth:`servobench.hil.campaign.worker.Workshop.answers`."""
        return [[number, self._plan.drawn(number)] for number in chunk]

    def put_back(self, chunks: Iterable[list[int]]) -> None:
        """Return chunks of a lost worker: they come first."""
        self._again.extend(chunks)

    def take(self, answer: dict[str, Any]) -> int:
        """Take a worker's answer; return its run. Raises RunRefused if it is an error, BadInput for a file
        with other contents in another run."""
        if "row" not in answer:
            raise RunRefused(answer["error"], answer["status"])
        self._plan.files.meet(answer["files"])
        row: Row = answer["row"]
        number: int = row["run"]
        self._done[number] = row
        self._cost_ns = int(0.9 * self._cost_ns + 0.1 * answer["took_ns"])
        return number

    def rows(self) -> Iterator[Row]:
        """Yield the rows whose turn it is."""
        while self._due in self._done:
            yield self._done.pop(self._due)
            self._due += 1
