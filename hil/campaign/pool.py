"""Rows of runs from several processes, in order of their number; a dead one is replaced.

here -> worker   lines of JSON: where the plan is; then run numbers with what they draw, a chunk each
worker -> here   "ready"; then a line for each run: its row; or why there is none

Runs are handed out in chunks of like cost. Results come in any order and are passed on in order of their
number, so nothing after this file can depend on who ran what.
"""

import json
import os
import selectors
import subprocess
from collections import deque
from collections.abc import Generator, Iterable, Iterator
from typing import Any, Final

from servobench.drivers.errors import BenchError
from servobench.drivers.timebase import NS_PER_S
from servobench.hil.campaign.plan import CampaignPlan
from servobench.hil.campaign.worker import Row, Workshop
from servobench.hil.machine.stopping import StopRequest
from servobench.virtual_bus.child_python import python_command, python_environment

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


DEATHS_MAX: Final = 3
"""A run during which this many workers died is the cause; so many consecutive deaths before they were ready
are no accident."""
ENDING_S: Final = 5.0
"""Limit between the end of a worker's output and its own end, which takes milliseconds."""

RowSource = Generator[Row, None, None]
"""To be closed when no more are needed: its processes then end."""


class Worker:
    """One process, with its ends of the pipes."""

    def __init__(self, plan: CampaignPlan) -> None:
        self.process = subprocess.Popen(
            python_command("servobench.hil.campaign.worker"),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=python_environment(OPENBLAS_NUM_THREADS="1"),
            cwd=os.getcwd(),
            start_new_session=True,  # Ctrl-C is for the one who hands out the runs
        )
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.output = self.process.stdout
        self.chunks: deque[list[int]] = deque()
        """Handed to it, and not done yet."""
        self.ready = False
        self._partial = b""
        self.send({"sweep": str(plan.source), "identity": plan.identity})

    def send(self, what: Any) -> None:
        assert self.process.stdin is not None
        try:
            self.process.stdin.write(json.dumps(what).encode() + b"\n")
            self.process.stdin.flush()
        except BrokenPipeError:
            """It is gone; the end of its output says so."""

    def lines(self) -> list[dict[str, Any]] | None:
        """Return its output lines; None: it is gone."""
        data = os.read(self.output.fileno(), 1 << 16)
        if not data:
            return None
        *whole, self._partial = (self._partial + data).split(b"\n")
        return [json.loads(line) for line in whole]

    def status(self) -> int:
        """Return its exit status, once its output has ended; -N for signal N."""
        try:
            return self.process.wait(ENDING_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            return self.process.wait()

    def end(self) -> None:
        """End it now, whatever it does."""
        self.process.kill()
        self.process.wait()
        for pipe in (self.process.stdin, self.process.stdout):
            assert pipe is not None
            try:
                pipe.close()
            except BrokenPipeError:
                """What it did not live to read."""


class WorkerPool:
    """Hands out runs, and yields their rows in order."""

    def __init__(self, plan: CampaignPlan, workers: int, stop: StopRequest) -> None:
        self._plan, self._workers, self._stop = plan, workers, stop
        self._selector = selectors.DefaultSelector()
        self._alive: list[Worker] = []
        self._deaths: dict[int, int] = {}
        self._starts_lost = 0
        """Consecutive workers that died before they were ready."""

    @property
    def process_ids(self) -> list[int]:
        """Process ids of the workers."""
        return [worker.process.pid for worker in self._alive]

    def rows(self, numbers: range) -> RowSource:
        """Yield the rows of these runs. Raises BadInput for an impossible run, WorkerDied, Interrupted."""
        chunks = Chunks(self._plan, numbers)
        try:
            for _ in range(min(self._workers, len(numbers))):
                self._start()
            while chunks.left:
                self._hand_out(chunks)
                self._listen(chunks)
                yield from chunks.rows()
        finally:
            for worker in self._alive:
                worker.end()
            self._alive.clear()
            self._selector.close()

    def _start(self) -> None:
        worker = Worker(self._plan)
        self._alive.append(worker)
        self._selector.register(worker.output, selectors.EVENT_READ, worker)

    def _hand_out(self, chunks: Chunks) -> None:
        for worker in self._alive:
            while worker.ready and len(worker.chunks) < EACH_HOLDS:
                chunk = chunks.next(self._workers)
                if chunk is None:
                    return
                worker.chunks.append(chunk)
                worker.send(chunks.drawn(chunk))

    def _listen(self, chunks: Chunks) -> None:
        for key, _ in self._selector.select(timeout=0.2):
            worker: Worker = key.data
            lines = worker.lines()
            if lines is None:
                chunks.put_back(worker.chunks)
                self._replace(worker)
                continue
            for line in lines:
                self._take(worker, line, chunks)
        self._stop.check()

    def _take(self, worker: Worker, line: dict[str, Any], chunks: Chunks) -> None:
        if "ready" in line:
            worker.ready = True
            self._starts_lost = 0
            return
        number = chunks.take(line)  # before its chunks are looked at: one that refuses the sweep has none
        worker.chunks[0].remove(number)
        if not worker.chunks[0]:
            worker.chunks.popleft()

    def _replace(self, worker: Worker) -> None:
        """Replace a worker that died."""
        self._selector.unregister(worker.output)
        self._alive.remove(worker)
        status = worker.status()
        worker.end()
        if not worker.ready:
            self._count_start(status)
        elif worker.chunks:
            number = worker.chunks[0][0]
            self._deaths[number] = self._deaths.get(number, 0) + 1
            if self._deaths[number] == DEATHS_MAX:
                raise WorkerDied(f"run {number}: {DEATHS_MAX} workers died with it, with status {status}")
        self._start()

    def _count_start(self, status: int) -> None:
        """Count a worker that died before it was ready. One that was killed, say for want of memory, may
        succeed next time; one that ended by itself would not."""
        if status >= 0:
            raise WorkerDied(f"a worker ended with status {status} before its first run")
        self._starts_lost += 1
        if self._starts_lost == DEATHS_MAX:
            raise WorkerDied(
                f"{DEATHS_MAX} workers in a row died before their first run, the last with status {status}"
            )


def rows_of(plan: CampaignPlan, numbers: range, workers: int, stop: StopRequest) -> RowSource:
    """Yield the rows of runs ``numbers`` in order; in this process if one worker is enough."""
    if workers > 1:
        yield from WorkerPool(plan, workers, stop).rows(numbers)
        return
    workshop = Workshop(plan, stop)
    for number in numbers:
        stop.check()
        yield workshop.row(number)
