"""Benches on drives that take their time: tasks, interpolation, filters, a notch; keys that are refused."""

from typing import Any

import pytest

from servobench import run
from servobench.drivers.errors import BadInput, LimitExceeded
from servobench.hil.configuration.bench_file import Bench
from servobench.hil.configuration.config_files import BadInputs
from servobench.hil.execution.network_guard import Certificates
from servobench.hil.verdict.verdict import LimitResult
from tests.scenario.processes import EXAMPLES

LIKE = "drive.axis1.simulation.like"
DEMO = Bench.load(EXAMPLES / "ling2012.toml")
PID = {"drive.axis1.controller": DEMO.tables["drive"]["axis1"]["controller"]}
TASK = {"rpdo_task_us": 400.0, "tpdo_task_us": 400.0}


def broken(bench: str, like: dict[str, Any]) -> set[str]:
    found = run(EXAMPLES / f"{bench}.toml", {LIKE: like}).verdict
    return {each.metric for each in found.limits if each.result is LimitResult.BROKEN}


def test_csp_shakes_with_a_task_that_runs_free_and_not_with_one_that_is_locked() -> None:
    """60C2h is 1 ms: a tick of 400 us takes the set-points in after 0.8 or 1.2 ms."""
    assert "position_error_peak_rad_max" in broken("position_csp", {"timing": TASK})
    assert broken("position_csp", {"timing": TASK | {"locked_to_sync": True}}) == set()


def test_the_cabinets_controller_bears_a_locked_task_alone() -> None:
    with pytest.raises(LimitExceeded, match="speed"):
        broken("cabinet", {"timing": TASK})
    assert broken("cabinet", {"timing": TASK | {"locked_to_sync": True}}) == set()


def test_a_bench_measures_the_dead_time_of_its_drive() -> None:
    """From deciding until the command acts, by the drive's own read-back."""
    delays = []
    for dead_us in (0.0, 1500.0):
        like = {"timing": {"dead_time_us": dead_us}}
        told = run(DEMO, {LIKE: like, "loop.command_readback": "event"}).summary.action_delay_us
        assert told is not None
        assert told.p50 is not None
        delays.append(told.p50)
    assert delays[1] - delays[0] == pytest.approx(1500.0, abs=100.0)


def test_a_notch_in_the_drive_lets_the_demos_pid_turn_the_cabinets_machine() -> None:
    with pytest.raises(LimitExceeded, match="speed"):
        run(EXAMPLES / "cabinet.toml", PID)
    notch = {"set_point": {"notch": {"frequency_hz": 134.0, "depth": 0.05, "width": 1.0}}}
    assert run(EXAMPLES / "cabinet.toml", PID | {LIKE: notch}).verdict.passed


def test_set_points_are_followed_by_interpolation_and_filter() -> None:
    assert broken("position_csp", {"set_point": {"interpolation": "cubic"}}) == set()
    assert "position_error_rms_rad_max" in broken("position_csp", {"set_point": {"interpolation": "none"}})
    assert "following_error_peak_rad_max" in broken("position_csp", {"set_point": {"filter_hz": 50.0}})


def test_the_example_of_a_task_runs() -> None:
    assert run(DEMO, {LIKE: str(EXAMPLES / "drives/pdo_task.toml")}).verdict.passed


@pytest.mark.parametrize(
    ("like", "key", "expected"),
    [
        ({"timing": {"rpdo_phase_us": 10.0}}, "timing", "rpdo_phase_us below rpdo_task_us"),
        ({"timing": {"tpdo_task_us": 400.0, "tpdo_phase_us": 400.0}}, "timing", "tpdo_phase_us below"),
        ({"brake": {"close_ms": -1.0}}, "brake.close_ms", "a value >= 0"),
        ({"timing": {"rpdo_task_ms": 1.0}}, "timing.rpdo_task_ms", "rpdo_task_us"),
        (
            {"set_point": {"interpolation": "spline"}},
            "set_point.interpolation",
            "'linear', 'cubic' or 'none'",
        ),
        (
            {"set_point": {"notch": {"frequency_hz": 3500.0}}},
            "set_point.notch.frequency_hz",
            "below 3200, two fifths of inner_rate_hz",
        ),
    ],
)
def test_what_no_drives_time_can_be_is_refused_by_its_key(
    like: dict[str, Any], key: str, expected: str
) -> None:
    with pytest.raises((BadInput, BadInputs)) as refused:
        run(DEMO, {LIKE: like, "drive.axis1.simulation.inner_rate_hz": 8_000})
    assert f"{LIKE}.{key}: " in str(refused.value)
    assert expected in str(refused.value)


def test_a_certificate_names_a_torque_that_is_filtered() -> None:
    controller = str(EXAMPLES / "controllers/ling2012-predictor.toml")
    like = {"set_point": {"torque_filter_hz": 300.0, "notch": {"frequency_hz": 134.0}}}
    bench = DEMO.changed({"drive.axis1.controller": controller, LIKE: like})
    told = "filter of 300 Hz, notch at 134 Hz, expected a torque that is made as it is asked for"
    assert Certificates(bench.config).plans()["axis1"].left == (f"{LIKE}.set_point: {told}",)
