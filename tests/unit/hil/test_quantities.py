"""What is absurd is refused, what is odd is told."""

import tomllib
from pathlib import Path
from typing import Any

import pytest

from servobench.drivers.errors import BadInput
from servobench.hil.configuration.bench_file import bench_from, load_bench
from servobench.hil.configuration.config_checks import idle_faults
from servobench.hil.configuration.config_files import BadInputs
from servobench.hil.configuration.design_files import load_weights
from servobench.hil.configuration.quantities import odd_values

EXAMPLES = Path(__file__).parents[3] / "examples"
SINE = {"at_s": 0.1, "kind": "sine", "amplitude_rpm": 10.0}


def tables_with(path: tuple[Any, ...], value: Any) -> dict[str, Any]:
    tables = tomllib.loads((EXAMPLES / "ling2012.toml").read_text())
    tables["drive"]["axis1"]["motor"] = tomllib.loads((EXAMPLES / "motors" / "ling2012.toml").read_text())
    node: Any = tables
    for step in path[:-1]:
        node = node[step]
    node[path[-1]] = value
    return tables


INERTIA = ("drive", "axis1", "motor", "mechanics", "inertia_kg_m2")
LIMITS = ("drive", "axis1", "limits")


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (INERTIA, 5e-324),
        (INERTIA, 1e300),
        (("drive", "axis1", "motor", "motor", "resistance_ohm"), 1e308),
        ((*LIMITS, "dropouts_consecutive_max"), 2**62),
        ((*LIMITS, "torque_slew_max_nm_s"), 1e308),
        (("drive", "axis1", "controller", "proportional_nm_s_rad"), 1e308),
        (("reference", "axis1"), [{**SINE, "frequency_hz": 1e308}]),
        (("reference", "axis1"), [{**SINE, "frequency_hz": 501.0}]),
    ],
)
def test_the_absurd_is_refused(path: tuple[Any, ...], value: Any) -> None:
    with pytest.raises((BadInput, BadInputs)) as caught:
        bench_from(tables_with(path, value), "bench.toml", EXAMPLES)
    assert str(path[-1]) in str(caught.value)


@pytest.mark.parametrize(
    ("path", "value", "told"),
    [
        (INERTIA, 10.0, "drive.axis1.motor.mechanics.inertia_kg_m2: 10 is odd, 1e-07 to 5 is usual"),
        (("host", "heartbeat_timeout_ms"), 65_000, "host.heartbeat_timeout_ms: 65000 is odd"),
        (
            ("drive", "axis1", "heartbeat_timeout_ms"),
            65_000,
            "drive.axis1.heartbeat_timeout_ms: 65000 is odd",
        ),
        (
            (*LIMITS, "dropouts_consecutive_max"),
            5000,
            "drive.axis1.limits.dropouts_consecutive_max: 5000 is odd",
        ),
        (
            ("reference", "axis1"),
            [{**SINE, "frequency_hz": 400.0}],
            "reference.axis1[0].frequency_hz: 400 is odd",
        ),
    ],
)
def test_the_odd_is_told(path: tuple[Any, ...], value: Any, told: str) -> None:
    notes = list(odd_values(bench_from(tables_with(path, value), "bench.toml", EXAMPLES)))
    assert len(notes) == 1
    assert told in notes[0]


@pytest.mark.parametrize(
    ("faults", "told"),
    [
        (
            {"loss": [{"probability": 0.1, "nodes": [5]}]},
            "faults.loss[0].nodes: 5: the bench has none of them",
        ),
        ({"loss": [{"probability": 0.1, "nodes": [1, 5]}]}, ""),
        ({"loss": [{"probability": 0.1, "nodes": [127]}]}, ""),
        ({"loss": [{"probability": 0.1, "from_s": 2.0}]}, "faults.loss[0]: it begins at 2 s, behind the end"),
        ({"loss": [{"probability": 0.1, "from_s": 1.9, "until_s": 9.0}]}, ""),
        (
            {"drive_fault": [{"fault": "over_current", "at_s": 1.0}, {"fault": "over_current", "at_s": 7.5}]},
            "faults.drive_fault[1]: it begins at 7.5 s, behind the end",
        ),
        ({"host_stall": [{"at_s": 3.0, "late_us": 5000}]}, "faults.host_stall[0]: it begins at 3 s"),
        (
            {"loose_coupling": [{"at_s": 1.0, "backlash_rad": 0.1, "duration_s": 1.0}]},
            "faults.loose_coupling[0]: no drive that it strikes has [coupling]",
        ),
        (
            {"chopper_off": [{"at_s": 1.0, "duration_s": 1.0}]},
            "faults.chopper_off[0]: no drive that it strikes has [supply.chopper]",
        ),
    ],
)
def test_a_fault_that_never_acts_is_told(faults: Any, told: str) -> None:
    notes = list(idle_faults(bench_from(tables_with(("faults",), faults), "bench.toml", EXAMPLES)))
    assert len(notes) == bool(told)
    assert told in "".join(notes)


@pytest.mark.parametrize("bench", sorted(EXAMPLES.glob("*.toml")), ids=lambda path: path.name)
def test_the_examples_are_not_odd(bench: Path) -> None:
    assert [*odd_values(load_bench(bench)), *idle_faults(load_bench(bench))] == []


def test_a_weight_that_overflows_the_synthesis_is_refused(tmp_path: Path) -> None:
    text = (EXAMPLES / "weights" / "azaiz2007-q.toml").read_text()
    head, _, output = text.partition("[output]")
    lines = [("high = 1e300" if line.startswith("high") else line) for line in output.splitlines()]
    path = tmp_path / "weights.toml"
    path.write_text("\n".join([head, "[output]", *lines]))
    with pytest.raises(BadInput, match=r"output\.high"):
        load_weights(path)
