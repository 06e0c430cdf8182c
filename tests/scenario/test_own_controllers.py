"""Controllers and compensators of one's own in a bench: found, run, recorded, and stopped when they fail.

The code imports ``hil`` alone, as that of a user does.
"""

import json
import re
import threading
import tomllib
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from servobench.drivers.errors import BadInput
from servobench.hil.cli import app
from servobench.hil.configuration.bench_file import load_bench, shipped_kinds
from servobench.hil.control.own_code import OwnCodeFailed
from servobench.hil.loop.protocol import WrongSetPoint
from servobench.hil.rows.records_file import read_metadata
from servobench.hil.rows.run_files import RECORDS_FILE
from servobench.hil.testing.bench_runs import BenchRunner
from tests.draws import few_of
from tests.scenario.processes import EXAMPLES

BENCH = EXAMPLES / "any_bus.toml"
SHORT = {
    "bench.duration_s": 0.4,
    "reference": {"axis1": [{"kind": "step", "at_s": 0.05, "speed_rpm": 300.0}]},
}
SHORT |= {"load": {}, "verdict": {}}
CODE = '''
"""A PI controller that fails in a way of its choice."""
import builtins, time
from servobench import Context, Controller, SetPoint, SpeedSetPoint, TorqueSetPoint

class Pi(Controller):
    def __init__(self, setup, gain=0.05, integral=0.5, fails=""):
        self.gain, self.step, self.fails = gain, integral * setup.period_s, fails
        self.reset()

    def reset(self):
        self.sum_nm = 0.0
        self.seen = []

    def channels(self):
        return "integral_nm", "cycles_ahead", "dropouts"

    def output(self, context: Context) -> SetPoint:
        self.error = context.reference_rad_s - context.estimate.velocity_rad_s
        if context.sequence >= 20 and self.fails:  # a late host leaves cycles out
            return self.fail(context)
        return TorqueSetPoint(self.gain * self.error + self.sum_nm)

    def fail(self, context):
        if self.fails == "raise":
            raise RuntimeError("no solution")  # the line
        if self.fails in ("SystemExit", "GeneratorExit", "KeyboardInterrupt"):
            raise vars(builtins)[self.fails]
        if self.fails == "hang":
            time.sleep(60.0)
        if self.fails == "spin":
            while True:
                pass
        return {
            "nan": TorqueSetPoint(float("nan")), "none": None, "float": 0.0, "speed": SpeedSetPoint(1.0)
        }[self.fails]

    def update(self, context, command):
        self.sum_nm += self.step * self.error
        self.ahead = (context.acts_at - context.now) / context.period
        self.dropouts = context.dropouts

    def telemetry(self):
        return self.sum_nm, self.ahead, self.dropouts
'''


@pytest.fixture
def code(tmp_path: Path) -> Path:
    path = tmp_path / "mine.py"
    path.write_text(CODE)
    return path


def with_code(code: Path, **parameters: Any) -> dict[str, Any]:
    controller = {"kind": "python", "object": f"{code}:Pi", "parameters": parameters}
    return {**SHORT, "drive.axis1.controller": controller}


def test_it_runs_and_what_it_tells_is_recorded(servo_bench: BenchRunner, code: Path) -> None:
    run = servo_bench(BENCH, with_code(code, gain=0.06))
    assert run.summary.verdict.completed
    axis = run.axis()
    assert abs(axis.error_rad_s[-1]) < 3.0
    integral = axis.channel("integral_nm")
    steps = 0.5 * 0.01 * axis.error_rad_s
    assert np.diff(integral)[20:] == pytest.approx(steps[21:])
    assert (axis.channel("dropouts") >= 0).all()
    assert 0.0 < axis.channel("cycles_ahead").min() < 2.0
    assert run.summary.compute_us.p50 is not None
    assert run.summary.compute_us.max == pytest.approx(float(axis.compute_us.max()))
    with pytest.raises(ValueError, match="channel 'speed': axis1 has integral_nm, cycles_ahead, dropouts"):
        axis.channel("speed")


def test_the_recording_keeps_the_source_and_its_digest_and_runs_again(
    servo_bench: BenchRunner, code: Path
) -> None:
    run = servo_bench(BENCH, with_code(code))
    kept = run.folder / "axis1-controller.py"
    assert kept.read_bytes() == code.read_bytes()
    told = json.loads(read_metadata(run.folder / RECORDS_FILE)["own_code"])["axis1.controller"]
    assert told["object"] == f"{code}:Pi"
    code.write_text("raise SystemExit")
    again = servo_bench(run.folder / "bench.toml")
    assert again.digest == run.digest
    same = json.loads(read_metadata(again.folder / RECORDS_FILE)["own_code"])["axis1.controller"]
    assert same["blake2b"] == told["blake2b"]


@pytest.mark.parametrize(
    ("fails", "told"),
    few_of(
        [
            ("raise", r"Pi failed: mine\.py:26 in fail: RuntimeError: no solution"),
            ("KeyboardInterrupt", r"Pi failed: mine\.py:28 in fail: KeyboardInterrupt"),
            (
                "nan",
                r"mine\.py:18 in output returned TorqueSetPoint\(torque_nm=nan\), expected a number",
            ),
            ("none", r"mine\.py:18 in output returned None, expected a TorqueSetPoint"),
            ("speed", r"output is SpeedSetPoint\(speed_rad_s=1\.0\), this axis takes a TorqueSetPoint"),
            ("SystemExit", r"Pi failed: mine\.py:28 in fail: SystemExit"),
            ("GeneratorExit", r"Pi failed: mine\.py:28 in fail: GeneratorExit"),
            ("float", r"mine\.py:18 in output returned 0\.0, expected a TorqueSetPoint"),
        ],
        5,
    ),
)
def test_what_fails_in_it_ends_the_run_and_is_named(
    servo_bench: BenchRunner, code: Path, fails: str, told: str
) -> None:
    ending = WrongSetPoint if fails == "speed" else OwnCodeFailed
    run = servo_bench(BENCH, with_code(code, fails=fails), ends_in=ending)
    verdict = run.summary.verdict
    assert verdict.exit_status == 3
    assert run.summary.cycles == 20
    assert re.search(told, verdict.reason)
    assert all(drive.at_rest for drive in run.summary.drives)


@pytest.mark.xdist_group("real time")
@pytest.mark.servo_bus("hub")
@pytest.mark.parametrize("fails", few_of(["spin", "hang"], 1))
def test_a_call_that_does_not_come_back_is_interrupted(
    servo_bench: BenchRunner, code: Path, fails: str
) -> None:
    run = servo_bench(BENCH, with_code(code, fails=fails), ends_in=OwnCodeFailed)
    assert "did not come back within 0.5 s: mine.py:" in run.summary.verdict.reason
    assert all(drive.at_rest for drive in run.summary.drives)


@pytest.mark.xdist_group("real time")
@pytest.mark.servo_bus("hub")
def test_it_runs_the_same_in_real_time_and_its_time_is_judged(servo_bench: BenchRunner, code: Path) -> None:
    limit = {"verdict": {"compute_us_max": 1e6}}
    run = servo_bench(BENCH, with_code(code) | limit)
    (check,) = run.summary.verdict.limits
    assert check.metric == "compute_us_max"
    assert check.value == run.summary.compute_us.max


def test_its_time_is_not_judged_in_simulated_time(servo_bench: BenchRunner, code: Path) -> None:
    run = servo_bench(BENCH, with_code(code) | {"verdict": {"compute_us_max": 0.001}})
    assert run.summary.verdict.limits == ()


def test_loading_a_bench_runs_nothing_of_it(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("raise SystemExit('it ran')")
    text = BENCH.read_text().replace('"motors/', f'"{EXAMPLES}/motors/')
    head, _, rest = text.partition("[drive.axis1.controller]")
    tail = rest[rest.index("\n[") :]
    (tmp_path / "bench.toml").write_text(
        f'{head}[drive.axis1.controller]\nkind = "python"\nobject = "mine.py:Pi"\n{tail}'
    )
    config = load_bench(tmp_path / "bench.toml")
    assert config.drive["axis1"].controller.kind == "python"
    result = CliRunner().invoke(app, ["run", str(tmp_path / "bench.toml"), "--no-record"])
    assert result.exit_code == 2
    assert "SystemExit: it ran" in result.output


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"object": "no_such_module:Pi"}, "there is no module no_such_module"),
        ({"object": "no_such_file.py:Pi"}, "there is no file"),
        ({"object": "json:Pi"}, "; json has none"),
        ({"object": "json:JSONDecoder"}, r"a class derived from servobench\.Controller"),
        ({"parameters": {"gane": 1.0}}, "parameters.gane: found 1.0, expected gain"),
        ({"object": "nothing"}, "MODULE:NAME"),
    ],
)
def test_what_cannot_be_had_is_told_before_anything_moves(
    servo_bench: BenchRunner, code: Path, changes: dict[str, Any], expected: str
) -> None:
    wanted = with_code(code)
    wanted["drive.axis1.controller"] |= changes
    with pytest.raises(BadInput, match=expected):
        servo_bench(BENCH, wanted)


def test_the_command_line_puts_one_in_place_of_the_bench_s(code: Path) -> None:
    command = ["run", str(EXAMPLES / "ling2012.toml"), "--no-record", "--json", "--controller"]
    result = CliRunner().invoke(app, [*command, f"axis1={code}:Pi"])
    assert json.loads(result.stdout)["cycles"] == 2000
    for text in ("axis1", f"axsi1={code}:Pi", "axis1=nothing"):
        refused = CliRunner().invoke(app, [*command, text])
        assert refused.exit_code == 2, text
        assert "--controller" in json.loads(refused.stdout)["verdict"]["reason"]


def test_a_package_brings_a_kind_by_its_entry_point(
    servo_bench: BenchRunner, code: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(code.parent))
    point = EntryPoint("their_pi", "mine:Pi", "servobench.controllers")
    monkeypatch.setattr(
        "servobench.hil.configuration.bench_file.entry_points",
        lambda group: EntryPoints([point]).select(group=group),
    )
    monkeypatch.setattr("servobench.hil.configuration.bench_file.shipped_kinds", shipped_kinds.__wrapped__)
    controller = {"kind": "their_pi", "parameters": {"gain": 0.06}}
    run = servo_bench(BENCH, {**SHORT, "drive.axis1.controller": controller})
    assert run.summary.verdict.completed
    assert run.axis().channel("integral_nm").any()


def test_the_class_and_the_table_of_the_docs_run_as_printed(servo_bench: BenchRunner, tmp_path: Path) -> None:
    text = (EXAMPLES.parent / "docs" / "own-controller.md").read_text(encoding="utf-8")
    source, table = re.findall(r"```(?:python|toml)\n(.*?)```", text, re.DOTALL)[:2]
    (tmp_path / "proportional.py").write_text(source)
    section = tomllib.loads(table)["drive"]["axis1"]["controller"]
    section["object"] = f"{tmp_path}/{section['object']}"
    run = servo_bench(BENCH, {**SHORT, "drive.axis1.controller": section})
    assert run.summary.verdict.completed
    assert run.axis().torque_nm.max() == pytest.approx(0.03 * 300.0 * np.pi / 30.0, rel=0.01)


OBSERVER = """
from servobench import Compensator, Controller, StateEstimate, TorqueSetPoint

class Held(Compensator):
    def __init__(self, setup=None):
        self.commands = []
        self.last = None

    def receive(self, sample):
        self.last = sample

    def sent(self, command):
        self.commands.append(command.torque_nm)

    def estimate(self, context):
        if self.last is None:
            return StateEstimate(0.0, 0.0, 0.0, context.now, 0)
        reading = self.last.reading
        age = (context.acts_at - self.last.sampled_at) * 1e-9
        return StateEstimate(
            reading.position_rad, reading.velocity_rad_s, age, context.acts_at, self.last.sequence
        )

class Own(Controller):
    def __init__(self, setup):
        self.held = Held()

    def observer(self):
        return self.held

    def channels(self):
        return ("sent",)

    def output(self, context):
        return TorqueSetPoint(0.05 * (context.reference_rad_s - context.estimate.velocity_rad_s))

    def telemetry(self):
        return (len(self.held.commands),)
"""


def test_a_compensator_of_one_s_own_alone_and_within_a_controller(
    servo_bench: BenchRunner, tmp_path: Path
) -> None:
    path = tmp_path / "observing.py"
    path.write_text(OBSERVER)
    alone = {**SHORT, "drive.axis1.compensator": {"kind": "python", "object": f"{path}:Held"}}
    ages = servo_bench(BENCH, alone).rows["estimate_torque_nm"][5:]
    assert (ages > 0.0).all()
    assert (ages < 0.03).all()
    within = {**SHORT, "drive.axis1.controller": {"kind": "python", "object": f"{path}:Own"}}
    run = servo_bench(BENCH, within)
    told = run.axis().channel("sent")
    assert told[:5].tolist() == [1.0, 2.0, 3.0, 4.0, 5.0]
    with pytest.raises(BadInput, match=r"drive\.axis1\.compensator: found 'python', expected none"):
        servo_bench(BENCH, within | alone)


def test_in_another_thread_it_runs_too(servo_bench: BenchRunner, code: Path) -> None:
    digests = []
    thread = threading.Thread(target=lambda: digests.append(servo_bench(BENCH, with_code(code)).digest))
    thread.start()
    thread.join()
    assert digests == [servo_bench(BENCH, with_code(code)).digest]
