"""A recording is read only as it was recorded; what is not is told by file and place."""

import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pyarrow as pa
import pytest
from typer.testing import CliRunner

import servobench
from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import NS_PER_S, MonotonicClock
from servobench.hil.cli import app
from servobench.hil.configuration.bench_file import load_bench
from servobench.hil.rows import seal as seals
from servobench.hil.rows.frames_file import indexed_batches, read_index
from servobench.hil.rows.seal import read_seal, sealed_line
from tests.unit.hil.recorded_runs import BENCH, short_run

READERS: dict[str, Callable[[Path], list[str]]] = {
    "review": lambda run: ["review", str(run), "--against", str(run.parent / "nothing.toml")],
    "compare": lambda run: ["compare", str(run), str(run)],
    "export": lambda run: ["export", str(run), "--to", "csv", "--out", os.devnull],
    "trace": lambda run: ["trace", str(run), "--to", "0"],
    "view": lambda run: ["view", str(run)],
    "picture": lambda run: ["picture", str(run), str(run.parent / "picture.svg"), "--paper"],
    "why": lambda run: ["why", str(run), "--against", str(run.parent / "nothing.toml")],
}


@pytest.fixture(scope="module")
def unviewed_recordings() -> None:
    """None: run.rrd is one of the files."""


@pytest.fixture(scope="module")
def forked_children() -> None:
    """Loggers that are struck are real ones."""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("sealed")
    (folder / "nothing.toml").write_text("[verdict]\n")
    return short_run(folder / "run")


def copied(run: Path, tmp_path: Path) -> Path:
    shutil.copy(run.parent / "nothing.toml", tmp_path)
    return Path(shutil.copytree(run, tmp_path / "copy"))


def read(name: str, run: Path, *more: str) -> tuple[int, str]:
    without_display = {"DISPLAY": None, "WAYLAND_DISPLAY": None}
    asked = READERS[name](run) if name in READERS else [name, str(run)]
    ended = CliRunner().invoke(app, [*asked, *more], env=without_display)
    return ended.exit_code, ended.output


def names(run: Path) -> list[str]:
    return sorted(path.name for path in run.iterdir() if path.name != "logger.log")


def test_each_byte_of_each_file_counts(run: Path, tmp_path: Path) -> None:
    copy, draw = copied(run, tmp_path), random.Random(36)
    recorded = {"records.arrow", "events.jsonl", "frames.arrow", "frames.index", "run.rrd", "summary.json"}
    recorded |= {"bench.toml", "faults.arrow", "frames.index", "network.toml", "seal"}
    assert recorded == set(names(run))
    for name in names(run):
        whole = (copy / name).read_bytes()
        at, bit = draw.randrange(len(whole)), 1 << draw.randrange(8)
        flipped = whole[:at] + bytes([whole[at] ^ bit]) + whole[at + 1 :]
        for damaged in (flipped, whole[:at], whole + b"\n", None):
            (copy / name).unlink()
            if damaged is not None:
                (copy / name).write_bytes(damaged)
            status, told = read("export", copy)
            assert status == 2, (name, at, bit, told)
            assert name in told
            (copy / name).write_bytes(whole)
    assert read("export", copy)[0] == 0


@pytest.mark.parametrize("name", READERS)
def test_who_reads_a_recording_asks_its_seal(run: Path, tmp_path: Path, name: str) -> None:
    copy = copied(run, tmp_path)
    events = (copy / "events.jsonl").read_text()
    (copy / "events.jsonl").write_text(events.replace("running", "stopped"))
    status, told = read(name, copy)
    assert status == 2, told
    assert f"{copy / 'events.jsonl'}: bytes 0 to {len(events)}: found" in told
    assert "--unsealed" in told
    status, told = read(name, copy, "--unsealed")
    assert (status, "hil: note: unsealed" in told) == (0, True), told


@pytest.mark.parametrize("name", READERS)
def test_who_reads_a_recording_without_a_seal_says_so(run: Path, tmp_path: Path, name: str) -> None:
    """With its seal taken away and its format set back, as recordings of earlier versions are."""
    copy, told_as = copied(run, tmp_path), "unsealed: recorded by an older version"
    table = pa.ipc.open_file(copy / "records.arrow").read_all()
    older = table.replace_schema_metadata({**table.schema.metadata, b"format": b"3"})
    with pa.ipc.new_file(copy / "records.arrow", older.schema) as sink:
        sink.write_table(older)
    (copy / "seal").unlink()
    status, told = read(name, copy)
    assert (status, told_as in told) == (0, True), told
    assert told_as in read("runs", tmp_path)[1]
    with pytest.warns(UserWarning, match=told_as):
        assert servobench.Run(load_bench(copy / "bench.toml"), copy).summary.cycles
    assert told_as not in read(name, run)[1]


def test_a_window_of_a_trace_asks_the_seal_for_what_it_reads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of a longer recording the rest is not read, and so not held against it; of each file the length is."""
    run = tmp_path / "run"
    done = servobench.run(BENCH, {"bench.duration_s": 25.0, "load": {}}, record=run)
    log = (run / "frames.arrow").read_bytes()
    assert done.summary.cycles == 25_000
    monkeypatch.setattr(seals, "SMALL_BYTES", 1 << 16)
    assert len(log) > 1 << 18, "a smaller one is held against it as a whole"
    lying = indexed_batches(read_index(run))

    def window(begin_s: float) -> tuple[int, str]:
        ended = CliRunner().invoke(
            app, ["trace", str(run), "--from", f"{begin_s}", "--to", f"{begin_s + 0.003}"]
        )
        return ended.exit_code, ended.output

    places = {}
    for begin_s in (1, 10, 19):
        before = lying["begin"][lying["at"] <= (10**9 + begin_s) * 10**9]
        places[begin_s] = int(before[-1]) + 800
    for begin_s, place in places.items():
        (run / "frames.arrow").write_bytes(log[:place] + bytes([log[place] ^ 1]) + log[place + 1 :])
        status, told = window(begin_s)
        assert (status, "frames.arrow: bytes " in told) == (2, True), told
    (run / "frames.arrow").write_bytes(log)
    assert [window(begin_s)[0] for begin_s in places] == [0, 0, 0]
    (run / "frames.arrow").write_bytes(log + b"\n")
    assert "frames.arrow: found '1 bytes more'" in window(10)[1]


def test_a_file_that_the_run_had_not_is_told(run: Path, tmp_path: Path) -> None:
    copy = copied(run, tmp_path)
    (copy / "load.csv").write_text("at_ns,axis,torque_nm,speed_rad_s\n")
    (copy / "records.csv").write_text("an export is no part of it\n")
    status, told = read("review", copy)
    assert (status, f"{copy / 'load.csv'}: found 'a file'" in told) == (2, True)


def test_rows_put_together_from_two_runs_are_told(run: Path, tmp_path: Path) -> None:
    other, copy = short_run(tmp_path / "other", seed=5), copied(run, tmp_path)
    shutil.copy(other / "records.arrow", copy / "records.arrow")
    status, told = read("review", copy)
    assert (status, "records.arrow: rows 1 to " in told) == (2, True)


def test_batches_that_have_changed_places_are_told(run: Path, tmp_path: Path) -> None:
    """Readers of Arrow see a whole file with all of its rows."""
    copy = copied(run, tmp_path)
    with pa.ipc.open_file(copy / "records.arrow") as file:
        table, schema = file.read_all(), file.schema
    rows = table.num_rows // 2
    with pa.ipc.new_file(copy / "records.arrow", schema) as sink:
        sink.write_table(table.slice(rows))
        sink.write_table(table.slice(0, rows))
    status, told = read("review", copy)
    assert (status, "records.arrow: rows 1 to " in told) == (2, True), told


def test_a_summary_of_an_earlier_run_is_told(run: Path, tmp_path: Path) -> None:
    """Of the same bench, by itself and with its line of that run's seal."""
    other, copy = short_run(tmp_path / "other", seed=5), copied(run, tmp_path)
    shutil.copy(other / "summary.json", copy)
    for seal, place in (
        ((run / "seal").read_text(), "summary.json: "),
        (_with_line_of(other / "seal", run / "seal"), "seal: line "),
    ):
        (copy / "seal").write_text(seal)
        for name in READERS:
            status, told = read(name, copy)
            assert (status, place in told) == (2, True), told
        told = read("runs", copy)[1]
        assert ("damaged" in told, "passed" in told) == (True, False)


def _with_line_of(other: Path, seal: Path) -> str:
    of_summary = '"file": "summary.json"'
    (theirs,) = [line for line in other.read_text().splitlines() if of_summary in line]
    lines = seal.read_text().splitlines()
    return "".join(f"{theirs if of_summary in line else line}\n" for line in lines)


FORGED: tuple[dict[str, object], ...] = (
    {"file": "records.arrow"},
    {"file": 1, "begin": 0, "end": 1, "digest": ""},
    {"file": "../other", "begin": 0, "end": 1, "digest": ""},
    {"file": "records.arrow", "begin": -5, "end": 1, "digest": ""},
    {"file": "records.arrow", "begin": 0, "end": 1, "digest": "", "rows": "1"},
    {"file": "records.arrow", "begin": 0, "end": 1, "digest": "", "more": 1},
    {"passed": True},
    {},
)


@pytest.mark.parametrize("line", FORGED)
def test_a_line_of_no_known_form_is_told_whoever_chained_it(
    run: Path, tmp_path: Path, line: dict[str, object]
) -> None:
    copy = copied(run, tmp_path)
    *_, (_, chain) = read_seal(copy)
    forged, chain = sealed_line(line, chain)
    with (copy / "seal").open("a") as seal:
        seal.write(forged + sealed_line({"ended": True}, chain)[0])
    status, told = read("export", copy)
    assert (status, f"{copy / 'seal'}: line " in told) == (2, True), told


def test_what_rests_on_a_recording_says_whether_that_is_sealed(run: Path, tmp_path: Path) -> None:
    for more, mark in ((), False), (("--unsealed",), True):
        page = tmp_path / "page.md"
        assert read("review", run, "--report", str(page), *more)[0] == 0
        assert ("| seal | unsealed: requested by --unsealed |" in page.read_text()) == mark
        status, told = read("compare", run, "--json", *more)
        seals = {each["seal"] for each in json.loads(told.splitlines()[-1])["runs"]}
        assert (status, seals) == (0, {"unsealed: requested by --unsealed" if mark else "sealed"})
        status, told = read("export", run, *more)
        assert (status, told.endswith("rows; unsealed: requested by --unsealed\n")) == (0, mark)


def test_the_verdict_says_whether_it_rests_on_a_seal(run: Path) -> None:
    for more, seal in ((), "sealed"), (("--unsealed",), "unsealed: requested by --unsealed"):
        ended = CliRunner().invoke(app, [*READERS["review"](run), "--json", *more])
        assert (ended.exit_code, json.loads(ended.stdout)["seal"]) == (0, seal)


def test_a_run_of_the_python_api_is_read_only_as_it_was_recorded(tmp_path: Path) -> None:
    done = servobench.run(BENCH, {"bench.duration_s": 0.3, "load": {}}, record=tmp_path / "run")
    with (tmp_path / "run" / "frames.arrow").open("r+b") as file:
        file.write(b"R")
    for read_of in (lambda: done.table, lambda: done.events, lambda: done.wire):
        with pytest.raises(BadInput, match=r"frames\.arrow: bytes 0 to "):
            read_of()


def key_of(name: str, folder: Path) -> Path:
    """A key, and its line as an allowed signer beside it."""
    key = folder / name
    subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", str(key)], check=True)
    (folder / f"{name}.allowed").write_text(f"{name} {(folder / f'{name}.pub').read_text()}")
    return key


@pytest.mark.skipif(shutil.which("ssh-keygen") is None, reason="no ssh-keygen here")
def test_a_signature_is_that_of_its_signer_for_this_recording(run: Path, tmp_path: Path) -> None:
    copy = copied(run, tmp_path)
    key, _ = key_of("lab@example.org", tmp_path), key_of("other@example.org", tmp_path)
    status, told = read("review", copy, "--signers", str(tmp_path / "lab@example.org.allowed"))
    assert (status, "ssh-keygen -Y sign -f KEY -n servobench" in told) == (2, True)
    for purpose, expected in (("servobench", 0), ("file", 2)):
        (copy / "seal.sig").unlink(missing_ok=True)
        sign = ["ssh-keygen", "-q", "-Y", "sign", "-f", str(key), "-n", purpose, str(copy / "seal")]
        subprocess.run(sign, check=True, capture_output=True)
        status, told = read("review", copy, "--signers", str(tmp_path / "lab@example.org.allowed"))
        assert (status, "sealed; signed by lab@example.org" in told) == (expected, expected == 0), told
        status, told = read("review", copy, "--signers", str(tmp_path / "other@example.org.allowed"))
        assert (status, f"{copy / 'seal.sig'}: found" in told) == (2, True), told
    assert read("review", copy, "--unsealed", "--signers", "any")[0] == 2
    shutil.copytree(short_run(tmp_path / "remade", seed=5), copy, dirs_exist_ok=True)
    status, told = read("review", copy, "--signers", str(tmp_path / "lab@example.org.allowed"))
    assert (status, f"{copy / 'seal.sig'}: found" in told) == (2, True), "whole, and not what was signed"


@pytest.mark.parametrize(("lines", "rows"), [(6, 300), (1, 0)])
def test_recover_says_up_to_where_the_seal_is_not_its_own(
    run: Path, tmp_path: Path, lines: int, rows: int
) -> None:
    copy = copied(run, tmp_path)
    (copy / "summary.json").unlink()
    (copy / "seal").write_text("".join((copy / "seal").read_text().splitlines(keepends=True)[:lines]))
    assert CliRunner().invoke(app, ["recover", str(copy)]).exit_code == 0
    status, told = read("review", copy, "--json")
    expected = f"sealed up to row {rows} of records.arrow; the rest was found by hil recover"
    assert (status, json.loads(told)["seal"]) == (5, expected)


def test_recover_makes_no_seal_in_place_of_one_that_is_gone(run: Path, tmp_path: Path) -> None:
    copy = copied(run, tmp_path)
    (copy / "summary.json").unlink()
    (copy / "seal").unlink()
    ended = CliRunner().invoke(app, ["recover", str(copy), "--json"])
    assert (ended.exit_code, (copy / "seal").exists()) == (0, False)
    assert any("it has no seal" in text for text in json.loads(ended.stdout)["recording_faults"])
    status, told = read("export", copy)
    assert (status, "no file seal" in told) == (2, True)
    assert read("export", copy, "--unsealed")[0] == 0


def with_descendants(pid: int) -> list[int]:
    found = [pid]
    for each in found:
        children = subprocess.run(["pgrep", "-P", str(each)], capture_output=True, text=True, check=False)
        found += map(int, children.stdout.split())
    return found


def still_runs(pid: int) -> bool:
    """Of a process that is gone, or whose parent has not asked yet what became of it, no file is open."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_a_run_that_was_killed_has_a_seal_up_to_its_last_second(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    bench = tmp_path / "bench.toml"
    bench.write_text(
        BENCH.read_text()
        .replace('"motors/', f'"{BENCH.parent}/motors/')
        .replace('"faults/', f'"{BENCH.parent}/faults/')
        .replace("duration_s = 2.0", "duration_s = 600.0")
    )
    command = [sys.executable, "-m", "servobench.hil.cli", "run", str(bench), "--record", str(folder)]
    process = subprocess.Popen(command, start_new_session=True, stderr=subprocess.DEVNULL)
    seal = folder / "seal"
    clock = MonotonicClock()
    ends_at = clock.now() + 60 * NS_PER_S
    while not (seal.exists() and seal.read_text().count("records.arrow") >= 3):
        assert clock.now() < ends_at
        assert process.poll() is None
    pids = with_descendants(process.pid)
    for pid in reversed(pids):  # the logger first: it would end the recording
        os.kill(pid, signal.SIGKILL)
    process.wait()
    while any(still_runs(pid) for pid in pids):
        assert clock.now() < ends_at
    begun = seal.read_bytes()
    ended = CliRunner().invoke(app, ["recover", str(folder)])
    while (
        "its logger still writes" in ended.output
    ):  # a killed process is a zombie before its last thread ends
        assert clock.now() < ends_at
        ended = CliRunner().invoke(app, ["recover", str(folder)])
    assert ended.exit_code == 0, ended.output
    assert seal.read_bytes().startswith(begun[: begun.rindex(b"\n") + 1])
    told = CliRunner().invoke(app, ["review", str(folder), "--json"]).stdout
    (sealed_rows,) = re.findall(r'"sealed up to row (\d+) of records.arrow', told)
    assert 0 < int(sealed_rows) <= json.loads(told)["cycles"]
    rows = (folder / "records.arrow").read_bytes()
    (folder / "records.arrow").write_bytes(rows[:5000] + bytes([rows[5000] ^ 1]) + rows[5001:])
    status, told = read("export", folder)
    assert (status, "records.arrow: rows 1 to " in told) == (2, True), told


def test_damaged_records_without_a_seal_are_bad_input_at_worst(run: Path, tmp_path: Path) -> None:
    copy, draw = copied(run, tmp_path), random.Random(70)
    whole = (run / "records.arrow").read_bytes()
    refused = 0
    for _ in range(60):
        damaged = bytearray(whole)
        damaged[draw.choice([draw.randrange(6000), len(whole) - 1 - draw.randrange(9000)])] ^= (
            1 << draw.randrange(8)
        )
        (copy / "records.arrow").write_bytes(damaged)
        status, told = read("export", copy, "--unsealed")
        assert status in (0, 2), told
        refused += status == 2 and "records.arrow" in told
    assert refused > 5
