"""A bench run from Python: in memory and recorded, from threads, in little time."""

import json
import re
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest

import servobench
from servobench import Bench, Run, run
from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import NS_PER_US
from servobench.hil.testing.wire import ORIGIN
from servobench.virtual_bus.faults.fault_plan import FaultPlan

pytestmark = pytest.mark.long

ROOT = Path(__file__).parents[3]
LING = ROOT / "examples" / "ling2012.toml"
SHORT = {"bench.duration_s": 0.8, "load.axis1.0.at_s": 0.6}
"""With the blackout of the fault plan, and its end."""


@pytest.fixture(scope="module")
def in_memory() -> Run:
    return run(LING, SHORT)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Run:
    return run(LING, SHORT, record=tmp_path_factory.mktemp("runs") / "run")


def test_memory_and_recording_are_the_same_run(in_memory: Run, recorded: Run) -> None:
    assert in_memory.digest == recorded.digest
    assert in_memory.rows.size == 800
    for name in _timeless(in_memory):
        np.testing.assert_array_equal(in_memory.rows[name], recorded.rows[name], name)
    assert in_memory.table.schema.field("velocity_rad_s").metadata[b"unit"] == b"rad/s"
    assert in_memory.verdict == recorded.verdict


def _timeless(found: Run) -> list[str]:
    """What does not depend on the host's own clock."""
    names: tuple[str, ...] = found.rows.dtype.names or ()
    return [name for name in names if name != "compute_ns"]


def test_memory_tells_the_same_events(in_memory: Run, recorded: Run) -> None:
    told = sorted(json.dumps(event) for event in in_memory.events)
    assert told == sorted(json.dumps(event) for event in recorded.events)
    assert any("blackout" in event for event in told)


def test_memory_keeps_the_same_frames(in_memory: Run, recorded: Run) -> None:
    frames = in_memory.wire.frames
    assert [frame._replace(at=ORIGIN) for frame in frames] == [
        frame._replace(at=ORIGIN) for frame in recorded.wire.frames
    ]
    apart = [mine.at - other.at for mine, other in zip(frames, recorded.wire.frames, strict=True)]
    assert max(map(abs, apart)) < NS_PER_US, "candump writes whole microseconds"


def test_what_was_not_recorded_is_refused(in_memory: Run) -> None:
    with pytest.raises(ValueError, match="not recorded; run it with record=DIR"):
        _ = in_memory.folder
    with pytest.raises(AssertionError, match="recording: none was asked for"):
        in_memory.assert_error_below(rad_s=0.0)


def test_columns_are_those_of_an_axis(in_memory: Run) -> None:
    assert np.diff(in_memory.column("due_at")).tolist() == [1_000_000] * 799
    assert np.nanmax(in_memory.column("velocity_rad_s", "axis1")) == pytest.approx(157.08, rel=0.1)
    with pytest.raises(ValueError, match="axis 'axis9': say one of axis1"):
        in_memory.column("due_at", "axis9")
    with pytest.raises(ValueError, match="column 'speed': there are sequence"):
        in_memory.column("speed")


def test_threads_run_benches_at_the_same_time(in_memory: Run) -> None:
    found: list[str] = []

    def one() -> None:
        found.append(run(LING, SHORT).digest)

    threads = [threading.Thread(target=one) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == [in_memory.digest] * 2


def test_keys_lead_into_the_files_that_a_bench_names() -> None:
    keys = {"drive.axis1.motor.mechanics.inertia_kg_m2": 0.001, "faults.loss.0.probability": 0.3}
    changed = Bench.load(LING).changed(keys).config
    assert changed.drive["axis1"].motor.parameters.inertia_kg_m2 == 0.001
    assert isinstance(changed.faults, FaultPlan)
    assert changed.faults.as_tables()["loss"][0]["probability"] == 0.3
    assert Bench.load(LING).config.drive["axis1"].motor.parameters.inertia_kg_m2 == 0.0008


@pytest.mark.parametrize(
    ("key", "told"),
    [
        ("loop.periodus", "loop.periodus"),
        ("faults.loss.7.probability", "a number below 1, that of an entry of faults.loss"),
        ("faults.loss.².probability", "a number below 1, that of an entry of faults.loss"),
        ("bench.name.part", "bench.name is no table"),
        ("drive.axis1.motor.mechanics.inertia", "drive.axis1.motor.mechanics.inertia"),
    ],
)
def test_a_key_that_leads_nowhere_is_refused(key: str, told: str) -> None:
    with pytest.raises(BadInput, match=told):
        _ = Bench.load(LING).changed({key: 1}).config


def test_real_time_needs_a_folder() -> None:
    with pytest.raises(BadInput, match="another process records"):
        run(LING, bus="hub:nowhere")


def test_the_import_brings_nothing_heavy() -> None:
    heavy = "{'numpy', 'pydantic', 'scipy', 'rerun', 'pyarrow', 'can'}"
    code = f"from servobench import run; import sys; print(sorted({heavy} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "[]\n"


def test_every_public_name_is_there() -> None:
    assert all(getattr(servobench, name) is not None for name in servobench.__all__)
    with pytest.raises(AttributeError) as caught:
        servobench.__getattr__("Bensch")
    assert str(caught.value) == "module 'servobench' has no attribute 'Bensch'"


def test_the_block_of_the_docs_runs(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (block,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "python.md").read_text(), re.DOTALL)
    monkeypatch.chdir(ROOT)
    exec(block, {})
    assert capsys.readouterr().out.startswith("passed ")
