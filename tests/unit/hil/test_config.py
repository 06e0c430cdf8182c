"""Bench files: the examples load, a resolved one loads equal, and every fault is named."""

import re
import tomllib
from pathlib import Path
from typing import Any, get_args

import pytest

from servobench.drivers.errors import MISSING, BadInput
from servobench.drivers.wire.slcan_protocol import BITRATE_CODES
from servobench.hil.configuration.bench_file import bench_from, load_bench, load_faults
from servobench.hil.configuration.config import BenchConfig, BitRate
from servobench.hil.configuration.config_files import BadInputs, bad_inputs_of
from servobench.hil.configuration.controller_kinds import PidController
from servobench.hil.configuration.motor_file import LING2012
from servobench.hil.configuration.references import peak_level
from servobench.hil.terminal.commands import error_text

ROOT = Path(__file__).parents[3]
EXAMPLES = ROOT / "examples"
BENCH = EXAMPLES / "ling2012.toml"
SOURCE = "bench.toml"


def tables() -> dict[str, Any]:
    return tomllib.loads(BENCH.read_text())


def edited(*path: str | int, value: Any) -> dict[str, Any]:
    """The example's tables with one value put in, or taken out if it is MISSING."""
    raw = tables()
    node: Any = raw
    for step in path[:-1]:
        node = node[step]
    if value is MISSING:
        del node[path[-1]]
    else:
        node[path[-1]] = value
    return raw


def load(raw: dict[str, Any]) -> BenchConfig:
    return bench_from(raw, SOURCE, EXAMPLES)


def errors_of(raw: dict[str, Any]) -> list[BadInput]:
    with pytest.raises((BadInput, BadInputs)) as caught:
        load(raw)
    return bad_inputs_of(caught.value)


def only_error_of(raw: dict[str, Any]) -> BadInput:
    errors = errors_of(raw)
    assert len(errors) == 1, [str(error) for error in errors]
    return errors[0]


def test_a_bus_that_is_too_narrow_names_the_seldom_position() -> None:
    raw = tomllib.loads((EXAMPLES / "three_axes.toml").read_text())
    raw["loop"] |= {"period_us": 900, "decide_after_us": 600}
    load(raw)
    del raw["loop"]["position_every_cycles"]
    error = only_error_of(raw)
    assert error.key == "loop.period_us"
    assert "set loop.position_every_cycles = 10" in error.remedy


def test_a_drives_heartbeat_must_fit_its_time_out() -> None:
    error = only_error_of(edited("drive", "axis1", "heartbeat_timeout_ms", value=50))
    assert error.key == "drive.axis1.heartbeat_timeout_ms"
    assert error.expected == "more than drive.axis1.heartbeat_ms = 50"


@pytest.mark.parametrize("name", sorted(path.name for path in EXAMPLES.glob("*.toml")))
def test_every_example_loads(name: str) -> None:
    config = load_bench(EXAMPLES / name)
    assert config.source == str(EXAMPLES / name)
    assert config.axes


def test_ling2012_example() -> None:
    config = load_bench(BENCH)
    drive = config.drive["axis1"]
    assert config.axes == ("axis1",)
    assert drive.motor == LING2012
    assert isinstance(drive.controller, PidController)
    assert (config.loop.period, config.loop.deadline, config.loop.horizon) == (
        1_000_000,
        2_000_000,
        20_000_000,
    )
    assert config.host.heartbeat_ms == 50
    assert config.faults is not None
    assert peak_level(config.reference["axis1"]) == 1500.0


def test_every_fault_example_loads() -> None:
    found = sorted((EXAMPLES / "faults").glob("*.toml"))
    assert found
    for path in found:
        load_faults(path)


def test_resolved_text_is_the_same_bench_in_one_file() -> None:
    config = load_bench(BENCH)
    raw = tomllib.loads(config.resolved_text())
    again = bench_from(raw, str(BENCH), Path("/nonexistent"))
    assert again.model_dump() == config.model_dump()
    assert raw["drive"]["axis1"]["motor"]["motor"]["pole_pairs"] == 4
    assert raw["drive"]["axis1"]["controller"]["derivative_filter_s"] == 0.002


def test_resolved_text_holds_what_the_command_line_changed() -> None:
    raw = tomllib.loads(load_bench(BENCH).as_run("hub:a", 7).resolved_text())
    assert (raw["bus"]["spec"], raw["bench"]["seed"]) == ("hub:a", 7)


@pytest.mark.parametrize("source", ["kernel", "foreign"])
def test_syncs_are_heard_on_one_segment(source: str) -> None:
    raw = tomllib.loads((EXAMPLES / "two_segments.toml").read_text())
    raw.setdefault("loop", {})["sync"] = source
    error = only_error_of(raw)
    assert (error.key, error.remedy) == ("bus.segment", 'loop.sync = "own"')


def test_another_node_of_the_simulated_bus_may_make_the_sync() -> None:
    raw = edited("loop", "sync", value="foreign")
    raw["bus"]["background"] = [{"can_id": 0x080, "bytes_max": 0, "period_us": 1000}]
    load(raw)
    raw["bus"]["background"][0]["bytes_max"] = 1
    assert only_error_of(raw).key == "bus.background[0].bytes_max"
    raw["loop"]["sync"] = "own"
    assert only_error_of(raw).key == "bus.background[0].can_id"


def test_controller_may_be_a_file(tmp_path: Path) -> None:
    (tmp_path / "pid.toml").write_text('[controller]\nkind = "pid"\nproportional_nm_s_rad = 0.5\n')
    raw = edited("drive", "axis1", "controller", value=str(tmp_path / "pid.toml"))
    controller = load(raw).drive["axis1"].controller
    assert controller == PidController(kind="pid", proportional_nm_s_rad=0.5)


def test_faults_may_be_inline() -> None:
    plan = tomllib.loads((EXAMPLES / "faults" / "demo.toml").read_text())
    assert load(edited("faults", value=plan)).faults == load(tables()).faults


def test_axes_are_in_order_of_name() -> None:
    raw = tables()
    raw["drive"] = {"z": {**raw["drive"]["axis1"], "node": 2}, "axis1": raw["drive"]["axis1"]}
    assert load(raw).axes == ("axis1", "z")


@pytest.mark.parametrize(
    ("path", "value", "expected"),
    [
        (("bench", "duration_s"), 0.0, "> 0"),
        (("bench", "duration_s"), True, "a number"),
        (("bench", "duration_s"), "2", "a number"),
        (("bench", "duration_s"), float("inf"), "a finite number"),
        (("bench", "seed"), -1, ">= 0"),
        (("bench", "name"), "a/b", "a name of letters"),
        (("bus", "bitrate_bit_s"), 123, "1000000"),
        (("host", "node"), 0, ">= 1"),
        (("loop", "period_us"), 1000.5, "a whole number"),
        (("loop", "period_us"), 10, ">= 100"),
        (("loop", "actuation"), "now", "'on_arrival' or 'on_sync'"),
        (("drive",), {}, "at least"),
        (("drive", "axis1"), 3, "a table"),
        (("drive", "axis1", "node"), 128, "<= 127"),
        (("drive", "axis1", "motor"), 3, "the path of a motor file, or its tables inline"),
        (("drive", "axis1", "limits", "torque_max_nm"), -1.0, ">= 1e-06"),
        (("verdict", "bus_load_percent_max"), 101.0, "<= 100"),
        (("recording", "frames"), 1, "true or false"),
        (("load", "axis1", 0, "torque_nm"), "0.6", "a number"),
    ],
)
def test_a_bad_value_names_key_value_and_what_was_expected(
    path: tuple[str | int, ...], value: Any, expected: str
) -> None:
    error = only_error_of(edited(*path, value=value))
    dotted = ".".join(str(step) for step in path).replace(".0.", "[0].")
    assert (error.source, error.key, error.value) == (SOURCE, dotted, value)
    assert expected in error.expected


@pytest.mark.parametrize(
    ("path", "expected"),
    [
        (("bench",), "the table [bench]"),
        (("bench", "name"), "a name"),
        (("drive",), "[drive.NAME]"),
        (("drive", "axis1", "motor"), "motor file"),
        (("drive", "axis1", "node"), "1..127"),
        (("drive", "axis1", "limits"), "speed_max_rpm"),
        (("drive", "axis1", "controller"), "'pid'"),
        (("drive", "axis1", "controller", "proportional_nm_s_rad"), "Kp"),
        (("reference", "axis1", 0, "speed_rpm"), "r/min"),
    ],
)
def test_a_missing_key_says_what_it_is_for(path: tuple[str | int, ...], expected: str) -> None:
    error = only_error_of(edited(*path, value=MISSING))
    assert error.value is MISSING
    assert error.key == ".".join(str(step) for step in path).replace(".0.", "[0].")
    assert expected in error.expected


@pytest.mark.parametrize(
    ("path", "value", "advice"),
    [
        (("loop", "period_ms"), 1, "write period_us = 1000"),
        (("loop", "deadline_s"), 0.002, "write deadline_us = 2000"),
        (("bench", "duration"), 2.0, "write duration_s"),
        (("host", "heartbeat_us"), 50_000, "write heartbeat_ms = 50"),
        (("drive", "axis1", "limits", "speed_max_rad_s"), 100.0, "write speed_max_rpm = 954.929659"),
        (("drive", "axis1", "limits", "torque_max_mnm"), 5000, "write torque_max_nm = 5"),
        (("drive", "axis1", "simulation", "inner_rate_khz"), 16, "write inner_rate_hz = 16000"),
        (("reference", "axis1", 0, "at_ms"), 200, "write at_s = 0.2"),
        (("loop", "perod_us"), 1000, "period_us, the nearest known key"),
        (("drive", "axis1", "controler"), {}, "controller, the nearest known key"),
        (("drive", "axis1", "controller", "gain"), [1.0, 2.0], "proportional_nm_s_rad"),
        (("vedict",), {}, "verdict, the nearest known key"),
        (("loop", "zzz"), 1, "known here: actuation, command_readback"),
    ],
)
def test_an_unknown_key_is_answered_with_the_one_that_was_meant(
    path: tuple[str | int, ...], value: Any, advice: str
) -> None:
    error = only_error_of(edited(*path, value=value))
    assert error.key == ".".join(str(step) for step in path).replace(".0.", "[0].")
    assert advice in str(error)


def test_a_misspelt_required_key_is_one_error_not_two() -> None:
    raw = edited("bench", "duration_s", value=MISSING)
    raw["bench"]["duration_ms"] = 2000
    error = only_error_of(raw)
    assert error.key == "bench.duration_ms"
    assert "write duration_s = 2" in str(error)


@pytest.mark.parametrize("kind", ["pdi", MISSING])
def test_an_unknown_kind_lists_the_known(kind: Any) -> None:
    error = only_error_of(edited("drive", "axis1", "controller", "kind", value=kind))
    assert (error.key, error.value) == ("drive.axis1.controller.kind", kind)
    assert all(repr(known) in error.expected for known in ("pid", "state_feedback", "python"))


@pytest.mark.parametrize(
    ("path", "value", "expected"),
    [
        (("drive", "axis1", "node"), 127, "host.node is 127 too"),
        (("drive", "axis1", "limits", "torque_max_nm"), 6.1, "at most 5.996 N m"),
        (("drive", "axis1", "limits", "speed_max_rpm"), 5100.0, "at most 5067 r/min"),
        (("drive", "axis1", "limits", "speed_max_rpm"), 1500.0, "less than drive.axis1.limits.speed_max_rpm"),
        (("loop", "decide_after_us"), 1000, "less than loop.period_us = 1000"),
        (("loop", "deadline_us"), 20_001, "at most horizon_periods * period_us = 20000"),
        (("host", "heartbeat_timeout_ms"), 50, "more than host.heartbeat_ms = 50"),
        (("bus", "bitrate_bit_s"), 250_000, "at least 1704"),
        (("bus", "spec"), "socketcn:can0", "INTERFACE[:CHANNEL]"),
        (("load", "axis1", 0, "torque_nm"), -5.1, "torque_max_nm = 5"),
        (("load", "axis1", 0, "at_s"), 2.0, "less than bench.duration_s = 2.0"),
        (("load", "axis2"), [{"at_s": 0.0, "torque_nm": 0.1}], "one of the axes: axis1"),
    ],
)
def test_values_that_do_not_go_together(path: tuple[str | int, ...], value: Any, expected: str) -> None:
    assert expected in only_error_of(edited(*path, value=value)).expected


@pytest.mark.parametrize(
    ("actuation", "delay_us", "key", "expected", "remedy"),
    [
        ("on_arrival", 3_000, "kind", "commands act at no fixed instants", 'loop.actuation = "on_sync"'),
        ("on_sync", 21_000, "delay_us", "at most horizon_periods * period_us = 20000", ""),
        ("on_sync", 3_240, "delay_us", "a whole number of periods of 1000 us", "3000 or 4000"),
        ("on_sync", 240, "delay_us", "a whole number of periods of 1000 us", "1000"),
    ],
)
def test_stamp_needs_instants(actuation: str, delay_us: int, key: str, expected: str, remedy: str) -> None:
    raw = edited("drive", "axis1", "compensator", value={"kind": "stamp", "delay_us": delay_us})
    raw["loop"]["actuation"] = actuation
    error = only_error_of(raw)
    assert error.key == f"drive.axis1.compensator.{key}"
    assert expected in error.expected
    assert error.remedy == remedy


def test_limits_at_the_motors_own_are_accepted() -> None:
    raw = edited("drive", "axis1", "limits", "torque_max_nm", value=LING2012.parameters.torque_max_nm)
    load(raw)


def test_references_describe_themselves() -> None:
    ramp = {"kind": "ramp", "at_s": 0.5, "speed_rpm": -200.0, "over_s": 0.25}
    sine = {"kind": "sine", "at_s": 1.0, "amplitude_rpm": 100.0, "frequency_hz": 2.0}
    profile = load(edited("reference", "axis1", value=[*tables()["reference"]["axis1"], ramp, sine]))
    assert [segment.describe() for segment in profile.reference["axis1"]] == [
        "step to 1500 r/min",
        "ramp to -200 r/min over 0.25 s",
        "sine of 100 r/min at 2 Hz",
    ]


def test_the_moment_of_decision_follows_the_period() -> None:
    raw = edited("loop", value={"period_us": 500})
    assert load(raw).loop.decide_after == 350_000
    assert load(edited("loop", value=MISSING)).loop.decide_after == 700_000
    assert only_error_of(edited("loop", value={"period_us": "1"})).key == "loop.period_us"


@pytest.mark.parametrize(("readback", "least_us"), [("sync", 422), ("event", 537)])
def test_a_cycle_too_short_for_its_frames(readback: str, least_us: int) -> None:
    loop = {"command_readback": readback, "period_us": least_us - 1}
    error = only_error_of(edited("loop", value=loop))
    assert error.expected == f"at least {least_us}, which 1 drive(s) may take at 1000000 bit/s"
    load(edited("loop", value=loop | {"period_us": least_us}))


def test_bit_rates_are_those_of_the_adapters() -> None:
    assert get_args(get_args(BitRate)[0]) == tuple(BITRATE_CODES)


def test_an_axis_needs_a_plain_name() -> None:
    raw = tables()
    raw["drive"]["axis 2"] = {**raw["drive"]["axis1"], "node": 2}
    error = only_error_of(raw)
    assert (error.key, error.value) == ("drive", "axis 2")
    assert "letters" in error.expected


PAGE = ROOT / "docs" / "bench-file.md"


def test_the_bench_file_of_the_page_on_them_loads() -> None:
    (block,) = re.findall(r"```toml\n(.*?)```", PAGE.read_text(), re.DOTALL)
    assert bench_from(tomllib.loads(block), PAGE.name, ROOT).axes == ("axis1",)


def test_the_message_on_that_page_is_the_real_one() -> None:
    error = only_error_of(edited("loop", value={"period_ms": 1}))
    assert error_text(error) in PAGE.read_text()


def test_two_drives_on_one_node() -> None:
    raw = tables()
    raw["drive"]["axis2"] = raw["drive"]["axis1"]
    error = only_error_of(raw)
    assert (error.key, error.value) == ("drive.axis2.node", 1)
    assert "drive.axis1.node is 1 too" in error.expected


def test_profile_entries_are_in_order_of_time() -> None:
    step = {"kind": "step", "at_s": 0.1, "speed_rpm": 100.0}
    raw = edited("reference", "axis1", value=[*tables()["reference"]["axis1"], step])
    assert only_error_of(raw).key == "reference.axis1[1].at_s"


def test_a_sine_adds_to_the_speed_it_swings_about() -> None:
    sine = {"kind": "sine", "at_s": 0.5, "amplitude_rpm": 1000.0, "frequency_hz": 1.0}
    raw = edited("reference", "axis1", value=[*tables()["reference"]["axis1"], sine])
    error = only_error_of(raw)
    assert (error.key, error.value) == ("reference.axis1", 2500.0)


def test_a_missing_motor_file_names_the_bench_key_and_a_near_file() -> None:
    error = only_error_of(edited("drive", "axis1", "motor", value="motors/ling2021.toml"))
    assert (error.source, error.key, error.value) == (SOURCE, "drive.axis1.motor", "motors/ling2021.toml")
    assert "did you mean" in error.remedy
    assert "ling2012.toml" in error.remedy


def test_faults_of_all_files_are_reported_together(tmp_path: Path) -> None:
    (tmp_path / "motor.toml").write_text("[motor]\n")
    raw = edited("drive", "axis1", "motor", value=str(tmp_path / "motor.toml"))
    raw["loop"]["period_ms"] = 1
    found = errors_of(raw)
    sources = {error.source for error in found}
    assert sources == {SOURCE, str(tmp_path / "motor.toml")}
    assert "loop.period_ms" in {error.key for error in found}
    assert "drive.axis1.motor" not in {error.key for error in found}


def test_plan_and_inline_faults_exclude_each_other() -> None:
    error = only_error_of(edited("faults", "loss", value=[]))
    assert error.key == "faults"
    assert "either plan" in error.expected


def test_a_bad_fault_plan_is_named() -> None:
    error = errors_of(edited("faults", value={"los": [{"probability": 0.1}]}))[0]
    assert error.source.startswith(SOURCE)
    assert "los" in error.key


def test_a_file_of_another_kind_is_called_by_its_kind() -> None:
    motor = tomllib.loads((ROOT / "examples/motors/ling2012.toml").read_text())
    error = only_error_of(motor)
    assert (error.value, error.expected) == ("a motor file", "a file with [bench], [drive]")
