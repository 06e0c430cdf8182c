"""Runs that are handed out in chunks of like cost, and whose rows leave in order of their number.

Results come in any order, so nothing behind this file can depend on who ran what.
"""

from collections import deque
from collections.abc import Iterable, Iterator
from typing import Any, Final

from servobench.drivers.errors import BenchError
from servobench.drivers.timebase import NS_PER_S
from servobench.hil.campaign.plan import CampaignPlan
from servobench.hil.campaign.worker import Row

CHUNK_NS: Final = NS_PER_S // 2
"""What a chunk is to take: a thousand times its handing over, and little to lose with a worker."""
AHEAD_MIN: Final = 64
"""Chunks that may be done before one that is missing, with few workers: bounds what waits in memory."""
EACH_HOLDS: Final = 2
"""Chunks that a worker has at a time, so that it does not wait for the next."""


class WorkerDied(BenchError):
    """A run kills its process, or none can be started: the campaign ends before its runs are done."""

    exit_status = 6


class RunRefused(BenchError):
    """A run of the sweep cannot be run: its bench is at fault, its controller's certificate, or code of the
    user's; with the exit status that it has in the worker."""

    exit_status = 2

    def __init__(self, text: str, exit_status: int) -> None:
        super().__init__(text)
        self.exit_status = exit_status


class Chunks:
    """What is left to be run, and what is done before its turn."""

    def __init__(self, plan: CampaignPlan, numbers: range) -> None:
        self._plan = plan
        self._fresh = deque(numbers)
        self._again: deque[list[int]] = deque()
        """Chunks of workers that died."""
        self._done: dict[int, Row] = {}
        self._due, self._end = numbers.start, numbers.stop
        self._cost_ns = CHUNK_NS
        """Of a run, as measured; before the first a chunk is one run."""

    @property
    def left(self) -> bool:
        """Whether rows are still to come."""
        return self._due < self._end

    def next(self, workers: int) -> list[int] | None:
        """A chunk to be handed out; None: there is none, or not before others are done."""
        if self._again:
            return self._again.popleft()
        size = max(1, CHUNK_NS // max(1, self._cost_ns))
        ahead = max(AHEAD_MIN, 2 * EACH_HOLDS * workers)
        if not self._fresh or self._fresh[0] - self._due > ahead * size:
            return None
        known = self._plan.known - self._fresh[0]
        return [self._fresh.popleft() for _ in range(min(size, known, len(self._fresh)))] or None

    def drawn(self, chunk: Iterable[int]) -> list[Any]:
        """A chunk as a worker takes it, see :meth:`servobench.hil.campaign.worker.Workshop.answers`."""
        return [[number, self._plan.drawn(number)] for number in chunk]

    def put_back(self, chunks: Iterable[list[int]]) -> None:
        """Whoever had them is gone: they come first."""
        self._again.extend(chunks)

    def take(self, answer: dict[str, Any]) -> int:
        """The run that an answer of a worker is of. Raises RunRefused if it is an error, BadInput for a file
        that was another one in another run."""
        if "row" not in answer:
            raise RunRefused(answer["error"], answer["status"])
        self._plan.files.meet(answer["files"])
        row: Row = answer["row"]
        number: int = row["run"]
        self._done[number] = row
        self._cost_ns = int(0.9 * self._cost_ns + 0.1 * answer["took_ns"])
        return number

    def rows(self) -> Iterator[Row]:
        """Those whose turn it is."""
        while self._due in self._done:
            yield self._done.pop(self._due)
            self._due += 1
