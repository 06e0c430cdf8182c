"""Rows of runs from the workers of a Dask cluster, in order of their number.

    here -> worker   a chunk: run numbers with what they draw; which sweep, and one of its runs as it is here
    worker -> here   a row for each run; or why there is none

A worker reads the sweep itself, at the same path, and proves before its first chunk that it computes the
same: the files have the same identity, and the first run yields the same row. Dask hands the chunks of a dead
worker to others; it alone is imported here, and only on demand.
"""

import asyncio
import json
import logging
import threading
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from servobench.drivers.errors import BadInput, BenchError
from servobench.drivers.timebase import NS_PER_S, MonotonicClock
from servobench.hil.campaign.plan import CampaignPlan
from servobench.hil.campaign.pool import EACH_HOLDS, Chunks, RowSource, WorkerDied
from servobench.hil.campaign.worker import Answer, NotTheSame, Workshop, refusal
from servobench.hil.machine.extras import missing_extra
from servobench.hil.machine.stopping import StopRequest

if TYPE_CHECKING:
    from distributed import Client
    from distributed import Future as DaskFuture

CONNECT_S: Final = 10.0
"""Wait for an answer of the scheduler."""
CLOSE_S: Final = 5.0
"""Wait when disconnecting from it."""
WITHOUT_WORKER_NS: Final = 60 * NS_PER_S
"""After this time without any worker nobody is going to start one."""
LOOKED_EVERY_NS: Final = NS_PER_S
"""Interval between queries of the number of workers, a millisecond each."""
POLL_S: Final = 0.2
"""Delay until a stop request is noticed."""

Flying = Future[list[Answer]]


class ClusterLost(BenchError):
    """The scheduler is gone, or it has no workers. Stored runs remain, and can be resumed."""


class Order(NamedTuple):
    """The campaign of a chunk; plain, hashable values."""

    client: str
    """A name for this campaign alone: none continues with a sweep that a worker has read for another."""
    sweep: str
    identity: str
    """JSON of :data:`servobench.hil.campaign.identity.Identity`."""
    witness: str
    """JSON of the number of a run, its draw, and its row as computed here."""


@contextmanager
def dask_client(address: str) -> Iterator["Client"]:
    """Connect to the scheduler at ``address``.

    Raises MissingExtra: ``distributed`` is not installed. BadInput: no scheduler answers there.
    """
    try:
        from distributed import Client
    except ModuleNotFoundError as error:
        raise missing_extra(error, "--dask") or error from None
    try:
        with ThreadPoolExecutor(1) as thread:  # in this one a loop may run already, as in a notebook
            thread.submit(asyncio.run, _reach(address)).result()
        client = Client(address, timeout=CONNECT_S, set_as_default=False, name="servobench")
    except (OSError, ValueError) as error:
        expected = "the address of a Dask scheduler that runs, e.g. tcp://192.168.1.5:8786"
        raise BadInput("--dask", "", address, expected, str(error)) from None
    with _quiet():
        try:
            yield client
        finally:
            client.close(CLOSE_S)


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence the client's log about a lost scheduler, tracebacks of a hundred lines: this module reports
    it."""
    loggers = [logging.getLogger(name) for name in ("distributed.client", "distributed.utils")]
    before = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        for logger, level in zip(loggers, before, strict=True):
            logger.setLevel(level)


async def _reach(address: str) -> None:
    """Raise OSError or ValueError. The client alone waits for ever where something listens and stays silent:
    its timeout excludes the handshake."""
    from distributed import Security
    from distributed.comm.core import connect

    arguments = Security().get_connection_args("client")
    try:
        comm = await asyncio.wait_for(connect(address, timeout=CONNECT_S, **arguments), CONNECT_S)
    except TimeoutError:
        raise OSError(f"no Dask scheduler said anything for {CONNECT_S:g} s") from None
    await comm.close()


def rows_on_dask(client: "Client", plan: CampaignPlan, numbers: range, stop: StopRequest) -> RowSource:
    """Yield the rows of runs ``numbers`` in order.

    Raises BadInput or RunRefused of a run that cannot be run, WorkerDied, ClusterLost, Interrupted.
    """
    if not numbers:
        return
    order = order_of(client, plan, numbers.start, stop)
    chunks, cluster = Chunks(plan, numbers), _Cluster(client)
    flying: dict[Flying, _Flight] = {}
    try:
        while chunks.left:
            stop.check()
            workers = cluster.workers()
            while len(flying) < EACH_HOLDS * max(1, workers) and (chunk := chunks.next(workers)):
                task = client.submit(run_chunk, order, chunks.drawn(chunk), pure=False)
                flying[_outcome(client, task)] = _Flight(chunk, task)
            for landed in wait(flying, POLL_S, FIRST_COMPLETED).done:
                for answer in cluster.answers(landed, flying.pop(landed)):
                    chunks.take(answer)
            for row in chunks.rows():
                stop.check()
                yield row
    finally:
        if client.status == "running":
            client.cancel([flight.task for flight in flying.values()])


class _Flight(NamedTuple):
    chunk: list[int]
    task: "DaskFuture[list[Answer]]"
    """While it is held Dask keeps its result."""


def _outcome(client: "Client", task: "DaskFuture[list[Answer]]") -> Flying:
    """Wrap a task for the standard library's wait; any failure on the way is an outcome too."""
    loop: Any = client.loop
    return asyncio.run_coroutine_threadsafe(client.gather(task, asynchronous=True), loop.asyncio_loop)


def order_of(client: "Client", plan: CampaignPlan, number: int, stop: StopRequest) -> Order:
    """Return the order with run ``number`` as computed here. Raises as
    :meth:`servobench.hil.campaign.worker.Workshop.row`."""
    drawn = plan.drawn(number)
    row = Workshop(plan, stop).row(number, drawn)
    witness, identity = json.dumps([number, drawn, row]), json.dumps(plan.identity)
    return Order(client.id, str(plan.source), identity, witness)


class _Cluster:
    """The present state of the cluster."""

    def __init__(self, client: "Client") -> None:
        self._client = client
        assert client.scheduler is not None
        self._address = client.scheduler.address
        self._clock = MonotonicClock()
        self._count = 0
        self._looked_at = self._seen_at = self._clock.now()

    def workers(self) -> int:
        """Return the number of workers, at most a second old. Raises ClusterLost."""
        if self._client.status != "running":
            raise self._gone()
        now = self._clock.now()
        if self._count and now - self._looked_at < LOOKED_EVERY_NS:
            return self._count
        try:
            self._count = len(self._client.nthreads())
        except OSError:
            raise self._gone() from None
        self._looked_at = now
        if self._count:
            self._seen_at = now
        elif now - self._seen_at >= WITHOUT_WORKER_NS:
            raise ClusterLost(
                f"the scheduler at {self._address} has had no worker for {WITHOUT_WORKER_NS // NS_PER_S} s; "
                f"dask worker {self._address} --nthreads 1 starts one, --resume goes on with what is stored"
            )
        return self._count

    def answers(self, landed: Flying, flight: _Flight) -> list[Answer]:
        """Return the answers of a finished chunk. Raises ClusterLost or WorkerDied: there are none."""
        from distributed import KilledWorker

        error = None if landed.cancelled() else landed.exception()
        if landed.cancelled() or (error is not None and flight.task.status != "error"):
            raise self._gone()
        runs = f"runs {flight.chunk[0]} to {flight.chunk[-1]}"
        if isinstance(error, KilledWorker):
            deaths, last = error.allowed_failures + 1, error.last_worker.address
            raise WorkerDied(f"{runs}: {deaths} workers died with them, the last of them {last}")
        if error is not None:
            remedy = "each worker needs servobench as it is here"
            raise WorkerDied(f"{runs}: a Dask worker failed with {type(error).__name__}: {error}; {remedy}")
        return landed.result()

    def _gone(self) -> ClusterLost:
        return ClusterLost(
            f"the scheduler at {self._address} is gone, or has dropped the campaign; --resume goes on with "
            "what is stored, with another --dask or without"
        )


_one_at_a_time = threading.Lock()
"""Threads of one worker would wait for each other anyway."""


def run_chunk(order: Order, chunk: list[Any]) -> list[Answer]:
    """Run a chunk on a worker: the answers of :meth:`servobench.hil.campaign.worker.Workshop.answers`."""
    with _one_at_a_time:
        try:
            return list(_workshop(order).answers(chunk))
        except BenchError as error:
            from distributed import get_worker

            answer = refusal(error)
            return [answer | {"error": f"worker {get_worker().address}: {answer['error']}"}]


@lru_cache(maxsize=4)
def _workshop(order: Order) -> Workshop:
    """Make a workshop. Raises as :meth:`Workshop.of_sweep`, and NotTheSame for a worker that must not take
    part."""
    workshop = Workshop.of_sweep(order.sweep, json.loads(order.identity))
    number, drawn, expected = json.loads(order.witness)
    (answer,) = workshop.answers([[number, drawn]])
    if json.dumps(answer["row"]) != json.dumps(expected):
        parts = ", ".join(name for name, value in expected.items() if answer["row"].get(name) != value)
        raise NotTheSame(
            f"run {number} comes to another result than where the campaign was started ({parts}): "
            "servobench, its packages, own code and the kind of processor must be the same"
        )
    return workshop
