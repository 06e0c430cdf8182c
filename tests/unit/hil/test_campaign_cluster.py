"""A campaign's runs on a cluster that is made up: which chunks fly, what lands, what is said of losses."""

import json
import sys
from collections.abc import Iterator
from concurrent.futures import Future
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from servobench.drivers.errors import BusDown
from servobench.drivers.timebase import NS_PER_S, Instant
from servobench.hil.campaign import on_dask
from servobench.hil.campaign.identity import SourceFiles
from servobench.hil.campaign.on_dask import ClusterLost, Order, order_of, rows_on_dask, run_chunk
from servobench.hil.campaign.pool import RunRefused, WorkerDied
from servobench.hil.campaign.worker import NotTheSame
from servobench.hil.machine.stopping import Interrupted, StopRequest

HERE = Order("client-1", "/sweep.toml", '"abc"', json.dumps([0, [[], 1.0, True], {"run": 0, "x": 1.5}]))
PLAN: Any = SimpleNamespace(
    known=10_000,
    identity="abc",
    source=Path("/sweep.toml"),
    files=SourceFiles(Path("/sweep.toml")),
    drawn=lambda number: [[number], 1.0, True],
)


class Killed(Exception):
    """As Dask has it."""

    def __init__(self, allowed: int, last: str) -> None:
        super().__init__("killed")
        self.allowed_failures, self.last_worker = allowed, SimpleNamespace(address=last)


@pytest.fixture(autouse=True)
def distributed(monkeypatch: pytest.MonkeyPatch) -> None:
    """What of Dask is asked for by name."""
    module: Any = ModuleType("distributed")
    module.KilledWorker = Killed
    module.get_worker = lambda: SimpleNamespace(address="tcp://w:1")
    monkeypatch.setitem(sys.modules, "distributed", module)


class Clock:
    """Time that a test owns."""

    at = 0

    def now(self) -> Instant:
        return Instant(self.at)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> type[Clock]:
    Clock.at = 0
    monkeypatch.setattr(on_dask, "MonotonicClock", Clock)
    return Clock


class Client:
    """A scheduler with so many workers, which do a chunk at once; ``outcomes``: of a chunk that fails."""

    def __init__(self, workers: int = 2) -> None:
        self.id, self.status = "client-1", "running"
        self.scheduler = SimpleNamespace(address="tcp://s:1")
        self.count: int | None = workers
        self.looks = 0
        self.submitted: list[list[int]] = []
        self.orders: set[Order] = set()
        self.cancelled: list[Any] = []
        self.outcomes: dict[int, BaseException | None] = {}

    def nthreads(self) -> dict[int, int]:
        self.looks += 1
        if self.count is None:
            raise OSError("no answer")
        return dict.fromkeys(range(self.count), 1)

    def submit(self, call: Any, order: Order, chunk: list[Any], pure: bool) -> Any:
        assert call is run_chunk
        assert not pure
        self.orders.add(order)
        numbers = [number for number, _ in chunk]
        self.submitted.append(numbers)
        future: Future[Any] = Future()
        status = "finished"
        if numbers[0] in self.outcomes:
            error = self.outcomes[numbers[0]]
            status = "error" if error else "lost"
            future.set_exception(error or OSError("gone"))
        else:
            future.set_result(
                [
                    {"row": {"run": number, "drawn": drawn}, "took_ns": NS_PER_S, "files": {}}
                    for number, drawn in chunk
                ]
            )
        return SimpleNamespace(status=status, future=future)

    def cancel(self, tasks: list[Any]) -> None:
        self.cancelled.append(len(tasks))


@pytest.fixture
def client(monkeypatch: pytest.MonkeyPatch, clock: type[Clock]) -> Client:
    assert clock.at == 0
    monkeypatch.setattr(on_dask, "_outcome", lambda _client, task: task.future)
    monkeypatch.setattr(on_dask, "order_of", lambda *_: HERE)
    return Client()


def rows(client: Any, numbers: range, stop: StopRequest | None = None) -> Iterator[Any]:
    return rows_on_dask(client, PLAN, numbers, stop or StopRequest())


def test_rows_come_in_order_with_what_they_draw(client: Client) -> None:
    found = list(rows(client, range(3, 20)))
    assert found == [{"run": number, "drawn": [[number], 1.0, True]} for number in range(3, 20)]
    assert client.submitted[:4] == [[3], [4], [5], [6]], "each worker has two"
    assert client.orders == {HERE}
    assert client.cancelled == [0]


def test_no_runs_ask_nobody(client: Client) -> None:
    assert list(rows(client, range(4, 4))) == []
    assert (client.looks, client.submitted) == (0, [])


def test_without_workers_two_chunks_wait_for_the_first(client: Client) -> None:
    client.count = 0
    found = rows(client, range(9))
    assert next(found)["run"] == 0
    assert client.submitted == [[0], [1]]
    found.close()  # type: ignore[attr-defined]


def test_who_asks_for_the_end_gets_it_and_what_flies_is_called_back(client: Client) -> None:
    stop = StopRequest()
    found = rows(client, range(50), stop)
    assert next(found)["run"] == 0
    stop.ask("the test")
    with pytest.raises(Interrupted, match="ended by the test"):
        next(found)
    assert client.cancelled != []


def test_a_scheduler_that_is_gone_is_asked_to_cancel_nothing(client: Client) -> None:
    found = rows(client, range(50))
    next(found)
    client.status = "closed"
    with pytest.raises(ClusterLost):
        list(found)
    assert client.cancelled == []


GONE = (
    "the scheduler at tcp://s:1 is gone, or has dropped the campaign; --resume goes on with what is stored, "
    "with another --dask or without"
)


@pytest.mark.parametrize(
    ("outcome", "kind", "told"),
    [
        (
            Killed(3, "tcp://w:9"),
            WorkerDied,
            "runs 0 to 0: 4 workers died with them, the last of them tcp://w:9",
        ),
        (
            RuntimeError("no module"),
            WorkerDied,
            "runs 0 to 0: a Dask worker failed with RuntimeError: no module; each worker needs servobench as "
            "it is here",
        ),
        (None, ClusterLost, GONE),
    ],
)
def test_what_becomes_of_a_chunk_that_is_lost_is_told(
    client: Client, outcome: BaseException | None, kind: type[Exception], told: str
) -> None:
    client.outcomes[0] = outcome
    with pytest.raises(kind) as caught:
        list(rows(client, range(1)))
    assert str(caught.value) == told


def test_a_chunk_that_was_cancelled_is_of_a_scheduler_that_is_gone(client: Client) -> None:
    its: Any = client
    future: Future[Any] = Future()
    future.cancel()
    flight = on_dask._Flight([0], SimpleNamespace(status="cancelled"))  # type: ignore[arg-type]
    with pytest.raises(ClusterLost) as caught:
        on_dask._Cluster(its).answers(future, flight)
    assert str(caught.value) == GONE


def test_an_answer_without_a_row_is_raised(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    def answers(_self: Any, _landed: Any, _flight: Any) -> list[Any]:
        return [{"error": "its bench", "status": 2}]

    monkeypatch.setattr(on_dask._Cluster, "answers", answers)
    with pytest.raises(RunRefused, match="its bench"):
        list(rows(client, range(3)))


def test_workers_are_counted_once_a_second(client: Client, clock: type[Clock]) -> None:
    its: Any = client
    cluster = on_dask._Cluster(its)
    for at_ns, looks in ((0, 1), (NS_PER_S - 1, 1), (NS_PER_S, 2), (2 * NS_PER_S - 1, 2)):
        clock.at = at_ns
        assert (cluster.workers(), client.looks) == (2, looks)


def test_without_workers_they_are_counted_each_time_for_a_minute(client: Client, clock: type[Clock]) -> None:
    its: Any = client
    clock.at = 5 * NS_PER_S
    cluster = on_dask._Cluster(its)
    client.count = 0
    clock.at += 60 * NS_PER_S - 1
    assert (cluster.workers(), cluster.workers(), client.looks) == (0, 0, 2)
    client.count = 1
    assert cluster.workers() == 1
    client.count = 0
    clock.at += 60 * NS_PER_S - 1
    assert cluster.workers() == 0
    clock.at += 1
    with pytest.raises(ClusterLost) as caught:
        cluster.workers()
    assert str(caught.value) == (
        "the scheduler at tcp://s:1 has had no worker for 60 s; dask worker tcp://s:1 --nthreads 1 starts "
        "one, --resume goes on with what is stored"
    )


@pytest.mark.parametrize(("status", "count"), [("closed", 2), ("running", None)])
def test_a_scheduler_that_does_not_answer_is_gone(client: Client, status: str, count: int | None) -> None:
    its: Any = client
    cluster = on_dask._Cluster(its)
    client.status, client.count = status, count
    with pytest.raises(ClusterLost) as caught:
        cluster.workers()
    assert str(caught.value) == GONE


class Shop:
    """Runs no bench: a row tells its number and 1.5."""

    value = 1.5

    def __init__(self, *given: Any) -> None:
        self.given = given

    @classmethod
    def of_sweep(cls, path: str, identity: str) -> "Shop":
        if identity != "abc":
            raise BusDown("another sweep")
        return cls(path, identity)

    def answers(self, chunk: Any) -> Iterator[Any]:
        for number, _ in chunk:
            yield {"row": {"run": number, "x": self.value}, "took_ns": 5}

    def row(self, number: int, drawn: Any) -> dict[str, Any]:
        return {"run": number, "drawn": drawn}


@pytest.fixture
def shop(monkeypatch: pytest.MonkeyPatch) -> type[Shop]:
    on_dask._workshop.cache_clear()
    Shop.value = 1.5
    monkeypatch.setattr(on_dask, "Workshop", Shop)
    return Shop


def test_an_order_has_a_run_as_it_is_here(
    client: Any, monkeypatch: pytest.MonkeyPatch, shop: type[Shop]
) -> None:
    monkeypatch.undo()
    monkeypatch.setattr(on_dask, "Workshop", shop)
    order = order_of(client, PLAN, 7, StopRequest())
    assert order[:3] == ("client-1", "/sweep.toml", '"abc"')
    drawn = [[7], 1.0, True]
    assert json.loads(order.witness) == [7, drawn, {"run": 7, "drawn": drawn}]


@pytest.mark.usefixtures("shop")
def test_a_worker_answers_once_it_came_to_the_same_run() -> None:
    assert run_chunk(HERE, [[4, None], [5, None]]) == [
        {"row": {"run": 4, "x": 1.5}, "took_ns": 5},
        {"row": {"run": 5, "x": 1.5}, "took_ns": 5},
    ]
    assert on_dask._workshop(HERE) is on_dask._workshop(HERE), "it is read once"


def test_a_worker_that_comes_to_another_result_takes_no_part(shop: type[Shop]) -> None:
    shop.value = 2.5
    told = (
        "run 0 comes to another result than where the campaign was started (x): servobench, its packages, "
        "own code and the kind of processor must be the same"
    )
    with pytest.raises(NotTheSame) as caught:
        on_dask._workshop(HERE)
    assert str(caught.value) == told
    assert run_chunk(HERE, [[4, None]]) == [{"error": f"worker tcp://w:1: {told}", "status": 70}]


@pytest.mark.usefixtures("shop")
def test_an_error_of_a_worker_names_it() -> None:
    other = HERE._replace(identity='"other"')
    status = BusDown.exit_status
    assert run_chunk(other, []) == [{"error": "worker tcp://w:1: another sweep", "status": status}]
