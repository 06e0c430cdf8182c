"""Positions through torques by the predictors on drawn motions, loads and networks; by the frames."""

import math
import random
import re
from collections.abc import Sequence
from pathlib import Path
from struct import unpack
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import csv

from servobench.drivers.errors import BadInput
from servobench.hil.configuration.motor_file import LING2012
from servobench.hil.testing.bench_runs import BenchRunner
from servobench.hil.testing.run import Run
from tests.draws import few_of
from tests.recorded_frames import candump_text
from tests.scenario.processes import EXAMPLES

CST, CSP = EXAMPLES / "position_cst.toml", EXAMPLES / "position_csp.toml"
CONTROLLERS = EXAMPLES / "controllers"
COUNT_RAD = math.tau / 65536
LAYOUTS = {"cst": ("<ii", 1), "csp": ("<Hhi", 2), "csv": ("<Hhi", 2)}
"""606Ch and 6064h, or 6041h, 6077h and 6064h."""
SPEED_LOOP_RAD_S = 0.177742 / LING2012.parameters.inertia_kg_m2
"""Of the fused controller's file; the predictor's is faster."""
SYNC_S = 48e-6
"""44 bits and 4 stuff bits at 1 Mbit/s: a log tells of its beginning, and a drive samples at its end."""
TICK_S = 62.5e-6
"""Of the simulated drive."""
ARRIVED_S = 0.3
"""From a step or a load until the shaft is where it is asked to be."""
LOADED_RAD = 0.1
"""0.6 N m more take the shaft to 5 rad/s until the load is known, and K = 70 1/s brings it back: 5 / 70."""
Floats = np.ndarray
Motion = list[dict[str, Any]]


def drawn_motion(seed: int, kinds: Sequence[str] = ("s_curve", "ramp", "sine")) -> Motion:
    """A step, then ways by S-curve and by ramp at most at 450 r/min, and a swing; each begins when the one
    before has ended."""
    draw = random.Random(seed)
    level = draw.uniform(-1.0, 1.0)
    entries: Motion = [{"kind": "step", "at_s": 0.1, "position_rad": level}]
    for number, kind in enumerate(draw.sample(["s_curve", "ramp"], 2)):
        over_s = draw.uniform(0.1, 0.25)
        way_rad = draw.uniform(-25.0, 25.0) * over_s
        if kind in kinds:
            level += way_rad
            at_s = 0.6 + 0.4 * number
            entries.append({"kind": kind, "at_s": at_s, "over_s": over_s, "position_rad": level})
    swing = {"amplitude_rad": draw.uniform(0.1, 0.5), "frequency_hz": draw.uniform(1.0, 4.0)}
    return [*entries, {"kind": "sine", "at_s": 1.4} | swing] if "sine" in kinds else entries


def asked_rad(motion: Motion, time_s: np.ndarray) -> np.ndarray:
    """What a motion asks for, written down once more."""
    level, asked = 0.0, np.zeros_like(time_s)
    for entry in motion:
        since = time_s - entry["at_s"]
        if entry["kind"] == "sine":
            turned = level + entry["amplitude_rad"] * np.sin(math.tau * entry["frequency_hz"] * since)
        else:
            x = np.clip(since / entry.get("over_s", 1e-12), 0.0, 1.0)
            way = x**3 * (10.0 - 15.0 * x + 6.0 * x**2) if entry["kind"] == "s_curve" else x
            turned = level + (entry["position_rad"] - level) * way
            level = entry["position_rad"]
        asked = np.where(since >= 0.0, turned, asked)
    return asked


def jumps(motion: Motion) -> list[tuple[float, float]]:
    """Instants, s, at which a motion asks for another speed at once, and the difference, rad/s."""
    level, found = 0.0, []
    for entry in motion:
        if entry["kind"] == "ramp":
            speed = abs(entry["position_rad"] - level) / entry["over_s"]
            found += [(entry["at_s"], speed), (entry["at_s"] + entry["over_s"], speed)]
        if entry["kind"] == "sine":
            found.append((entry["at_s"], math.tau * entry["frequency_hz"] * entry["amplitude_rad"]))
        level = entry.get("position_rad", level)
    return found


def sampled(run: Run) -> tuple[np.ndarray, np.ndarray]:
    """Instants of SYNCs, s from the first cycle, and 6064h of the TPDOs that answer them, rad."""
    layout, place = LAYOUTS[run.config.drive["axis1"].mode]
    frames: dict[str, list[tuple[float, bytes]]] = {"080": [], "181": []}
    for at, cob_id, data in re.findall(r"\(([\d.]+)\) \S+ (080|181)#(\w*)", candump_text(run.folder)):
        frames[cob_id].append((float(at) - 1e9, bytes.fromhex(data)))
    syncs = np.array([at for at, _ in frames["080"]]) + SYNC_S
    told = [(at, unpack(layout, data)[place] * COUNT_RAD) for at, data in frames["181"] if len(data) == 8]
    at, position = np.array(told).T
    return syncs[np.searchsorted(syncs, at) - 1], position


def errors(run: Run, motion: Motion, from_s: float, until_s: float) -> tuple[Floats, Floats]:
    """Instants within a time, and how far the shaft is then from what is asked for, rad."""
    at, position = sampled(run)
    inside = (at >= from_s) & (at < until_s)
    origin = position[(at > 0.0) & (at < 0.1)].mean()
    return at[inside], np.abs(position - origin - asked_rad(motion, at))[inside]


def allowed_rad(motion: Motion) -> float:
    """A loop of the first order makes good a jump of the speed on v / omega_s of the way."""
    return max(speed for _, speed in jumps(motion)) / SPEED_LOOP_RAD_S + 5e-3


def calm(at: Floats, motion: Motion) -> Floats:
    """Which instants are a tenth of a second or more behind each jump."""
    return np.array([all(not 0.0 <= each - when <= 0.1 for when, _ in jumps(motion)) for each in at])


def changes(bench: Path, motion: Motion, controller: str = "fused") -> dict[str, Any]:
    changed = {"bench.duration_s": 2.0, "reference": {"axis1": motion}, "verdict": {}}
    if bench == CST:
        changed["drive.axis1.controller"] = str(CONTROLLERS / f"ling2012-{controller}.toml")
        changed["drive.axis1.count_with_speed"] = True
    return changed


@pytest.mark.parametrize("seed", few_of(range(4), 2))
def test_the_shaft_keeps_closer_to_its_motion_than_with_the_drives_own_position_loop(
    servo_bench: BenchRunner, seed: int
) -> None:
    motion, rms = drawn_motion(seed), {}
    for bench in (CST, CSP):
        at, error = errors(servo_bench(bench, changes(bench, motion)), motion, 0.6, 2.0)
        rms[bench] = np.sqrt(np.mean(error[calm(at, motion)] ** 2))
        if bench == CST:
            assert error.max() < allowed_rad(motion)
    assert rms[CST] < 0.5 * rms[CSP]


@pytest.mark.parametrize("controller", ["fused", "predictor"])
@pytest.mark.parametrize("seed", few_of(range(3), 1))
def test_losses_delays_and_loads_are_borne(servo_bench: BenchRunner, seed: int, controller: str) -> None:
    draw, motion = random.Random(seed), drawn_motion(seed + 100)
    delay_us = draw.randrange(60, 200)
    network = {
        "delay": [
            {"direction": "drive_to_host", "delay_min_us": 50, "delay_max_us": delay_us},
            {"direction": "host_to_drive", "delay_min_us": 50, "delay_max_us": delay_us},
        ],
        "loss": [{"probability": draw.uniform(0.0, 0.03)}],
    }
    load = {"load": {"axis1": [{"at_s": draw.uniform(0.2, 0.9), "torque_nm": draw.uniform(-0.6, 0.6)}]}}
    run = servo_bench(CST, changes(CST, motion, controller) | load, faults=network, seed=seed)
    assert run.summary.verdict.completed, run.summary.verdict.reason
    _, error = errors(run, motion, 0.1 + ARRIVED_S, 2.0)
    assert error.max() < allowed_rad(motion) + LOADED_RAD
    _, error = errors(run, motion, 1.3, 1.4)
    assert error.max() < 5e-3, "what was asked for is reached, and kept"


def test_a_step_from_afar_is_approached_within_the_limit_of_speed_and_braked_in_time(
    servo_bench: BenchRunner,
) -> None:
    """Ten turns: K alone would ask for several times the speed at which the bench stops the drive."""
    motion = [{"kind": "step", "at_s": 0.1, "position_rad": 20.0 * math.pi}]
    run = servo_bench(CST, changes(CST, motion))
    assert run.summary.verdict.completed, run.summary.verdict.reason
    at, position = sampled(run)
    position = position - position[at < 0.1][-1]
    assert position.max() < 20.0 * math.pi + 0.02, "no overshoot"
    speed = np.diff(position) / np.diff(at)
    assert speed.max() == pytest.approx(0.8 * 1500.0 * math.tau / 60.0, rel=0.05)
    assert errors(run, motion, 1.5, 2.0)[1].max() < 1e-3


def test_what_was_missed_is_caught_up_with_within_the_limit_of_speed(servo_bench: BenchRunner) -> None:
    """A ramp of 1000 r/min begins two turns away from the shaft."""
    rate = 1000.0 * math.tau / 60.0
    motion = [
        {"kind": "step", "at_s": 0.1, "position_rad": 4.0 * math.pi},
        {"kind": "ramp", "at_s": 0.101, "position_rad": 4.0 * math.pi + rate, "over_s": 1.0},
    ]
    run = servo_bench(CST, changes(CST, motion))
    assert run.summary.verdict.completed, run.summary.verdict.reason
    at, position = sampled(run)
    assert (np.diff(position) / np.diff(at)).max() < 0.85 * 1500.0 * math.tau / 60.0
    told = errors(run, motion, 0.9, 1.1)[1]
    assert np.median(told) < 1e-3
    assert told.max() < TICK_S * rate + 1e-3, "a drive tells the count of its last tick"


def test_a_cam_goes_on_from_where_it_has_come_to(servo_bench: BenchRunner, tmp_path: Path) -> None:
    """A turn and back to three quarters, over and over: five cycles leave the shaft 3.75 turns further."""
    time_s = np.linspace(0.0, 0.3, 301)
    turned = math.tau * (1.5 * time_s / 0.3 - 0.25 * (1.0 - np.cos(math.tau * time_s / 0.3)) * 2.0)
    turned *= 0.75 / 1.5
    path = tmp_path / "cam.csv"
    csv.write_csv(pa.table({"time_s": time_s, "position_rad": turned}), path)
    entry = {"kind": "file", "at_s": 0.2, "path": str(path), "repeats": True}
    run = servo_bench(CST, changes(CST, [entry]))
    at, position = sampled(run)
    origin = position[(at > 0.0) & (at < 0.1)].mean()
    cycles, within = np.divmod(at - 0.2, 0.3)
    asked = np.where(at < 0.2, 0.0, cycles * turned[-1] + np.interp(within, time_s, turned))
    assert np.abs(position - origin - asked)[(at > 0.3) & (at < 2.0)].max() < 0.02
    assert [each["text"] for each in run.events if "cam.csv" in each.get("text", "")] == [
        "axis1: reference position of cam.csv, 301 points, over and over"
    ]


@pytest.mark.parametrize(
    ("entry", "said"),
    [
        ({"kind": "s_curve", "at_s": 0.1, "position_rad": 40.0, "over_s": 0.2}, r"found 3580\.\d+, expected"),
        ({"kind": "step", "at_s": 0.1, "torque_nm": 0.1}, "takes speeds or positions"),
    ],
)
def test_a_motion_that_the_axis_cannot_follow_is_refused(
    servo_bench: BenchRunner, entry: dict[str, Any], said: str
) -> None:
    with pytest.raises(BadInput, match=said):
        servo_bench(CST, changes(CST, [entry]))


def test_positions_and_speeds_of_one_axis_are_refused(servo_bench: BenchRunner) -> None:
    motion = [
        {"kind": "step", "at_s": at, key: 1.0} for at, key in ((0.1, "position_rad"), (0.2, "speed_rpm"))
    ]
    with pytest.raises(BadInput, match=r"reference\.axis1\[1\]\.speed_rpm.* here a position"):
        servo_bench(CST, changes(CST, motion))


def test_a_load_that_repeats_is_refused(servo_bench: BenchRunner, tmp_path: Path) -> None:
    (tmp_path / "load.csv").write_text("time_s,torque_nm\n0,0\n1,0.1\n")
    entry = {"kind": "file", "path": str(tmp_path / "load.csv"), "repeats": True}
    with pytest.raises(BadInput, match=r"load\.axis1\[0\]\.repeats: found .*a load from a file comes once"):
        servo_bench(CST, changes(CST, []) | {"load": {"axis1": [entry]}})


def test_a_cycle_without_a_length_is_refused(servo_bench: BenchRunner, tmp_path: Path) -> None:
    (tmp_path / "one.csv").write_text("time_s,position_rad\n0,0\n")
    entry = {"kind": "file", "at_s": 0.1, "path": str(tmp_path / "one.csv"), "repeats": True}
    with pytest.raises(BadInput, match=r"reference\.axis1\[0\]\.repeats.* comes at 0 s"):
        servo_bench(CST, changes(CST, [entry]))


@pytest.mark.parametrize(("quantity", "left"), [("speed_rpm", False), ("position_rad", True)])
def test_a_certificate_of_the_speed_loop_presumes_that_no_loop_is_around_it(
    servo_bench: BenchRunner, quantity: str, left: bool
) -> None:
    ramp = {"kind": "s_curve", "at_s": 0.1, "over_s": 0.2, quantity: 1.0}
    certificate = servo_bench(CST, changes(CST, [ramp])).summary.certificates["axis1"]
    assert any("positions, expected speeds" in each for each in certificate["premises_left"]) is left
