"""Rows of runs from the workers of a Dask cluster, in order of their number.

    here -> worker   a chunk: run numbers with what they draw; which sweep, and one of its runs as it is here
    worker -> here   a row for each run; or why there is none

A worker reads the sweep by itself, at the path that it has here, and proves before its first chunk that it
does here what is done there: the files have the same identity, and the first run comes to the same row. Dask
hands the chunks of a worker that died to others; it alone is imported here, and only when it is asked for.
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
from servobench.hil.campaign.chunks import EACH_HOLDS, Chunks, WorkerDied
from servobench.hil.campaign.plan import CampaignPlan
from servobench.hil.campaign.pool import RowSource
from servobench.hil.campaign.worker import Answer, NotTheSame, Workshop, refusal
from servobench.hil.machine.extras import missing_extra
from servobench.hil.machine.stopping import StopRequest

if TYPE_CHECKING:
    from distributed import Client
    from distributed import Future as DaskFuture

CONNECT_S: Final = 10.0
"""For an answer of the scheduler."""
CLOSE_S: Final = 5.0
"""To part from it, if it is still there."""
WITHOUT_WORKER_NS: Final = 60 * NS_PER_S
"""After so long without any worker nobody is going to start one."""
LOOKED_EVERY_NS: Final = NS_PER_S
"""How many workers there are is asked of the scheduler, a millisecond each time."""
POLL_S: Final = 0.2
"""So long after a stop was asked for it is seen."""

Flying = Future[list[Answer]]


class ClusterLost(BenchError):
    """The scheduler is gone, or it has no workers. What is stored stays, and can be resumed."""


class Order(NamedTuple):
    """Which campaign a chunk is of; as plain values, and hashable."""

    client: str
    """A name of this campaign alone: none goes on with what a worker has read for another."""
    sweep: str
    identity: str
    """JSON of :data:`servobench.hil.campaign.identity.Identity`."""
    witness: str
    """JSON of the number of a run, what it draws, and its row as it came out here."""


@contextmanager
def dask_client(address: str) -> Iterator["Client"]:
    """Connected to the scheduler at ``address``.

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
    """What the client logs of a scheduler that is gone, tracebacks of a hundred lines, is told here."""
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
    """Raises OSError, ValueError. A client alone waits without end where something listens and says nothing:
    its timeout leaves out the handshake."""
    from distributed import Security
    from distributed.comm.core import connect

    arguments = Security().get_connection_args("client")
    try:
        comm = await asyncio.wait_for(connect(address, timeout=CONNECT_S, **arguments), CONNECT_S)
    except TimeoutError:
        raise OSError(f"no Dask scheduler said anything for {CONNECT_S:g} s") from None
    await comm.close()


def rows_on_dask(client: "Client", plan: CampaignPlan, numbers: range, stop: StopRequest) -> RowSource:
    """Of runs ``numbers`` in order.

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
    """As long as it is held Dask holds what it comes to."""


def _outcome(client: "Client", task: "DaskFuture[list[Answer]]") -> Flying:
    """As the standard library waits for it; whatever goes wrong on the way is an outcome too."""
    loop: Any = client.loop
    return asyncio.run_coroutine_threadsafe(client.gather(task, asynchronous=True), loop.asyncio_loop)


def order_of(client: "Client", plan: CampaignPlan, number: int, stop: StopRequest) -> Order:
    """With run ``number`` as it comes out here. Raises as
    :meth:`servobench.hil.campaign.worker.Workshop.row`."""
    drawn = plan.drawn(number)
    row = Workshop(plan, stop).row(number, drawn)
    witness, identity = json.dumps([number, drawn, row]), json.dumps(plan.identity)
    return Order(client.id, str(plan.source), identity, witness)


class _Cluster:
    """What there is of it at present."""

    def __init__(self, client: "Client") -> None:
        self._client = client
        assert client.scheduler is not None
        self._address = client.scheduler.address
        self._clock = MonotonicClock()
        self._count = 0
        self._looked_at = self._seen_at = self._clock.now()

    def workers(self) -> int:
        """As many as it had a second ago at most. Raises ClusterLost."""
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
        """Of a chunk that is done. Raises ClusterLost or WorkerDied: there are none."""
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
"""Threads of one worker would wait for each other all the same."""


def run_chunk(order: Order, chunk: list[Any]) -> list[Answer]:
    """On a worker: the answers of :meth:`servobench.hil.campaign.worker.Workshop.answers`."""
    with _one_at_a_time:
        try:
            return list(_workshop(order).answers(chunk))
        except BenchError as error:
            from distributed import get_worker

            answer = refusal(error)
            return [answer | {"error": f"worker {get_worker().address}: {answer['error']}"}]


@lru_cache(maxsize=4)
def _workshop(order: Order) -> Workshop:
    """Raises as :meth:`Workshop.of_sweep`, and NotTheSame for a worker that must not take part."""
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
