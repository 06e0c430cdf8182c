"""What a run of a campaign costs beside its cycles, and what a second worker costs.

Processor time of the demo bench (2 s simulated, faults, one axis), medians of some runs of the same process:
the whole of a run as a campaign does it, its cycles alone, and its bring-up (connect, configure, calibrate,
enable, and at the end to bring the drive to rest). The target is at most 1.3 for what is neither.
"""

import pickle
import resource
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, contextmanager
from hashlib import blake2b
from multiprocessing import get_context
from pathlib import Path
from statistics import median
from typing import Any
from unittest.mock import patch

from distributed import Client, LocalCluster

from servobench.drivers.timebase import NS_PER_S, MonotonicClock
from servobench.hil.campaign.on_dask import Order, dask_client, order_of, rows_on_dask, run_chunk
from servobench.hil.campaign.plan import CampaignPlan
from servobench.hil.campaign.pool import WorkerPool
from servobench.hil.campaign.store import open_campaign
from servobench.hil.campaign.sweep_file import sweep_from
from servobench.hil.campaign.worker import Workshop
from servobench.hil.configuration.config_files import toml_text
from servobench.hil.execution.bench import _Run
from servobench.hil.machine.stopping import StopRequest

ROOT = Path(__file__).parents[2]
WARM, MEASURED = 3, 10
FEW, MANY = 4, 44
SETTLED, LONG = 64, 200
"""Runs until chunks are as long as they should be; runs after them."""
EMPTY, IN_FLIGHT = 1000, 4
"""Chunks without a run, and how many of them are handed out at a time."""
CHUNK = 8
"""Runs of the demo bench in half a second."""
CYCLES = "cycles"
BRING_UP = ("_prepare", "_calibrate_and_run", "_release")
"""The second holds the cycles, which are taken out of it."""


def main() -> None:
    """Print four tables."""
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "sweep.toml"
        campaign = {"name": "bench", "bench": str(ROOT / "examples" / "ling2012.toml"), "seeds": 1000}
        tables = {"campaign": campaign, "vary": [{"key": "loop.deadline_us", "values": [2000]}]}
        path.write_text(toml_text(tables), encoding="utf-8")
        plan = CampaignPlan(sweep_from(tables, str(path)), path)
        _print_one_process(plan)
        _print_workers(plan)
        _print_dask(plan)
        _print_store(plan, Path(scratch) / "out")


def processor_s(who: int = resource.RUSAGE_SELF) -> float:
    """User and system time so far."""
    used = resource.getrusage(who)
    return used.ru_utime + used.ru_stime


@contextmanager
def metered(names: tuple[str, ...]) -> Iterator[dict[str, list[float]]]:
    """Processor time of each call of these methods of a run, and of its cycles."""
    spent: dict[str, list[float]] = {name: [] for name in (*names, CYCLES)}
    running_from_s = 0.0

    def enter(run: _Run, phase: str) -> None:
        nonlocal running_from_s
        if phase == "running":
            running_from_s = processor_s()
        enter_phase(run, phase)

    def note_ended(run: _Run, *given: Any) -> None:
        spent[CYCLES].append(processor_s() - running_from_s)
        note(run, *given)

    def meter(name: str, method: Callable[..., Any]) -> Callable[..., Any]:
        def called(*given: Any, **named: Any) -> Any:
            began = processor_s()
            try:
                return method(*given, **named)
            finally:
                spent[name].append(processor_s() - began)

        return called

    enter_phase, note = _Run._enter, _Run._note_ended
    with ExitStack() as stack:
        stack.enter_context(patch.object(_Run, "_enter", enter))
        stack.enter_context(patch.object(_Run, "_note_ended", note_ended))
        for name in names:
            stack.enter_context(patch.object(_Run, name, meter(name, getattr(_Run, name))))
        yield spent


def _print_one_process(plan: CampaignPlan) -> None:
    workshop = Workshop(plan)
    for number in range(WARM):
        workshop.row(number)
    whole = []
    with metered(BRING_UP) as spent:
        for number in range(WARM, WARM + MEASURED):
            began = processor_s()
            workshop.row(number)
            whole.append(processor_s() - began)
    cycles = median(spent[CYCLES])
    brought = [
        sum(parts) - loop
        for loop, *parts in zip(spent[CYCLES], *(spent[name] for name in BRING_UP), strict=True)
    ]
    bring_up, total = median(brought), median(whole)
    print(f"{'processor time of a run, ms':40} {'':>8}   x cycles alone")
    for title, value in (
        ("cycles alone", cycles),
        ("bring-up and rest", bring_up),
        ("whole run, figures included", total),
        ("whole run without bring-up", total - bring_up),
    ):
        print(f"{title:40} {1e3 * value:8.1f}   {value / cycles:8.2f}")
    print(f"{'runs per second and core':40} {1 / total:8.1f}")


def _print_workers(plan: CampaignPlan) -> None:
    """The start of a process is taken out by two campaigns of different length."""
    print(f"\n{'workers':40} {'ms a run':>8}   runs/s by the clock")
    first = 0.0
    for workers in (1, 2):
        (few_s, few_ns), (many_s, many_ns) = (_pooled(plan, workers, count) for count in (FEW, MANY))
        cost = (many_s - few_s) / (MANY - FEW)
        first = first or cost
        pace = (MANY - FEW) * NS_PER_S / max(1, many_ns - few_ns)
        print(
            f"{workers:<40} {1e3 * cost:8.1f}   {pace:8.1f}   processor time x one worker {cost / first:.2f}"
        )


def _pooled(plan: CampaignPlan, workers: int, count: int) -> tuple[float, int]:
    """Processor time of the workers, and time by the clock, ns."""
    clock = MonotonicClock()
    before, began = processor_s(resource.RUSAGE_CHILDREN), clock.now()
    for _ in WorkerPool(plan, workers, StopRequest()).rows(range(count)):
        pass
    return processor_s(resource.RUSAGE_CHILDREN) - before, clock.now() - began


def _print_dask(plan: CampaignPlan) -> None:
    """Client and scheduler are in this process; chunks of a worker and of a plain process take turns."""
    with (
        LocalCluster(
            n_workers=2,
            threads_per_worker=1,
            host="127.0.0.1",
            dashboard_address="127.0.0.1:0",
            worker_dashboard_address="127.0.0.1:0",
        ) as cluster,
        dask_client(cluster.scheduler_address) as client,
        ProcessPoolExecutor(1, get_context("spawn")) as plain,
    ):
        order = order_of(client, plan, 0, StopRequest())
        chunk = [[number, plan.drawn(number)] for number in range(CHUNK)]
        costs = [
            (
                plain.submit(chunk_s, order, chunk).result(),
                client.submit(chunk_s, order, chunk, pure=False).result(),
            )
            for _ in range(1 + MEASURED)
        ]
        own, on_dask = (1e3 * median(each) / CHUNK for each in zip(*costs[1:], strict=True))
        print(f"\n{'Dask':40} {'':>8}")
        print(f"{'a run in a plain process, ms':40} {own:8.1f}")
        print(f"{'a run in a worker of Dask, ms':40} {on_dask:8.1f}   x {on_dask / own:.2f}")
        here = processor_s()
        for row in rows_on_dask(client, plan, range(SETTLED + LONG), StopRequest()):
            if row["run"] == SETTLED - 1:
                here = processor_s()
        print(f"{'client and scheduler, ms a run':40} {1e3 * (processor_s() - here) / LONG:8.2f}")
        here, there = processor_s(), _workers_s(client)
        for _ in range(EMPTY // IN_FLIGHT):
            client.gather([client.submit(run_chunk, order, [], pure=False) for _ in range(IN_FLIGHT)])
        print(f"{'an empty chunk, client and scheduler, us':40} {1e6 * (processor_s() - here) / EMPTY:8.0f}")
        print(f"{'an empty chunk, worker, us':40} {1e6 * (_workers_s(client) - there) / EMPTY:8.0f}")
        sent, answered = (len(pickle.dumps(each)) for each in ((order, chunk), run_chunk(order, chunk)))
        print(f"{f'{CHUNK} runs, bytes there and back':40} {sent:8d}   {answered:8d}")


def chunk_s(order: Order, chunk: list[Any]) -> float:
    """Processor time of a chunk in the process that runs it, all its threads."""
    began = processor_s()
    run_chunk(order, chunk)
    return processor_s() - began


def _workers_s(client: Client) -> float:
    """Processor time of all workers so far."""
    return float(sum(client.run(processor_s).values()))


def _print_store(plan: CampaignPlan, folder: Path) -> None:
    """A thousand rows of different digests and figures."""
    row = Workshop(plan).row(0)
    store = open_campaign(folder, plan, resume=False)
    rows = []
    for number in range(1000):
        digest = blake2b(str(number).encode(), digest_size=16).hexdigest()
        figures = {"speed_error_peak_rad_s": 1.0 / (1 + number), "speed_error_rms_rad_s": 1.0 / (2 + number)}
        rows.append(row | {"run": number, "digest": digest, **figures})
    began = processor_s()
    store.append(rows)
    spent = processor_s() - began
    size = sum(path.stat().st_size for path in folder.rglob("*.parquet"))
    print(f"\n{'table, bytes a run':40} {size / len(rows):8.1f}\n{'table, us a run':40} {1e3 * spent:8.1f}")


if __name__ == "__main__":
    main()
