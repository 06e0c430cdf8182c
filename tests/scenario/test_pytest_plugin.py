"""The pytest plugin as an outside project has it: its fixtures, its messages, and that it keeps to itself."""

import os
import re
import runpy
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from textwrap import dedent
from xml.etree import ElementTree

import pytest
import yaml

from servobench import Command, Context, Controller, SetPoint, TorqueSetPoint
from servobench.drivers.cia402.profile import State
from servobench.drivers.errors import DriveInFault
from servobench.hil.pytest_plugin import MakeDrive, StartDrive
from servobench.hil.testing.bench_runs import BenchRunner
from tests.scenario.processes import EXAMPLES, hub_name, observer, quiet_environment, serving
from tests.scenario.test_data_sheet_run import changes, sheet

real_time = pytest.mark.xdist_group("real time")

PROJECT = EXAMPLES / "drive_tests"
TUTORIAL = EXAMPLES.parent / "docs" / "tutorial-pytest.md"
REHEARSED = EXAMPLES.parent / "tests" / "contract" / "conformance" / "rehearsed.eds"
HEAVY = {
    "numpy",
    "can",
    "canopen",
    "pydantic",
    "rerun",
    "servobench.hil.testing",
    "servobench.drivers.cia402.servo",
}
LIMIT_S = 110


def run_pytest(folder: Path, *arguments: str) -> tuple[int, str]:
    """pytest in a project of its own; exit status and output."""
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *arguments],
        cwd=folder,
        env={**quiet_environment(), "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        check=False,
    )
    return done.returncode, done.stdout + done.stderr


def project(folder: Path, text: str) -> Path:
    """A project with one file of tests."""
    (folder / "pytest.ini").write_text("[pytest]\naddopts = --strict-markers\n")
    (folder / "test_it.py").write_text(dedent(text))
    return folder


def test_recordings_are_kept_and_named_in_the_report(tmp_path: Path) -> None:
    copy = shutil.copytree(PROJECT, tmp_path / "project", ignore=shutil.ignore_patterns("__pycache__"))
    keep = ("-k", "wrong_sign", "--servo-record", "kept", "--junitxml", "report.xml")
    for _ in range(2):  # the second run leaves what the first has kept
        status, said = run_pytest(copy, *keep)
        assert status == 0, said
    case = ElementTree.parse(copy / "report.xml").getroot().find(".//testcase")
    assert case is not None
    (told,) = (item.get("value", "") for item in case.iter("property") if item.get("name") == "recording")
    folders = sorted(path for path in (copy / "kept").iterdir())
    assert len(folders) == 2
    assert Path(told) == folders[1] / "run-1"
    assert all((folder / "run-1" / "summary.json").exists() for folder in folders)


def test_the_workflow_is_yaml_and_names_files_that_are_there() -> None:
    text = (PROJECT / "workflow.yml").read_text()
    jobs = yaml.safe_load(text)["jobs"]
    assert set(jobs) == {"simulated", "vcan"}
    commands = [step["run"] for job in jobs.values() for step in job["steps"] if "run" in step]
    assert [word for line in commands for word in line.split() if word.endswith(".py")] == [
        "failed_pictures.py"
    ]
    assert all("--servo-record recordings" in line for line in commands if line.startswith("pytest"))


def test_the_pipeline_of_gitlab_runs_what_the_workflow_does() -> None:
    pipeline = yaml.safe_load((PROJECT / "gitlab-ci.yml").read_text())
    jobs = {name: job for name, job in pipeline.items() if name != "default"}
    steps = yaml.safe_load((PROJECT / "workflow.yml").read_text())["jobs"]
    for name, job in jobs.items():
        [command] = job["script"]
        assert command in [step.get("run") for step in steps[name]["steps"]]
        assert {"report.xml", "recordings"} <= set(job["artifacts"]["paths"])
    assert set(jobs) == set(steps)
    assert pipeline["default"]["before_script"] == ["pip install -e ."]


def test_only_failed_runs_are_drawn(tmp_path: Path) -> None:
    report = tmp_path / "report.xml"
    report.write_text(
        "<testsuites><testsuite>"
        "<testcase><properties><property name='recording' value='good/run-1'/></properties></testcase>"
        "<testcase><properties><property name='recording' value='bad/run-1'/></properties>"
        "<failure/></testcase>"
        "</testsuite></testsuites>"
    )
    drawn = runpy.run_path(str(PROJECT / "failed_pictures.py"))["failed_recordings"](report)
    assert drawn == [Path("bad/run-1")]


@real_time
def test_its_tests_pass_on_another_bus_by_an_option(tmp_path: Path) -> None:
    shutil.copytree(PROJECT, tmp_path / "project", ignore=shutil.ignore_patterns("__pycache__"))
    status, said = run_pytest(tmp_path / "project", "-q", "--servo-bus", "hub", "-k", "torque_turns")
    assert status == 0, said
    assert "1 passed" in said


def test_the_tutorial_shows_the_example_project() -> None:
    blocks = re.findall(r"```python\n(.*?)```", TUTORIAL.read_text(encoding="utf-8"), re.DOTALL)
    files = "\n".join(path.read_text(encoding="utf-8") for path in sorted(PROJECT.rglob("*.py")))
    assert len(blocks) > 5
    assert [block for block in blocks if block not in files] == []


def test_a_run_that_uses_no_fixture_loads_nothing(tmp_path: Path) -> None:
    text = f"""
        import sys

        def test_nothing_is_loaded():
            assert not {HEAVY!r} & set(sys.modules)
    """
    status, said = run_pytest(project(tmp_path, text), "-q", "-p", "no:hypothesispytest")
    assert status == 0, said


def test_a_claim_that_is_not_true_fails_with_figures_and_without_our_insides(tmp_path: Path) -> None:
    text = f"""
        def test_too_fast(servo_bench):
            run = servo_bench({str(EXAMPLES / "any_bus.toml")!r})
            run.assert_settles(within_s=0.05, band_percent=1, after_s=1.5)

        def test_state(servo_drive):
            from servobench.drivers.cia402.profile import State
            rig = servo_drive()
            rig.configure()
            rig.assert_reaches(State.OPERATION_ENABLED, within_s=0.1)
    """
    status, said = run_pytest(project(tmp_path, text), "-q")
    assert status == 1
    assert "axis1: 0.05 s after the load of 0.2 N m at 1.500 s the speed is still up to" in said
    assert "not in 'operation enabled' after 0.1 s; it was in 'switch on disabled'" in said
    assert "hil/testing" not in said, "only the test's own lines are shown"


@real_time
def test_a_drive_process_that_fails_by_itself_fails_the_test(tmp_path: Path) -> None:
    text = """
        import os
        import signal
        import pytest

        pytestmark = pytest.mark.servo_bus("hub")

        def test_killed(servo_process):
            process = servo_process(1)
            os.kill(process.pid, signal.SIGKILL)

        def test_never_up(servo_process):
            servo_process(1, motor="no/such/motor.toml")
    """
    status, said = run_pytest(project(tmp_path, text), "-q")
    assert status == 1
    assert "a simulated drive on hub:" in said
    assert "it ended with status -9" in said
    assert (
        "the simulated drive did not come up; hil: error: --motor: Motor file not found: no/such/motor.toml"
        in said
    )


def test_what_was_typed_wrongly_is_told(tmp_path: Path) -> None:
    text = f"""
        def test_it(servo_drive):
            servo_drive()

        def test_process(servo_process):
            servo_process(1)

        def test_key(servo_bench):
            servo_bench({str(EXAMPLES / "any_bus.toml")!r}, {{"loop.period_ms": 10}})
    """
    folder = project(tmp_path, text)
    status, said = run_pytest(folder, "-q", "--servo-bus", "simulatd", "-k", "test_it")
    assert status == 1
    assert "did you mean 'simulated'?" in said
    _, said = run_pytest(folder, "-q")
    assert "servo_process needs a bus in real time: mark the test with servo_bus('hub')" in said
    assert "loop.period_ms: found 10, expected period_us (the unit is part of the key)" in said


def test_a_bus_that_is_not_there_skips_by_marker_and_fails_by_option(tmp_path: Path) -> None:
    text = """
        import pytest

        @pytest.mark.servo_bus("simulated", "socketcan:none9")
        def test_both(servo_bus):
            assert servo_bus == "simulated"

        def test_asked(servo_bus):
            pass
    """
    folder = project(tmp_path, text)
    status, said = run_pytest(folder, "-q", "-rs")
    assert status == 0
    assert "2 passed, 1 skipped" in said
    assert "none9 is not up; ip link set none9 up type can" in said
    status, said = run_pytest(folder, "-q", "--servo-bus", "socketcan:none9", "-k", "asked")
    assert status == 1
    assert "none9 is not up; ip link set none9 up type can" in said


@real_time
@pytest.mark.servo_bus("simulated", "hub")
def test_a_drive_is_made_from_a_data_sheet(servo_bus: str, servo_drive: MakeDrive) -> None:
    rig = servo_drive(node=5, eds=REHEARSED)
    identity = rig.client.connect(rig.deadline(5.0))
    assert (identity.vendor, identity.product, identity.serial) == (0x123, 0x456, 42)
    assert (rig.device is not None) == (servo_bus == "simulated") == (rig.process is None)


def test_loss_on_the_wire_is_not_seen_by_the_host_but_what_it_sent_is(servo_drive: MakeDrive) -> None:
    loss = {"loss": [{"probability": 1.0, "direction": "drive_to_host", "from_s": 1.0}]}
    rig = servo_drive(faults=loss, seed=3)
    rig.enable()
    rig.wait(1.0)
    rig.wire.clear()
    assert rig.run(0.05) == []
    rig.wire.assert_none("181#*")
    rig.wire.assert_seen("080#", times=50)


def test_a_state_that_is_left_is_told(servo_drive: MakeDrive) -> None:
    rig = servo_drive(faults={"drive_fault": [{"fault": "over_temperature", "at_s": 1.0}]})
    rig.enable()
    told = r"'fault( reaction active)?' after 0\.\d+ s, to stay in 'operation enabled' for 1.5 s; EMCY: 4310h"
    with pytest.raises(AssertionError, match=told):
        rig.assert_stays(State.OPERATION_ENABLED, for_s=1.5)
    with pytest.raises(AssertionError, match=r"unintended.*\n.*received 081#1043"):
        rig.assert_no_unintended_frame()
    rig.assert_no_unintended_frame(allow=("081#*",))


def test_a_run_that_does_not_end_as_told_fails(servo_bench: BenchRunner) -> None:
    short = {"bench.duration_s": 0.2, "reference": {}, "load": {}, "verdict": {}}
    with pytest.raises(AssertionError, match="ended without an error, DriveInFault expected"):
        servo_bench(EXAMPLES / "any_bus.toml", short, ends_in=DriveInFault)
    with pytest.raises(AssertionError, match=r"has no limit in \[verdict\] to keep"):
        servo_bench(EXAMPLES / "any_bus.toml", short).assert_passed()


def test_the_pdos_of_a_data_sheet_s_plan_are_intended(servo_bench: BenchRunner, tmp_path: Path) -> None:
    run = servo_bench(EXAMPLES / "ling2012.toml", changes(sheet(tmp_path)))
    run.wire.assert_seen("181#*")
    run.assert_no_unintended_frame()


class Watching(Controller):
    """A controller that asks for no torque, and notes under which conditions it runs."""

    def __init__(self) -> None:
        self.policies: set[int] = set()
        self.locked: set[str] = set()

    def output(self, _context: Context) -> SetPoint:
        return TorqueSetPoint(0.0)

    def update(self, _context: Context, _command: Command) -> None:
        self.policies.add(os.sched_getscheduler(0))
        lines = Path("/proc/self/status").read_text().splitlines()
        self.locked |= {line.split()[1] for line in lines if line.startswith("VmLck")}


@real_time
@pytest.mark.servo_bus("hub")
def test_a_bench_in_real_time_asks_nothing_of_the_kernel_for_the_test_process(
    servo_bench: BenchRunner,
) -> None:
    watching = Watching()
    still = {"bench.duration_s": 0.5, "reference": {}, "load": {}, "verdict": {}}
    run = servo_bench(EXAMPLES / "any_bus.toml", still, controllers={"axis1": watching})
    assert run.summary.verdict.completed
    assert watching.policies == {os.SCHED_OTHER}
    assert watching.locked == {"0"}
    syncs = run.wire.between(0.0, 0.5).find("080#", sent=True)
    with_sync = run.summary.cycles - run.summary.dropouts.missed
    assert abs(len(syncs) - with_sync) <= 1, "the log's wall clock is brought back to the time of the run"


class Impatient(Watching):
    """Its user presses Ctrl-C."""

    def update(self, _context: Context, _command: Command) -> None:
        os.kill(os.getpid(), signal.SIGINT)


def test_ctrl_c_during_a_bench_ends_pytest_and_not_only_the_bench(servo_bench: BenchRunner) -> None:
    with pytest.raises(KeyboardInterrupt):
        servo_bench(EXAMPLES / "any_bus.toml", controllers={"axis1": Impatient()})


@real_time
@pytest.mark.servo_bus("hub")
def test_drives_of_a_foreign_master_are_processes_and_end_with_the_test(
    servo_bus: str, servo_process: StartDrive
) -> None:
    process = servo_process(1, 2, seed=5)
    with observer(servo_bus) as watching:
        assert watching.state() is State.SWITCH_ON_DISABLED
    assert "node 1, 2" in process.said
    assert process.stop() == 0


@real_time
def test_drives_that_are_there_are_used_by_an_option(tmp_path: Path) -> None:
    text = """
        import pytest

        def test_of_the_drive(servo_drive):
            rig = servo_drive(node=3)
            rig.enable()
            assert rig.process is None

        def test_of_a_faulty_drive(servo_drive):
            servo_drive(node=3, faults={"drive_fault": [{"fault": "over_temperature", "at_s": 0.6}]})

        def test_of_a_process(servo_process):
            servo_process(3)

        @pytest.mark.servo_bus("hub")
        def test_on_a_bus_of_its_own(servo_drive):
            servo_drive(node=3)
    """
    bus = hub_name("present")
    folder = project(tmp_path, text)
    present = ("--servo-bus", bus, "--servo-drives", "present", "-q")
    with serving(["simulate", "--bus", bus, "--node", "3"]):
        status, said = run_pytest(folder, *present)
        assert status == 0, said
        assert "1 passed, 3 skipped" in said
        status, said = run_pytest(folder, "--servo-bus", bus, "-q", "-k", "test_of_the_drive")
        assert status == 1
        assert "node 3 is there: " in said
    status, said = run_pytest(folder, "--servo-drives", "present", "-q", "-k", "test_of_the_drive")
    assert status == 1
    assert "needs --servo-bus" in said
