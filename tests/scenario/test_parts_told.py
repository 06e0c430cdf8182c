"""Parts of a simulated drive and its machine that are not as usual: events, lanes and `hil why` tell of them
when the bus shows it."""

import json
import math
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from typer.testing import CliRunner

from servobench import Run, run
from servobench.drivers.cia402.profile import Status
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S
from servobench.hil.cli import app
from servobench.hil.configuration.bench_file import Bench
from servobench.hil.rows.events import QUIET, read_events
from tests.rrd_columns import lane
from tests.scenario.processes import EXAMPLES
from tests.unit.hil.test_observed_objects import told

LIKE = {
    "supply": {
        "voltage_v": 300.0,
        "capacitance_uf": 200.0,
        "chopper": {"resistance_ohm": 40.0, "on_v": 315.0, "off_v": 310.0},
    },
    "protection": {"overload": {"continuous_a_rms": 1.2, "peak_a_rms": 4.0, "peak_time_s": 0.02}},
    "brake": {"open_ms": 40.0, "close_ms": 60.0, "drive_waits": True},
}
OBSERVED = [{"object": "60FE:1", "type": "uint32", "name": "outputs"}, "6079"]


@pytest.fixture(scope="module")
def unviewed_recordings() -> None:
    """None: run.rrd is read."""


class Kept(NamedTuple):
    """A run and its folder."""

    run: Run
    folder: Path

    def states(self, part: str) -> list[tuple[int, str]]:
        events = read_events(self.folder / "events.jsonl")
        return [(each["at_ns"], each["state"]) for each in events if each.get("track") == f"axis1 {part}"]

    def holds(self, part: str, state: str, times_ns: np.ndarray) -> np.ndarray:
        """Whether the part was in that state at each time."""
        changes = self.states(part)
        place = np.searchsorted([at_ns for at_ns, _ in changes], times_ns, side="right") - 1
        return np.array([n >= 0 and changes[n][1] == state for n in place])


def recorded(folder: Path, changes: dict[str, Any]) -> Kept:
    bench = Bench.load(EXAMPLES / "ling2012.toml").changed({"faults": {}, **changes})
    return Kept(run(bench, record=folder), folder)


@pytest.fixture(scope="module")
def limited(tmp_path_factory: pytest.TempPathFactory) -> Kept:
    """A step, more current than the drive gives, and braking onto its resistor."""
    changes = {
        "bench.duration_s": 1.7,
        "drive.axis1.simulation.like": LIKE,
        "drive.axis1.observe": OBSERVED,
        "drive.axis1.motor.switches": {"home_from_rad": 1.0, "home_to_rad": 90.0, "bounce_us": 3000.0},
        "reference.axis1": [
            {"at_s": 0.2, "kind": "step", "speed_rpm": 1500.0},
            {"at_s": 1.2, "kind": "step", "speed_rpm": 0.0},
        ],
        "load.axis1": [],
        "verdict": {"settling_ms": 60, "speed_error_peak_percent_max": 6.0},
    }
    return recorded(tmp_path_factory.mktemp("parts") / "run", changes)


def frames(kept: Kept, code: str) -> tuple[np.ndarray, np.ndarray]:
    """Instants, ns of the run, and contents of the PDO that the bench asked the drive for."""
    stamps_s, values = told(kept.folder, 0x481, code)
    return np.round((stamps_s - 1e9) * NS_PER_S).astype(int), values


def differing(first: np.ndarray, second: np.ndarray) -> int:
    return int(np.count_nonzero(first != second))


def test_a_warning_is_told_when_the_statusword_shows_it(limited: Kept) -> None:
    """By bit 7 of the statusword in the records, cycle by cycle."""
    status = limited.run.column("statusword").astype(int)
    cycles_ns = np.arange(len(status)) * NS_PER_MS
    told_limited = limited.holds("current", "Limited", cycles_ns)
    told_warned = limited.holds("current", "Warned", cycles_ns) | told_limited
    assert 20 < told_limited.sum() < 1000
    assert differing(told_warned, status & Status.WARNING != 0) <= 2 * len(limited.states("current"))


def full_at(amperes: np.ndarray, continuous_a: float, full_a2s: float) -> int:
    """The cycle of 1 ms at which the squares above the continuous one have added up."""
    above = 0.0
    for cycle, a in enumerate(np.nan_to_num(amperes)):
        above = max(0.0, above + (a * a - continuous_a**2) * 1e-3)
        if above >= full_a2s:
            return cycle
    return -1


def test_the_sum_of_squares_says_when_the_current_is_limited(limited: Kept) -> None:
    """Of the torque told in each cycle."""
    motor = limited.run.config.drive["axis1"].motor.parameters
    amperes = limited.run.column("torque_nm") / motor.torque_constant_nm_a / math.sqrt(3.0)
    (at_ns, _), *_ = [each for each in limited.states("current") if each[1] == "Limited"]
    assert at_ns / NS_PER_MS == pytest.approx(full_at(amperes, 1.2, (4.0**2 - 1.2**2) * 0.02), abs=2.5)


def test_the_link_is_told_charged_and_chopped_as_6079h_has_it(limited: Kept) -> None:
    times, values = frames(limited, "<II")
    volts = np.array([each[1] for each in values]) / 1000.0
    quiet = limited.holds("supply", QUIET, np.array(times)) | limited.holds("supply", "", np.array(times))
    chopped = limited.holds("supply", "Braking resistor", np.array(times))
    assert volts.max() > 312.0
    assert chopped.any()
    assert volts[chopped].min() > 308.0
    assert volts[quiet].max() < 1.025 * 300.0


def test_the_brake_is_told_as_60feh_has_it(limited: Kept) -> None:
    times, values = frames(limited, "<II")
    states = [state for _, state in limited.states("brake")]
    assert states == ["Closing", "Holds", "Opening", QUIET, "Closing", "Holds"]
    (closes_ns, _), (holds_ns, _) = limited.states("brake")[-2:]
    assert (holds_ns - closes_ns) / NS_PER_MS == pytest.approx(60.0, abs=1.5)
    is_set = np.array([int(value[0]) & 1 for value in values], bool)
    told_set = limited.holds("brake", "Holds", np.array(times)) | limited.holds(
        "brake", "Closing", np.array(times)
    )
    assert is_set.any()
    assert not is_set.all()
    assert differing(is_set, told_set) <= len(states)


def test_a_switch_that_bounces_is_seen_in_its_lane(limited: Kept) -> None:
    switched = limited.states("switches")
    assert {state for _, state in switched} == {"Home", QUIET}
    assert len(switched) > 4, "more than one change at each edge"
    times, labels = lane(limited.folder / "run.rrd", "axis1 switches")
    assert list(zip(times.tolist(), [label[0] for label in labels], strict=True)) == switched


def test_why_names_the_limit(limited: Kept) -> None:
    ended = CliRunner().invoke(app, ["why", str(limited.folder), "--json"])
    assert limited.run.verdict.outcome == "not passed"
    said = json.dumps(json.loads(ended.stdout))
    assert "I^2 t is full: current limited to 1.2 A rms" in said
    assert "axis1 current: Limited since then" in said or "axis1: I^2 t is full" in said


def test_an_end_stop_is_told_as_often_as_its_counter_counts(tmp_path: Path) -> None:
    changes = {
        "bench.duration_s": 0.8,
        "load.axis1": [],
        "drive.axis1.motor.load": {"end_stops": {"positive_rad": 20.0, "stiffness_nm_rad": 100.0}},
        "drive.axis1.observe": [{"object": "2110:9", "type": "uint32", "name": "hits"}],
        "verdict": {},
    }
    kept = recorded(tmp_path / "run", changes)
    times, values = frames(kept, "<I")
    hits = [each[0] for each in values]
    assert max(hits) >= 1
    first_ns = times[next(place for place, count in enumerate(hits) if count)]
    (at_ns, state), *_ = kept.states("stops")
    assert state == "Hit 1"
    assert at_ns == pytest.approx(first_ns, abs=1.5 * NS_PER_MS)
    texts = [each["text"] for each in read_events(kept.folder / "events.jsonl") if "text" in each]
    assert any("end stop hit at" in text for text in texts)
    assert all(at / NS_PER_S < 0.9 for at, _ in kept.states("stops"))


def test_a_drive_without_such_parts_tells_nothing_of_them(tmp_path: Path) -> None:
    kept = recorded(tmp_path / "run", {"bench.duration_s": 0.3, "load.axis1": []})
    tracks = {each.get("track") for each in read_events(kept.folder / "events.jsonl")}
    assert not tracks & {f"axis1 {part}" for part in ("current", "supply", "brake", "stops", "switches")}


def test_a_warm_power_stage_is_told_while_it_lets_less_current_through(tmp_path: Path) -> None:
    """By its own clock: warm from the step on, until the current has fallen and it has cooled."""
    stage = {
        "rise_k": 60.0, "at_a_rms": 1.0, "time_constant_s": 0.15, "max_c": 100.0, "derate_from_c": 60.0,
    }  # fmt: skip
    kept = recorded(
        tmp_path,
        {
            "bench.duration_s": 1.0,
            "drive.axis1.simulation.like": {"protection": {"stage": stage}},
            "reference.axis1": [{"at_s": 0.2, "kind": "step", "speed_rpm": 1500.0}],
            "load.axis1": [],
            "verdict": {},
        },
    )
    (warm, warm_state), (_, cool_state) = kept.states("current")[-2:]
    assert (warm_state, cool_state) == ("Derated", QUIET)
    events = read_events(tmp_path / "events.jsonl")
    texts = [each.get("text", "") for each in events if each["at_ns"] == warm]
    assert any("power stage at 6" in text and "its largest current falls" in text for text in texts)
