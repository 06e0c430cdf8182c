"""Rows of runs from several processes, in order of their number; one that dies is replaced.

    here -> worker   lines of JSON: where the plan is; then run numbers with what they draw, a chunk each
    worker -> here   "ready"; then a line for each run: its row; or why there is none

Results come in any order and leave in order, so nothing behind this file can depend on who ran what.
"""

import json
import os
import selectors
import subprocess
from collections import deque
from collections.abc import Generator
from pathlib import Path
from typing import Any, Final

from drivers.errors import BadInput, BenchError
from drivers.timebase import NS_PER_S
from hil.campaign.plan import CampaignPlan
from hil.campaign.worker import Row, Workshop
from hil.machine.stopping import Interrupted, StopRequest
from virtual_bus.child_python import python_command, python_environment

CHUNK_NS: Final = NS_PER_S // 2
"""What a chunk is to take: a thousand times its handing over, and little to lose with a worker."""
AHEAD: Final = 64
"""Chunks that may be done before one that is missing: bounds what waits in memory."""
DEATHS_MAX: Final = 3
"""A run during which so many workers died is the cause; so many that died in a row before they were ready are
no accident."""
ENDING_S: Final = 5.0
"""Between the end of a worker's output and its own end pass milliseconds."""
MODULE: Final = "hil.campaign.worker_process"

RowSource = Generator[Row, None, None]
"""To be closed when no more are needed: then its processes are gone."""


class WorkerDied(BenchError):
    """A run kills its process, or none can be started."""

    exit_status = 70


class SweepChanged(BenchError):
    """A worker has read another sweep than the campaign."""

    exit_status = 2


def rows_here(plan: CampaignPlan, numbers: range, stop: StopRequest) -> RowSource:
    """One after the other, in this process. Raises as :meth:`Workshop.row`."""
    workshop = Workshop(plan, stop)
    for number in numbers:
        stop.check()
        yield workshop.row(number)


class Worker:
    """One process, with its own end of the lines."""

    def __init__(self, plan: CampaignPlan) -> None:
        self.process = subprocess.Popen(
            python_command(MODULE),
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
        """Handed to it, and not yet done."""
        self.ready = False
        self._partial = b""
        self.send({"sweep": str(plan.source.absolute()), "identity": plan.identity})

    def send(self, what: Any) -> None:
        assert self.process.stdin is not None
        try:
            self.process.stdin.write(json.dumps(what).encode() + b"\n")
            self.process.stdin.flush()
        except BrokenPipeError:
            """It is gone; the end of its output says so."""

    def lines(self) -> list[dict[str, Any]] | None:
        """What it said; None: it is gone."""
        data = os.read(self.output.fileno(), 1 << 16)
        if not data:
            return None
        *whole, self._partial = (self._partial + data).split(b"\n")
        return [json.loads(line) for line in whole]

    def status(self) -> int:
        """With which it ended, once its output has; -N by signal N."""
        try:
            return self.process.wait(ENDING_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            return self.process.wait()

    def end(self) -> None:
        """Now, whatever it does."""
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
        self._done: dict[int, Row] = {}
        self._again: deque[list[int]] = deque()
        """Chunks of workers that died."""
        self._deaths: dict[int, int] = {}
        self._starts_lost = 0
        """Workers in a row that died before they were ready."""
        self._cost_ns = CHUNK_NS
        """Of a run, as measured; before the first a chunk is one run."""

    @property
    def process_ids(self) -> list[int]:
        """Of the workers."""
        return [worker.process.pid for worker in self._alive]

    def rows(self, numbers: range) -> RowSource:
        """Of these runs. Raises BadInput of a run that cannot be run, WorkerDied, Interrupted."""
        fresh = deque(numbers)
        due = numbers.start
        try:
            for _ in range(min(self._workers, len(numbers))):
                self._start()
            while due < numbers.stop:
                self._hand_out(fresh, due)
                self._listen()
                while due in self._done:
                    yield self._done.pop(due)
                    due += 1
        finally:
            for worker in self._alive:
                worker.end()
            self._alive.clear()
            self._selector.close()

    def _start(self) -> None:
        worker = Worker(self._plan)
        self._alive.append(worker)
        self._selector.register(worker.output, selectors.EVENT_READ, worker)

    def _hand_out(self, fresh: deque[int], due: int) -> None:
        """Two chunks for each worker, so that none waits for the next."""
        for worker in self._alive:
            while worker.ready and len(worker.chunks) < 2 and (self._again or fresh):
                size = max(1, CHUNK_NS // max(1, self._cost_ns))
                known = 0 if self._again else self._plan.known - fresh[0]
                if not self._again and (fresh[0] - due > AHEAD * size or not known):
                    return
                if self._again:
                    chunk = self._again.popleft()
                else:
                    chunk = [fresh.popleft() for _ in range(min(size, known, len(fresh)))]
                worker.chunks.append(chunk)
                worker.send([[number, self._plan.drawn(number)] for number in chunk])

    def _listen(self) -> None:
        for key, _ in self._selector.select(timeout=0.2):
            worker: Worker = key.data
            lines = worker.lines()
            if lines is None:
                self._replace(worker)
                continue
            for line in lines:
                self._take(worker, line)
        if self._stop():
            raise Interrupted(f"ended by {self._stop.asked_by}")

    def _take(self, worker: Worker, line: dict[str, Any]) -> None:
        if "ready" in line:
            worker.ready = True
            self._starts_lost = 0
        elif "row" in line:
            row: Row = line["row"]
            self._done[row["run"]] = row
            self._cost_ns = int(0.9 * self._cost_ns + 0.1 * line["took_ns"])
            worker.chunks[0].remove(row["run"])
            if not worker.chunks[0]:
                worker.chunks.popleft()
        else:
            raise _error_of(line)

    def _replace(self, worker: Worker) -> None:
        """It died: what it had not done is done by others, first of all."""
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
        self._again.extend(worker.chunks)
        self._start()

    def _count_start(self, status: int) -> None:
        """A worker died before it was ready. One that was killed, say for want of memory, may do better next
        time; one that ended by itself would not."""
        if status >= 0:
            raise WorkerDied(f"a worker ended with status {status} before its first run")
        self._starts_lost += 1
        if self._starts_lost == DEATHS_MAX:
            told = f"{DEATHS_MAX} workers in a row died before their first run, the last with status {status}"
            raise WorkerDied(told)


def _error_of(line: dict[str, Any]) -> BenchError:
    """What a worker could not run."""
    if line["status"] == BadInput.exit_status:
        return RunRefused(line["error"])
    return WorkerDied(line["error"])


class RunRefused(BenchError):
    """A run of the sweep cannot be run: its bench is at fault, or its controller's certificate."""

    exit_status = 2


def rows_of(plan: CampaignPlan, numbers: range, workers: int, stop: StopRequest) -> RowSource:
    """Of runs ``numbers`` in order; in this process if one worker is enough."""
    if workers == 1:
        return rows_here(plan, numbers, stop)
    return WorkerPool(plan, workers, stop).rows(numbers)


def sweep_at(path: str, identity: str) -> CampaignPlan:
    """The plan, as a worker reads it. Raises SweepChanged."""
    plan = CampaignPlan.load(Path(path))
    if plan.identity != identity:
        raise SweepChanged(f"{path}, or a file that it names, has changed since the campaign began")
    return plan
