"""Values of a bench file that do not go together: all that is said of each, and where the limit lies."""

from pathlib import Path
from typing import Any

import pytest

from servobench.drivers.errors import MISSING, BadInput
from servobench.hil.configuration.bench_file import Bench
from servobench.hil.configuration.config_checks import LOAD_DELAY_MAX_S
from servobench.hil.configuration.config_files import BadInputs, bad_inputs_of

EXAMPLES = Path(__file__).parents[3] / "examples"
ONE, THREE, SEGMENTS = "ling2012.toml", "three_axes.toml", "two_segments.toml"
POSITIONS, MACHINE = "position_csp.toml", "load_machine.toml"
Said = tuple[str, object, str, str]
"""Key, value, what was expected, remedy."""


def changed(name: str, changes: dict[str, Any]) -> Bench:
    return Bench.load(EXAMPLES / name).changed(changes)


def said_of(name: str, changes: dict[str, Any]) -> list[Said]:
    bench = changed(name, changes)
    with pytest.raises((BadInput, BadInputs)) as caught:
        _ = bench.config
    found = bad_inputs_of(caught.value)
    assert {each.source for each in found} == {str(EXAMPLES / name)}
    return [(each.key, each.value, each.expected, each.remedy) for each in found]


OF_ITS_OWN = "a node id of its own; {} is {} too"
TWO_LOST = "rides over two lost heartbeats"
CONTRADICTIONS: list[tuple[str, dict[str, Any], list[Said]]] = [
    (
        ONE,
        {"bus.spec": "socketcn:can0", "host.node": 1},
        [
            ("drive.axis1.node", 1, OF_ITS_OWN.format("host.node", 1), ""),
            (
                "bus.spec",
                "socketcn:can0",
                "INTERFACE[:CHANNEL] of an interface known here",
                "did you mean 'socketcan'?",
            ),
        ],
    ),
    (
        THREE,
        {"drive.axis2.node": 1, "drive.axis3.node": 1},
        [
            ("drive.axis2.node", 1, OF_ITS_OWN.format("drive.axis1.node", 1), ""),
            ("drive.axis3.node", 1, OF_ITS_OWN.format("drive.axis1.node", 1), ""),
        ],
    ),
    (ONE, {"host.node": 1}, [("drive.axis1.node", 1, OF_ITS_OWN.format("host.node", 1), "")]),
    (
        SEGMENTS,
        {"bus.segment": [{"name": "feed"}, {"name": "b"}, {"name": "feed"}]},
        [("bus.segment[2].name", "feed", "a name of its own", "")],
    ),
    (
        SEGMENTS,
        {"bus.spec": "hub:a"},
        [
            (
                "bus.segment",
                "1 on hub:a",
                "no further segments: they are made on the bus 'simulated' only",
                "a bench has one real bus",
            )
        ],
    ),
    (
        SEGMENTS,
        {"loop.sync": "foreign"},
        [
            (
                "bus.segment",
                '1, with loop.sync = "foreign"',
                "no further segments: SYNCs are heard on one segment",
                'loop.sync = "own"',
            )
        ],
    ),
    (
        SEGMENTS,
        {"drive.feed.segment": "fed"},
        [
            (
                "drive.feed.segment",
                "fed",
                "one of the bus.segment: feed",
                "leave it out for the first segment",
            )
        ],
    ),
    (
        ONE,
        {"drive.axis1.segment": "b"},
        [
            (
                "drive.axis1.segment",
                "b",
                "one of the bus.segment: there is none",
                "leave it out for the first segment",
            )
        ],
    ),
    (
        ONE,
        {"loop.decide_after_us": 1000},
        [("loop.decide_after_us", 1000, "less than loop.period_us = 1000", "")],
    ),
    (
        ONE,
        {"loop.deadline_us": 3001, "loop.horizon_periods": 3},
        [
            (
                "loop.deadline_us",
                3001,
                "at most horizon_periods * period_us = 3000",
                "a reading is given up before it could be late",
            )
        ],
    ),
    (
        ONE,
        {"host.heartbeat_ms": 40, "host.heartbeat_timeout_ms": 40},
        [("host.heartbeat_timeout_ms", 40, "more than host.heartbeat_ms = 40", f"120 {TWO_LOST}")],
    ),
    (
        ONE,
        {"drive.axis1.heartbeat_ms": 30, "drive.axis1.heartbeat_timeout_ms": 29},
        [
            (
                "drive.axis1.heartbeat_timeout_ms",
                29,
                "more than drive.axis1.heartbeat_ms = 30",
                f"90 {TWO_LOST}",
            )
        ],
    ),
    (
        POSITIONS,
        {"bench.duration_s": 0.000999, "reference": None, "verdict": None},
        [("bench.duration_s", 0.000999, "at least one loop.period_us", "")],
    ),
    (
        ONE,
        {"drive.axis1.compensator": {"kind": "stamp", "delay_us": 20_500}, "loop.actuation": "on_arrival"},
        [
            (
                "drive.axis1.compensator.kind",
                "stamp",
                'arrival while loop.actuation = "on_arrival": commands act at no fixed instants then',
                'loop.actuation = "on_sync"',
            ),
            (
                "drive.axis1.compensator.delay_us",
                20_500,
                "at most horizon_periods * period_us = 20000",
                "",
            ),
            (
                "drive.axis1.compensator.delay_us",
                20_500,
                "a whole number of periods of 1000 us: drives sample and act at SYNCs",
                "20000 or 21000",
            ),
        ],
    ),
    (
        ONE,
        {"drive.axis1.compensator": {"kind": "stamp", "delay_us": 999}, "loop.actuation": "on_sync"},
        [
            (
                "drive.axis1.compensator.delay_us",
                999,
                "a whole number of periods of 1000 us: drives sample and act at SYNCs",
                "1000",
            )
        ],
    ),
    (
        ONE,
        {"drive.axis1.limits.torque_max_nm": 6.0},
        [
            (
                "drive.axis1.limits.torque_max_nm",
                6.0,
                "at most 5.996 N m, what the motor Ling2012 gives at 15 A",
                "",
            )
        ],
    ),
    (
        ONE,
        {"drive.axis1.simulation.current_bandwidth_hz": 2000.5},
        [
            (
                "drive.axis1.simulation.current_bandwidth_hz",
                2000.5,
                "at most 2000, an eighth of inner_rate_hz",
                "",
            )
        ],
    ),
    (
        ONE,
        {"drive.axis1.limits.speed_max_rpm": 5068.0},
        [
            (
                "drive.axis1.limits.speed_max_rpm",
                5068.0,
                "at most 5067 r/min, where Ling2012's back-EMF takes 300 V",
                "",
            )
        ],
    ),
    (
        THREE,
        {"reference.axis": [], "load.spindle": []},
        [
            ("reference.axis", "axis", "one of the axes: axis1, axis2, axis3", "did you mean axis3?"),
            ("load.spindle", "spindle", "one of the axes: axis1, axis2, axis3", ""),
        ],
    ),
    (
        ONE,
        {
            "load.axis1": [
                {"at_s": 0.5, "torque_nm": 0.1},
                {"at_s": 0.5, "torque_nm": -5.5},
                {"at_s": 2.0, "torque_nm": 5.0},
            ]
        },
        [
            ("load.axis1[1].at_s", 0.5, "more than the entry before it, 0.5", ""),
            ("load.axis1[2].at_s", 2.0, "less than bench.duration_s = 2.0", ""),
            (
                "load.axis1[1].torque_nm",
                -5.5,
                "at most drive.axis1.limits.torque_max_nm = 5 in magnitude",
                "no command could hold it",
            ),
        ],
    ),
    (
        ONE,
        {
            "reference.axis1": [
                {"kind": "sine", "at_s": 0.1, "amplitude_rpm": 9.0, "frequency_hz": 500.0},
                {"kind": "sine", "at_s": 0.2, "amplitude_rpm": 9.0, "frequency_hz": 501.0},
            ]
        },
        [("reference.axis1[1].frequency_hz", 501.0, "at most 500, half the rate of the loop", "")],
    ),
    (
        MACHINE,
        {"load_machine.axis": "axis2"},
        [("load_machine.axis", "axis2", "one of the axes: axis1", "did you mean axis1?")],
    ),
    (
        THREE,
        {"load_machine": {"kind": "magtrol_dsp7000", "port": "simulated", "torque_max_nm": 1.0}},
        [("load_machine.axis", MISSING, "one of the axes: axis1, axis2, axis3", "")],
    ),
    (
        MACHINE,
        {"load_machine.kind": "magtrol_dsp6001", "load_machine.channel": 2},
        [("load_machine.channel", 2, "1, the only channel of a DSP6001", "")],
    ),
    (
        MACHINE,
        {
            "load_machine.torque_max_nm": 0.5,
            "load.axis1": [{"at_s": 0.1, "torque_nm": 0.51}, {"at_s": 0.2, "torque_nm": -0.6}],
        },
        [
            ("load.axis1[0].torque_nm", 0.51, "at most load_machine.torque_max_nm = 0.5", ""),
            ("load.axis1[1].torque_nm", -0.6, "0 or more: a brake takes power and gives none", ""),
            ("load.axis1[1].torque_nm", -0.6, "at most load_machine.torque_max_nm = 0.5", ""),
        ],
    ),
    (
        ONE,
        {"drive.axis1.observe": ["6079"], "recording.frames": False},
        [
            (
                "recording.frames",
                False,
                "true: what a drive tells beside the loop is read from its frames",
                "or leave drive.axis1.observe out",
            )
        ],
    ),
]


@pytest.mark.parametrize(("name", "changes", "said"), CONTRADICTIONS)
def test_all_that_is_said_of_a_contradiction(name: str, changes: dict[str, Any], said: list[Said]) -> None:
    assert said_of(name, changes) == said


NEAR: list[tuple[str, dict[str, Any]]] = [
    (ONE, {"loop.decide_after_us": 999}),
    (ONE, {"loop.deadline_us": 3000, "loop.horizon_periods": 3}),
    (ONE, {"host.heartbeat_ms": 40, "host.heartbeat_timeout_ms": 41}),
    (ONE, {"drive.axis1.heartbeat_ms": 30, "drive.axis1.heartbeat_timeout_ms": 31}),
    (POSITIONS, {"bench.duration_s": 0.001, "reference": None, "verdict": None}),
    (
        ONE,
        {"drive.axis1.compensator": {"kind": "stamp", "delay_us": 20_000}, "loop.actuation": "on_sync"},
    ),
    (ONE, {"drive.axis1.simulation.current_bandwidth_hz": 2000.0}),
    (ONE, {"drive.axis1.limits.speed_max_rpm": 5067.0}),
    (ONE, {"load.axis1": [{"at_s": 0.5, "torque_nm": 5.0}, {"at_s": 1.999, "torque_nm": -5.0}]}),
    (
        THREE,
        {
            "load_machine": {
                "kind": "magtrol_dsp6001", "port": "simulated", "torque_max_nm": 0.6, "axis": "axis1",
                "channel": 1,
            }
        },
    ),
    (MACHINE, {"load.axis1": [{"at_s": 0.1, "torque_nm": 0.0}, {"at_s": 0.2, "torque_nm": 5.0}]}),
    (ONE, {"drive.axis1.observe": ["6079"]}),
]  # fmt: skip


@pytest.mark.parametrize(("name", "changes"), NEAR)
def test_exactly_at_the_limit_nothing_is_said(name: str, changes: dict[str, Any]) -> None:
    assert changed(name, changes).config.axes


def load_of(tmp_path: Path, text: str, **more: Any) -> dict[str, Any]:
    path = tmp_path / "load.csv"
    path.write_text(text)
    return {"kind": "file", "path": str(path), **more}


TORQUES = "time_s,torque_nm\n0,-0.2\n1,0.7\n"


def test_a_load_from_a_file_is_of_torques_alone_and_soon(tmp_path: Path) -> None:
    late = float(LOAD_DELAY_MAX_S) + 0.5
    loads = [load_of(tmp_path, TORQUES, at_s=late), {"at_s": late + 1.0, "torque_nm": 0.1}]
    changes = {"bench.duration_s": 2 * late, "load.axis1": loads, "loop.sync": "foreign", "bus.spec": "hub:a"}
    assert LOAD_DELAY_MAX_S == 4294, "2^32 us"
    assert said_of(ONE, changes) == [
        ("load.axis1[0]", "2 entries", "one entry: a load from a file is alone on its axis", ""),
        ("load.axis1[0].at_s", late, "at most 4294, which 2100h:5 can say", ""),
        (
            "loop.sync",
            "foreign",
            'loop.sync = "own": the drive begins the load with the run\'s first SYNC',
            "",
        ),
    ]
    changes["load.axis1"] = [load_of(tmp_path, TORQUES, at_s=float(LOAD_DELAY_MAX_S))]
    changes["loop.sync"] = "own"
    assert changed(ONE, changes).config.axes


def test_a_load_from_a_file_is_bounded_by_its_largest_and_a_brake_by_its_least(tmp_path: Path) -> None:
    entry = load_of(tmp_path, TORQUES)
    assert said_of(ONE, {"load.axis1": [entry], "drive.axis1.limits.torque_max_nm": 0.69}) == [
        (
            "load.axis1[0].path",
            pytest.approx(0.7),
            "at most drive.axis1.limits.torque_max_nm = 0.69 in magnitude",
            "no command could hold it",
        )
    ]
    brake = {"load.axis1": [entry], "load_machine.torque_max_nm": 0.6, "loop.sync": "kernel"}
    assert said_of(MACHINE, brake | {"bus.spec": "hub:a"})[:2] == [
        ("load.axis1[0].path", -0.2, "0 or more: a brake takes power and gives none", ""),
        ("load.axis1[0].path", 0.7, "at most load_machine.torque_max_nm = 0.6", ""),
    ]


def test_a_load_is_no_speed(tmp_path: Path) -> None:
    entry = load_of(tmp_path, "time_s,speed_rad_s\n0,0\n1,0.1\n")
    said = said_of(ONE, {"load.axis1": [entry]})
    assert said == [("load.axis1[0].path", entry["path"], "a file with torque_nm: a load is a torque", "")]
