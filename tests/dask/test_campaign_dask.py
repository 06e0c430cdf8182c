"""Campaigns on a Dask cluster of 127.0.0.1: the same table as here, whatever is killed; what is refused."""

import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from distributed import LocalCluster
from typer.testing import CliRunner

from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import NS_PER_S, MonotonicClock
from servobench.hil.campaign import campaign as campaign_module
from servobench.hil.campaign import on_dask
from servobench.hil.campaign.campaign import Campaign, CampaignProgress, run_campaign
from servobench.hil.campaign.on_dask import ClusterLost, dask_client, rows_on_dask
from servobench.hil.campaign.plan import CampaignPlan
from servobench.hil.campaign.pool import RunRefused, WorkerDied
from servobench.hil.campaign.worker import Answer, Workshop
from servobench.hil.cli import app
from servobench.hil.configuration.config_files import toml_text
from servobench.hil.machine.extras import MissingExtra
from servobench.hil.machine.stopping import Interrupted, StopRequest
from servobench.hil.verdict.verdict import ExitStatus
from servobench.virtual_bus.child_python import python_command, python_environment
from tests.scenario.test_campaign import CHANGES

ROOT = Path(__file__).parents[2]
HOST = "127.0.0.1"
PAGES = f"{HOST}:0"
"""Dask serves pages of its own, asked for or not."""
WORKER = r"tcp://127\.0\.0\.1:\d+"
RUNS = 24


def written(folder: Path, **more: Any) -> Path:
    tables = {
        "campaign": {
            "name": "short",
            "bench": str(ROOT / "examples" / "ling2012.toml"),
            "seeds": RUNS // 2,
            "failures_recorded": 0,
        },
        "change": CHANGES,
        "vary": [{"key": "faults.loss.0.probability", "values": [0.02, 0.2]}],
        **more,
    }
    path = folder / "sweep.toml"
    path.write_text(toml_text(tables))
    return path


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Campaign]:
    """A table is stored at once at its end, however long the runs take here."""
    folder = tmp_path_factory.mktemp("campaign")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(campaign_module, "STORED_EVERY_NS", 10**18)
        yield run_campaign(written(folder), folder / "out", workers=1)


def cluster_of(workers: int) -> LocalCluster:
    return LocalCluster(
        n_workers=workers,
        threads_per_worker=1,
        processes=True,
        host=HOST,
        dashboard_address=PAGES,
        worker_dashboard_address=PAGES,
    )


@pytest.fixture(scope="module")
def cluster() -> Iterator[LocalCluster]:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT))  # the workers import functions of this file
        with cluster_of(2) as made:
            yield made


def after(count: int, act: Callable[[], object]) -> Callable[[CampaignProgress], object]:
    """Acts when so many runs are done."""
    return lambda at: at.done == count and act()


def bytes_of(campaign: Campaign) -> list[bytes]:
    return [path.read_bytes() for path in sorted(campaign.folder.glob("runs/*"))]


def test_a_cluster_comes_to_the_same_table(done: Campaign, cluster: LocalCluster, tmp_path: Path) -> None:
    command = ["campaign", str(done.plan.source), "--out", str(tmp_path / "out")]
    ran = CliRunner().invoke(app, [*command, "--dask", cluster.scheduler_address])
    assert ran.exit_code == 0, ran.output
    assert len(bytes_of(done)) == 1
    assert bytes_of(Campaign(tmp_path / "out", done.plan)) == bytes_of(done)


def test_a_killed_worker_changes_nothing(done: Campaign, cluster: LocalCluster, tmp_path: Path) -> None:
    address = cluster.scheduler_address
    with dask_client(address) as client:
        pid = next(iter(client.run(os.getpid).values()))
    kill = after(6, lambda: os.kill(pid, signal.SIGKILL))
    found = run_campaign(done.plan, tmp_path / "out", dask=address, progress=kill)
    assert bytes_of(found) == bytes_of(done)


def test_who_asks_for_the_end_leaves_nothing_behind(
    done: Campaign, cluster: LocalCluster, tmp_path: Path
) -> None:
    stop, address = StopRequest(), cluster.scheduler_address
    with pytest.raises(Interrupted):
        run_campaign(done.plan, tmp_path / "out", dask=address, stop=stop, progress=after(4, stop.ask))
    assert Campaign(tmp_path / "out", done.plan).table.equals(done.table.slice(0, 4))
    assert cluster.scheduler is not None
    assert not cluster.scheduler.tasks


def python(module: str, *arguments: str) -> subprocess.Popen[str]:
    command = python_command(module, "--host", HOST, "--dashboard-address", PAGES, *arguments)
    return subprocess.Popen(command, env=python_environment(), stderr=subprocess.PIPE, text=True)


@pytest.fixture
def scheduler() -> Iterator[tuple[subprocess.Popen[str], str]]:
    """One with a worker, in processes of their own."""
    with python("distributed.cli.dask_scheduler", "--port", "0", "--no-jupyter") as process:
        assert process.stderr is not None
        address = next(line.split()[-1] for line in process.stderr if "Scheduler at:" in line)
        worker = python("distributed.cli.dask_worker", address, "--nthreads", "1", "--no-nanny")
        with worker:
            yield process, address
            worker.kill()
        process.kill()


def test_a_killed_scheduler_is_told_and_any_other_way_goes_on(
    done: Campaign, scheduler: tuple[subprocess.Popen[str], str], tmp_path: Path
) -> None:
    process, address = scheduler
    with pytest.raises(ClusterLost, match=f"the scheduler at {address} is gone, .* --resume goes on"):
        run_campaign(done.plan, tmp_path / "out", dask=address, progress=after(6, process.kill))
    stored = Campaign(tmp_path / "out", done.plan).table
    assert 6 <= stored.num_rows < RUNS
    resumed = run_campaign(done.plan, tmp_path / "out", workers=1, resume=True)
    assert resumed.table.equals(done.table)


def test_a_scheduler_without_workers_is_not_waited_for_without_end(
    done: Campaign, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(on_dask, "WITHOUT_WORKER_NS", 0)
    with cluster_of(0) as empty, dask_client(empty.scheduler_address) as client:
        rows = rows_on_dask(client, done.plan, range(RUNS), StopRequest())
        with pytest.raises(ClusterLost, match=r"has had no worker for 0 s; dask worker tcp://127\.0\.0\.1"):
            next(rows)


@pytest.fixture
def silent() -> Iterator[str]:
    """Takes connections, and says nothing."""
    with socket.create_server((HOST, 0)) as listening:
        yield "{}:{}".format(*listening.getsockname())


@pytest.mark.parametrize("address", ["silent", f"{HOST}:1", "carrier://pigeon", f"{HOST}:many"])
def test_a_wrong_address_is_refused_before_anything_is_written(
    done: Campaign, silent: str, address: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(on_dask, "CONNECT_S", 0.3)
    clock = MonotonicClock()
    began = clock.now()
    with pytest.raises(BadInput, match=r"--dask: found '.*', expected the address of a Dask scheduler"):
        run_campaign(done.plan, tmp_path / "out", dask=silent if address == "silent" else address)
    assert clock.now() - began < 10 * NS_PER_S
    assert not (tmp_path / "out").exists()


def test_without_the_extra_its_name_is_told(
    done: Campaign, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(MissingExtra, match=r"pip install 'servobench\[campaign\]'"):
        run_campaign(done.plan, tmp_path / "out", dask=f"{HOST}:8786")
    assert not (tmp_path / "out").exists()
    with pytest.raises(BadInput, match="--workers: found 2, expected nothing beside --dask"):
        run_campaign(done.plan, tmp_path / "out", dask=f"{HOST}:8786", workers=2)


def test_a_worker_that_reads_another_sweep_is_refused(cluster: LocalCluster, tmp_path: Path) -> None:
    plan = CampaignPlan.load(written(tmp_path))
    written(tmp_path, drawing={"seed": 3})
    told = rf"worker {WORKER}: .*sweep.toml: found 'BLAKE2b .* as other runs of the campaign met it"
    with pytest.raises(RunRefused, match=told):
        run_campaign(plan, tmp_path / "out", dask=cluster.scheduler_address)


def test_a_worker_that_comes_to_other_results_is_refused(
    done: Campaign, cluster: LocalCluster, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    honest = Workshop.row
    monkeypatch.setattr(Workshop, "row", lambda *given: honest(*given) | {"digest": "0" * 32})
    told = rf"worker {WORKER}: run 0 comes to another result .* \(digest\)"
    with pytest.raises(RunRefused, match=told) as caught:
        run_campaign(done.plan, tmp_path / "out", dask=cluster.scheduler_address)
    assert caught.value.exit_status == ExitStatus.DEFECT


def broken(_order: on_dask.Order, _chunk: list[int]) -> list[Answer]:
    raise PermissionError("no such right")


def test_an_error_of_a_worker_is_not_taken_for_one_of_the_connection(
    done: Campaign, cluster: LocalCluster, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(on_dask, "run_chunk", broken)
    with pytest.raises(WorkerDied, match="a Dask worker failed with PermissionError: no such right"):
        run_campaign(done.plan, tmp_path / "out", dask=cluster.scheduler_address)


def deadly(_order: on_dask.Order, _chunk: list[int]) -> list[Answer]:
    os.kill(os.getpid(), signal.SIGKILL)
    return []


def test_a_chunk_that_kills_its_workers_ends_the_campaign(
    done: Campaign, cluster: LocalCluster, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(on_dask, "run_chunk", deadly)
    monkeypatch.setattr(cluster.scheduler, "allowed_failures", 0)
    with pytest.raises(WorkerDied, match=rf"runs (\d) to \1: 1 workers died .* last of them {WORKER}"):
        run_campaign(done.plan, tmp_path / "out", dask=cluster.scheduler_address)
