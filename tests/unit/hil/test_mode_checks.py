"""What a mode, a controller, a reference and a limit have to do with each other."""

import tomllib
from pathlib import Path
from typing import Any

import pytest

from servobench.drivers.errors import BadInput
from servobench.hil.configuration.bench_file import bench_from
from servobench.hil.configuration.config_files import bad_inputs_of
from servobench.hil.configuration.references import peak_rate
from servobench.hil.loop.scenario import Quantity

EXAMPLES = Path(__file__).parents[3] / "examples"


def tables(name: str) -> dict[str, Any]:
    return tomllib.loads((EXAMPLES / name).read_text())


def fault_of(raw: dict[str, Any]) -> BadInput:
    with pytest.raises(Exception, match=r".") as caught:
        bench_from(raw, "bench.toml", EXAMPLES)
    (found,) = bad_inputs_of(caught.value)  # type: ignore[arg-type]
    assert found.source == "bench.toml"
    return found


PID = {"kind": "pid", "proportional_nm_s_rad": 0.1}
STEP = {"kind": "step", "at_s": 0.1}


@pytest.mark.parametrize(
    ("name", "table", "changes", "key", "expected"),
    [
        (
            "position_csv.toml",
            "drive",
            {"controller": PID},
            "controller.kind",
            "one of position, stream, python",
        ),
        ("position_csp.toml", "drive", {"controller": PID}, "controller.kind", "one of stream, python"),
        ("position_csp.toml", "drive", {"mode": "cst"}, "limits.set_speed_max_rpm", "absent with mode"),
        ("any_bus.toml", "drive", {"mode": "csv"}, "controller.kind", "the drive is given speeds"),
    ],
)
def test_what_does_not_go_with_the_mode(
    name: str, table: str, changes: dict[str, Any], key: str, expected: str
) -> None:
    raw = tables(name)
    raw[table]["axis1"] |= changes
    raw.pop("reference"), raw.pop("load", None), raw.pop("verdict", None)
    with pytest.raises(Exception, match=r".") as caught:
        bench_from(raw, "bench.toml", EXAMPLES)
    found = {each.key: each for each in bad_inputs_of(caught.value)}  # type: ignore[arg-type]
    assert expected in found[f"drive.axis1.{key}"].expected


@pytest.mark.parametrize(
    ("name", "entry", "key", "expected"),
    [
        ("position_csp.toml", STEP | {"speed_rpm": 9.0}, "[0].speed_rpm", "a position: a stream controller"),
        (
            "position_csv.toml",
            STEP | {"torque_nm": 0.1},
            "[0].torque_nm",
            "a position: a position controller",
        ),
        ("any_bus.toml", STEP | {"position_rad": 1.0}, "[0].position_rad", "a speed: a pid controller"),
        (
            "any_bus.toml",
            STEP,
            "[0].speed_rpm",
            "the speed to go to, r/min; or one of position_rad, torque_nm",
        ),
        (
            "position_csp.toml",
            STEP | {"position_rad": 1.0, "speed_rpm": 1.0},
            "[0].position_rad",
            "absent beside speed_rpm",
        ),
        (
            "position_csp.toml",
            {"kind": "ramp", "at_s": 0.1, "position_rad": 100.0, "over_s": 0.1},
            "",
            "at most drive.axis1.limits.set_speed_max_rpm = 600",
        ),
    ],
)
def test_a_reference_that_the_axis_cannot_take(
    name: str, entry: dict[str, Any], key: str, expected: str
) -> None:
    raw = tables(name)
    raw["reference"]["axis1"] = [entry]
    raw.pop("verdict", None), raw.pop("load", None)
    found = fault_of(raw)
    assert found.key == f"reference.axis1{key}"
    assert expected in found.expected


@pytest.mark.parametrize(
    ("name", "key"),
    [
        ("position_csp.toml", "speed_error_peak_percent_max"),
        ("position_csp.toml", "torque_rms_nm_max"),
        ("position_csv.toml", "following_error_peak_rad_max"),
        ("any_bus.toml", "position_error_rms_rad_max"),
    ],
)
def test_a_limit_that_nothing_in_the_bench_could_keep(name: str, key: str) -> None:
    raw = tables(name)
    raw["verdict"] = {key: 0.5}
    found = fault_of(raw)
    assert found.key == f"verdict.{key}"
    assert "there is none" in found.expected


def test_torques_and_speeds_stream_as_well_as_positions() -> None:
    for mode, key in (("cst", "torque_nm"), ("csv", "speed_rpm"), ("csp", "position_rad")):
        raw = tables("position_csp.toml")
        raw["drive"]["axis1"] |= {"mode": mode}
        raw["drive"]["axis1"]["limits"] = {"speed_max_rpm": 1500.0, "torque_max_nm": 5.0}
        raw["reference"]["axis1"] = [STEP | {key: 0.5}]
        raw["verdict"] = {}
        config = bench_from(raw, "bench.toml", EXAMPLES)
        assert config.reference["axis1"][0].quantity is not None
    raw["reference"]["axis1"] = [STEP | {"position_rad": 1.0}, {**STEP, "at_s": 0.2, "position_rad": 4.0}]
    entries = bench_from(raw, "bench.toml", EXAMPLES).reference["axis1"]
    assert (entries[0].quantity, peak_rate(entries)) == (Quantity.POSITION, 0.0)
