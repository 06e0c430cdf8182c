"""`hil review --log`: logs with a drawn truth, and one of a run beside its own recording."""

import json
import random
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from servobench.hil.cli import app
from servobench.hil.reviewing.log_content import cyclic_pdo, sync_grid
from servobench.hil.reviewing.trace.bus_log import BusLog
from servobench.hil.testing.bench_runs import BenchRunner
from tests.draws import few_of
from tests.recorded_frames import candump
from tests.scenario.foreign_logs import FOREIGN, ForeignLog
from tests.scenario.processes import EXAMPLES

BENCH = EXAMPLES / "ling2012.toml"
PERIOD_US = 1000
START_US = 1_700_000_000_000_000
ENABLED = 0x0637
CYCLES = 400


def hil_review(log: Path, *arguments: str, bench: Path = BENCH) -> Result:
    return CliRunner().invoke(app, ["review", "--log", str(log), "--bench", str(bench), *arguments])


def told(log: Path, bench: Path = BENCH) -> dict[str, Any]:
    figures: dict[str, Any] = json.loads(hil_review(log, "--json", bench=bench).stdout)
    return figures


@dataclass
class Drawn:
    """A bus with a drive that nobody of this bench has run, and what is true of it."""

    seed: int
    frames: list[tuple[int, int, str]] = field(default_factory=list)
    """us, identifier, data in hexadecimal."""
    lost: set[int] = field(default_factory=set)
    late: set[int] = field(default_factory=set)
    missed: set[int] = field(default_factory=set)
    delays_us: dict[int, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        dice = random.Random(self.seed)
        self.say(-50_000, 0x701, "00")
        self.map(-40_000, 0x1A00, (0x606C0020, 0x60410010))
        self.map(-30_000, 0x1600, (0x60710010,))
        self.say(-20_000, 0x701, "05")
        for cycle in range(CYCLES):
            at = cycle * PERIOD_US
            edge = cycle in (0, CYCLES - 1)
            if not edge and dice.random() < 0.02:
                self.missed.add(cycle)
                continue
            self.say(at, 0x080, "")
            self.say(at + 300, 0x201, "0500")
            if not edge and dice.random() < 0.05:
                self.lost.add(cycle)
                continue
            delay = dice.randrange(150, 800)
            if not edge and dice.random() < 0.03 and cycle + 1 < CYCLES - 1:
                delay = dice.randrange(1010, 1090)
            self.delays_us[cycle] = delay
            self.say(at + delay, 0x181, (1000 + cycle).to_bytes(4, "little").hex() + "3706")
            if cycle % 50 == 0:
                self.say(at + 120, 0x701, "05")

    def say(self, at_us: int, can_id: int, data: str) -> None:
        self.frames.append((at_us, can_id, data))

    def map(self, at_us: int, index: int, words: tuple[int, ...]) -> None:
        objects = [(sub, word, 0x23) for sub, word in enumerate(words, start=1)]
        for step, (sub, value, code) in enumerate([*objects, (0, len(words), 0x2F)]):
            head = f"{code:02X}{index & 0xFF:02X}{index >> 8:02X}{sub:02X}"
            self.say(at_us + 1000 * step, 0x601, head + value.to_bytes(4, "little").hex())
            self.say(at_us + 1000 * step + 300, 0x581, f"60{head[2:]}00000000")

    def write(self, path: Path) -> Path:
        lines = []
        for at_us, can_id, data in sorted(self.frames, key=lambda frame: frame[0]):
            seconds, us = divmod(START_US + at_us, 1_000_000)
            lines.append(f"({seconds}.{us:06d}) can0 {can_id:03X}#{data.upper()}\n")
        path.write_text("".join(lines))
        return path


@pytest.mark.parametrize("seed", few_of(range(12), 4))
def test_what_is_counted_is_what_was_drawn(seed: int, tmp_path: Path) -> None:
    """A frame that comes after the next SYNC answers its own where that next cycle has its answer, too."""
    drawn = Drawn(seed)
    beyond = {cycle for cycle, delay in drawn.delays_us.items() if delay > PERIOD_US}
    told_apart = {cycle for cycle in beyond if cycle + 1 in drawn.delays_us}
    figures = told(drawn.write(tmp_path / "drawn.log"))
    reading = figures["axes"]["axis1"]["pdos"][0]
    assert reading["name"] == figures["axes"]["axis1"]["reading"] == "TPDO1"
    assert figures["sync"]["can0"]["missed"] == len(drawn.missed)
    assert figures["sync"]["can0"]["syncs"] == CYCLES - len(drawn.missed)
    chained = (beyond - told_apart) | {cycle for cycle in told_apart if cycle + 1 in beyond}
    if not chained:
        assert reading["after_the_next_sync"] == len(told_apart)
        assert reading["lost"] == len(drawn.lost)
        assert reading["delay_us"]["max"] == max(drawn.delays_us.values())
    assert abs(reading["lost"] - len(drawn.lost)) <= len(chained)
    assert figures["axes"]["axis1"]["pdos"][1]["lost"] == 0
    assert figures["axes"]["axis1"]["command"] == "RPDO1"
    assert figures["axes"]["axis1"]["pdos"][1]["delay_us"] == {"p50": 300.0, "p99": 300.0, "max": 300.0}


def test_cycles_by_hand() -> None:
    """Two SYNCs are missing at 30 and 40; the third frame is late, one is lost, one comes twice."""
    syncs = np.array([0, 10, 20, 50, 60, 70], np.int64)
    grid = sync_grid(syncs, [], 10, 80)
    assert grid.at.tolist() == [0, 10, 20, 30, 40, 50, 60, 70]
    assert grid.there.tolist() == [True, True, True, False, False, True, True, True]
    pdo = cyclic_pdo(np.array([3, 21, 24, 62, 63, 74], np.int64), grid, 1)
    assert pdo.delay_ns.tolist() == [3, 11, 4, -1, -1, 12, 3, 4]
    assert pdo.late.tolist() == [False, True, False, False, False, True, False, False]
    assert pdo.lost.tolist() == [False] * 8
    pdo = cyclic_pdo(np.array([3, 24, 54, 55, 74], np.int64), grid, 1)
    assert np.flatnonzero(pdo.lost).tolist() == [1, 6]
    assert (pdo.extra, pdo.in_a_row()) == (1, 1)


def test_what_was_not_recorded_is_not_missing() -> None:
    """A silence of a log, between two SYNCs far from each other."""
    syncs = np.array([0, 10, 20, 500, 510, 520], np.int64)
    grid = sync_grid(syncs, [(23, 500)], 10, 530)
    assert (grid.missed, grid.there.size) == (0, 6)
    pdo = cyclic_pdo(np.array([3, 13, 503, 513, 523], np.int64), grid, 1)
    assert np.count_nonzero(pdo.lost) == 0
    assert sync_grid(syncs, [], 10, 530).missed == 47


@pytest.mark.parametrize("kind", [None, 255, 254, 2])
def test_a_pdo_by_event_has_no_losses_and_one_of_each_second_sync_its_own(kind: int | None) -> None:
    syncs = np.arange(0, 1000, 10, dtype=np.int64)
    at = syncs[::2] + 4 if kind in (None, 2) else np.array([5, 91, 92, 400], np.int64)
    pdo = cyclic_pdo(at[at != 204], sync_grid(syncs, [], 10, 1000), kind)
    assert pdo.every == (2 if kind in (None, 2) else None)
    assert np.flatnonzero(pdo.lost).tolist() == ([20] if kind in (None, 2) else [])


def test_a_boot_up_begins_no_heartbeat(tmp_path: Path) -> None:
    """Nobody has asked for heartbeats yet; later the time-out of the bench holds."""
    drawn = Drawn(4)
    drawn.frames = [frame for frame in drawn.frames if frame[1] != 0x701]
    for at_us in (-900_000, 0, 50_000, 380_000):
        drawn.say(at_us, 0x701, "00" if at_us < 0 else "05")
    figures = told(drawn.write(tmp_path / "drawn.log"))
    assert figures["axes"]["axis1"]["heartbeat_gap_s"] == pytest.approx(0.33)
    assert figures["verdict"]["findings"] == ["axis1: no heartbeat for 0.330 s, more than 0.15 s"]


def test_states_emergencies_and_heartbeats(tmp_path: Path) -> None:
    drawn = Drawn(3)
    drawn.say(123_450, 0x081, "1023040000000000")
    drawn.say(130_000, 0x701, "7F")
    log = drawn.write(tmp_path / "drawn.log")
    done = hil_review(log)
    assert done.exit_code == 3
    assert done.stdout.splitlines()[-1] == "BUS, DRIVE OR SAFETY"
    axis = told(log)["axes"]["axis1"]
    assert [state["state"] for state in axis["states"]] == ["operation enabled"]
    states = ["boot-up", "operational", "pre-operational", "operational"]
    assert [state["state"] for state in axis["nmt"]] == states
    (emergency,) = axis["emergencies"]
    assert emergency["at_s"] == pytest.approx(0.17345)
    assert "2310h" in emergency["text"]


def limited(tmp_path: Path, text: str) -> Path:
    bench = tmp_path / "bench.toml"
    lines = BENCH.read_text().split("[verdict]")[0]
    for folder in ("motors", "controllers", "faults"):
        lines = lines.replace(f'"{folder}/', f'"{EXAMPLES}/{folder}/')
    bench.write_text(f"{lines}[verdict]\n{text}\n")
    return bench


@pytest.mark.parametrize(
    ("text", "status", "outcome"),
    [
        ("dropouts_percent_max = 50", 0, "LIMITS KEPT"),
        ("dropouts_percent_max = 0.01", 1, "LIMITS BROKEN"),
        ("losses_in_a_row_max = 0", 1, "LIMITS BROKEN"),
        ("delay_p99_us_max = 100", 1, "LIMITS BROKEN"),
        ("missed_percent_max = 0.01", 1, "LIMITS BROKEN"),
        ("speed_error_peak_percent_max = 1", 0, "NOTHING WAS ASKED"),
    ],
)
def test_a_limit_that_a_log_tells_is_judged(tmp_path: Path, text: str, status: int, outcome: str) -> None:
    done = hil_review(Drawn(5).write(tmp_path / "drawn.log"), bench=limited(tmp_path, text))
    assert (done.exit_code, done.stdout.splitlines()[-1]) == (status, outcome), done.output
    assert ("not told by a log: speed_error_peak_percent_max" in done.stderr) is ("speed" in text)


def test_what_is_no_log_of_drives_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.log"
    for text, words in (
        ("", "found 'no frame', expected a log of candump or SavvyCAN"),
        ("(1.000000) can0 181#00\n", "found 'fewer than two SYNCs (80h)'"),
        ("  can0  080   [0]\n", "found '1 frames without times'"),
    ):
        path.write_text(text)
        done = hil_review(path)
        assert (done.exit_code, words in done.stderr) == (2, True), done.stderr
    for arguments in (["--log", str(path)], ["--bench", str(BENCH)], [], ["r", "--log", "l", "--bench", "b"]):
        assert CliRunner().invoke(app, ["review", *arguments]).exit_code == 2


@pytest.mark.long
def test_a_run_seen_through_its_log_alone(servo_bench: BenchRunner, tmp_path: Path) -> None:
    """Losses, states and speeds are those that the bench has recorded."""
    run = servo_bench(BENCH, {"bench.duration_s": 1.2})
    figures = told(candump(run.folder))
    axis = figures["axes"]["axis1"]
    reading = next(pdo for pdo in axis["pdos"] if pdo["name"] == axis["reading"])
    assert reading["lost"] == run.summary.dropouts.lost > 5
    assert reading["lost_in_a_row"] == run.summary.reading_losses_in_a_row
    assert "operation enabled" in [state["state"] for state in axis["states"]]
    assert all(pdo["mapping_known"] for pdo in axis["pdos"])
    assert figures["verdict"]["findings"] == []
    dropouts, true = figures["dropouts"], run.summary.dropouts
    assert (dropouts["lost"], dropouts["late"], dropouts["missed"]) == (true.lost, true.late, true.missed)
    assert figures["cycles"] == pytest.approx(run.summary.cycles, abs=3), "by what the statusword told when"
    page = tmp_path / "log.html"
    done = hil_review(candump(run.folder), "--report", str(page))
    assert done.exit_code == 0
    text = page.read_text()
    assert "LIMITS KEPT" in text
    assert text.count("<svg") == 2
    assert "Speed error" not in text, "nobody knows the reference of a torque drive"


@pytest.mark.parametrize("name", ["relative.asc", "python-can.blf", "1.3.trc", "savvycan.csv", "plain.mf4"])
def test_each_kind_of_log_gives_the_same_review(name: str, tmp_path: Path) -> None:
    plain = Drawn(7).write(tmp_path / "plain.log")
    foreign: ForeignLog = next(log for log in FOREIGN if log.name == name)
    foreign.write(tmp_path / name, list(BusLog(plain)))
    first, again = (told(path)["axes"]["axis1"]["pdos"] for path in (plain, tmp_path / name))
    for one, other in zip(first, again, strict=True):
        for key in ("p50", "p99", "max"):
            assert other["delay_us"].pop(key) == pytest.approx(one["delay_us"].pop(key), abs=5)
        assert other == one
