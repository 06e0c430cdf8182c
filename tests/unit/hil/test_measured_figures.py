"""Figures of a measurement as JSON, as a network, and as a fault plan that does the same: counted by hand."""

import tomllib
from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, Final, cast

import numpy as np
import pytest

from servobench.design.confidence import Interval, clopper_pearson
from servobench.drivers.canopen.pdo import PdoDirection, PdoEntry, PdoMap
from servobench.drivers.wire.frame_port import EchoBasis
from servobench.hil.configuration.network_file import ClockHealth
from servobench.hil.loop.axis import Axis
from servobench.hil.loop.cycle_record import COMMAND_FATES, NOTHING
from servobench.hil.loop.samples import CommandFate
from servobench.hil.measuring.figures import (
    ClockFigures,
    Measured,
    MeasuredDrive,
    clocks_by_node,
    fault_plan_text,
    losses_json,
    network_of,
    quantile_below_us,
    stage_json,
)
from servobench.hil.measuring.loss_model import LOST, Losses, LossModel, Parameters
from servobench.hil.measuring.stages import Stage, command_stages, stage, ways
from servobench.hil.measuring.stamp_probe import StampFigures
from servobench.hil.measuring.subject import MeasureRequest
from servobench.hil.rows.records import Rows
from tests.unit.hil.test_measuring import change, rows_of, sent

REQUEST: Final = MeasureRequest("hub:x", (3,), 500, 1000, 1_000_000, enable=True, speed_max_rad_s=10.0)


def test_a_stage_that_was_not_measured_says_why() -> None:
    empty = stage("sample", "sample", [], "the drive puts no stamp beside it")
    assert not empty.measured
    assert stage_json(empty) == {"measured": False, "why": "the drive puts no stamp beside it"}
    assert quantile_below_us(empty, 0.5) is None


def test_a_stage_is_told_in_us_with_its_bounds() -> None:
    """1000 times, 1 to 1000 us, each once."""
    one = stage("computation", "computation", 1_000 * np.arange(1, 1001), "the host's clock")
    told = stage_json(one)
    histogram = told.pop("histogram")
    assert sum(histogram["counts"]) == 1000
    # of 1000 samples the 995th is above the quantile of 99 % in 19 of 20 cases, and none above that of 99.9 %
    assert told == {
        "measured": True,
        "basis": "the host's clock",
        "samples": 1000,
        "p50_us": pytest.approx(500.0, rel=1e-3),
        "p99_us": pytest.approx(990.0, rel=1e-3),
        "p999_us": pytest.approx(999.0, rel=1e-3),
        "max_us": 1000.0,
        "p99_below_us": pytest.approx(996.0, rel=1e-3),
        "p999_below_us": None,
        "share_within_max": pytest.approx(0.05**0.001),
    }


MODEL: Final = LossModel(False, Parameters(0.1, 0.4, 0.9, 0.01), {"p_good_to_bad": Interval(0.05, 0.2)})
CHANCE: Final = LossModel(True, Parameters(0.0, 1.0, 1.0, 0.02), {"probability": Interval(0.01, 0.03)})


def lost(model: LossModel | None = None, why: str = "") -> Losses:
    return Losses(200, 50, (3, 0, 1), Interval(0.2, 0.3), model, why)


def test_losses_are_told_with_their_model() -> None:
    told: dict[str, Any] = {
        "measured": True,
        "known": 200,
        "lost": 50,
        "runs": [3, 0, 1],
        "percent": 25.0,
        "percent_interval": [20.0, 30.0],
    }
    assert losses_json(lost(why="too few")) == told | {"model": None, "why": "too few"}
    assert losses_json(lost(MODEL)) == told | {
        "model": {
            "kind": "gilbert_elliott",
            "method": "maximum likelihood",
            "p_good_to_bad": 0.1,
            "p_bad_to_good": 0.4,
            "loss_bad": 0.9,
            "loss_good": 0.01,
            "intervals": {"p_good_to_bad": [0.05, 0.2]},
        }
    }
    assert losses_json(lost(CHANCE))["model"]["kind"] == "independent"
    unknown = Losses(0, 0, (), None, None, "not measured")
    assert losses_json(unknown) == {"measured": False, "why": "not measured"}


# ---- a fault plan -------------------------------------------------------------------------------------

NONE: Final = Losses(10, 0, (), Interval(0.0, 0.3), None, "not identifiable: 0 runs of losses")
SPEED: Final = PdoMap(PdoDirection.TRANSMIT, 1, 0x183, (PdoEntry(0x606C, 0, "i"),))
COMMAND: Final = PdoMap(PdoDirection.RECEIVE, 1, 0x203, (PdoEntry(0x6040, 0, "H"), PdoEntry(0x6071, 0, "h")))
"""Both of four bytes: 76 bits without a stuff bit, 76 us at 1 Mbit/s."""


def drive(node: int = 3, stages: Sequence[Stage] = (), **losses: Losses) -> MeasuredDrive:
    times = {key: stage(key, key, [], "") for key in ("reception", "command_on_bus", "command_acting")}
    times |= {each.key: each for each in stages}
    keys = ("sync_before_bus", "reading", "command_before_bus", "command_behind_bus", "readings", "commands")
    return MeasuredDrive(
        node,
        "a drive",
        SPEED,
        COMMAND,
        list(times.values()),
        dict.fromkeys(keys, NONE) | losses,
        2,
        None,
        ["a note"],
    )


def measured(*drives: MeasuredDrive) -> Measured:
    return Measured(
        REQUEST,
        500,
        4,
        False,
        EchoBasis.KERNEL,
        [],
        drives,
        None,
        {"others": {}},
        1,
        ("a doubt",),
        ("another wrote",),
    )


HEAD: Final = (
    "# What hub:x did in 500 cycles of 1000 us.\n# Losses that were too few to be modelled are not in it.\n\n"
)


def plan_of(*drives: MeasuredDrive) -> dict[str, Any]:
    text = fault_plan_text(measured(*drives))
    assert text.startswith(HEAD)
    return tomllib.loads(text)


def test_of_a_bus_that_does_nothing_there_is_nothing_to_do() -> None:
    assert fault_plan_text(measured(drive())) == HEAD


def test_losses_strike_where_they_were_measured() -> None:
    chain = {"p_good_to_bad": 0.1, "p_bad_to_good": 0.4, "loss_bad": 0.9, "loss_good": 0.01}
    way = {"direction": "host_to_drive", "frames": [0x203]}
    found = plan_of(
        drive(
            sync_before_bus=lost(MODEL),
            reading=lost(MODEL),
            command_before_bus=lost(MODEL),
            command_behind_bus=lost(MODEL),
        ),
        drive(5, sync_before_bus=lost(MODEL)),
    )
    assert found == {
        "burst": [
            {"side": "drive", "nodes": [3], "direction": "drive_to_host", "frames": [0x183], **chain},
            {"side": "host", **way, **chain},
            {"side": "drive", **way, "nodes": [3], **chain},
            {"side": "host", "direction": "host_to_drive", "frames": ["sync"], **chain},
        ]
    }, "a SYNC is all drives', so its losses stand once"
    assert plan_of(drive(readings=lost(MODEL), commands=lost(MODEL))) == {}, "the whole of a way is none"


def delays(key: str, *times_us: float) -> Stage:
    return stage(key, key, [round(time * 1000) for time in times_us], "x")


@pytest.mark.parametrize(
    ("key", "where", "transit_us"),
    [
        (
            "reception",
            {"side": "drive", "nodes": [3], "direction": "drive_to_host", "frames": ["pdo"]},
            76.0,
        ),
        ("command_on_bus", {"side": "host", "direction": "host_to_drive", "frames": [0x203]}, 76.0),
        (
            "command_acting",
            {"side": "drive", "direction": "host_to_drive", "frames": [0x203], "nodes": [3]},
            0.0,
        ),
    ],
)
def test_delays_are_told_without_what_a_frame_takes_itself(
    key: str, where: dict[str, Any], transit_us: float
) -> None:
    one = delays(key, 200.0, 210.0, 210.0, 250.0, 300.0)
    (found,) = plan_of(drive(stages=[one]))["measured_delay"]
    edges, counts = found.pop("edges_us"), found.pop("counts")
    bars = stage_json(one)["histogram"]
    assert found == where
    assert counts == list(bars["counts"])
    assert edges == pytest.approx([edge - transit_us for edge in bars["edges_us"]])


def test_what_lies_below_the_shortest_time_is_put_into_the_first_bar() -> None:
    one = delays("reception", 10.0, 20.0, 100.0, 200.0)
    bars = stage_json(one)["histogram"]
    (found,) = plan_of(drive(stages=[one]))["measured_delay"]
    assert sum(found["counts"]) == 4
    assert found["edges_us"][0] == 0.0
    assert all(edge > 0.0 for edge in found["edges_us"][1:])
    first = next(place for place, edge in enumerate(bars["edges_us"]) if edge > 76.0) - 1
    assert found["counts"] == [sum(bars["counts"][: first + 1]), *bars["counts"][first + 1 :]]
    assert plan_of(drive(stages=[delays("reception", 10.0, 20.0)])) == {}, "all of it is the frame's own"


# ---- all of it ----------------------------------------------------------------------------------------


def test_everything_is_told_as_json() -> None:
    one = replace(drive(), clock=ClockFigures(1.5, 0.5, -3.0, 2.0, 1), stages=[delays("sample", 1.0)])
    one = replace(one, stamp=StampFigures("1013h:00", 64, True, False, 1.0, 62.5, None, 0.25))
    host = stage("wake_up", "wake-up lateness", [], "no")
    told = replace(measured(one), host=[host]).as_json()
    assert told == {
        "bus": "hub:x",
        "period_us": 1000,
        "cycles": 500,
        "missed": 4,
        "enabled": True,
        "interrupted": False,
        "echoes": EchoBasis.KERNEL.value,
        "confidence": 0.95,
        "host": {"wake_up": {"measured": False, "why": "no"}},
        "drives": [
            {
                "node": 3,
                "identity": "a drive",
                "stages": {"sample": stage_json(one.stages[0])},
                "losses": dict.fromkeys(one.losses, losses_json(NONE)),
                "uncertain": 2,
                "clock": {
                    "drift_ppm": 1.5,
                    "drift_error_ppm": 0.5,
                    "offset_us": -3.0,
                    "error_us": 2.0,
                    "steps": 1,
                },
                "stamp": {
                    "object": "1013h:00",
                    "reads": 64,
                    "runs": True,
                    "at_sync": False,
                    "unit_us": 1.0,
                    "resolution_us": 62.5,
                    "bits": None,
                    "step_chance": 0.25,
                },
                "notes": ["a note"],
            }
        ],
        "network": None,
        "timing": {"others": {}},
        "distrust": ["a doubt"],
        "disturbed": ["another wrote"],
    }
    assert measured(drive()).as_json()["drives"][0]["clock"] is None


def test_a_clock_is_told_by_its_map_once_that_is_ready() -> None:
    clock = SimpleNamespace(ready=True, drift_ppm=2.5, drift_error_ppm=0.5, offset_ns=-3_000, error_ns=1_500)
    axis: Any = SimpleNamespace(by_stamp=SimpleNamespace(clock=clock, health=SimpleNamespace(steps=2)))
    assert ClockFigures.of(cast(Axis, axis)) == ClockFigures(2.5, 0.5, -3.0, 1.5, 2)
    clock.ready = False
    assert ClockFigures.of(cast(Axis, axis)) is None


def test_a_network_has_the_clocks_of_its_nodes_and_how_their_stamps_advance() -> None:
    clock, stamp = (
        ClockFigures(1.5, 0.5, -3.0, 2.0, 1),
        StampFigures("", 64, True, False, 1.0, 62.5, None, 0.0),
    )
    clocks = clocks_by_node([replace(drive(), node=5, clock=clock, stamp=stamp), replace(drive(), node=6)])
    assert clocks == {
        "node5": ClockHealth(
            drift_ppm=1.5, drift_error_ppm=0.5, error_us=2.0, steps=1, stamp_resolution_us=62.5
        ),
        "node6": ClockHealth(),
    }


def network(*rows: Rows, acting: bool = True) -> Any:
    return network_of(1000, rows, [ways(each, EchoBasis.BUS, acting=acting) for each in rows])


def test_the_bounds_of_a_network_are_those_of_all_its_drives() -> None:
    rows = rows_of(400)
    rows["fate"][10:400:80], rows["delay_ns"][10:400:80] = 1, NOTHING
    rows["command_fate"][20] = COMMAND_FATES.index(CommandFate.LOST)
    found = network(rows)
    percent = [100.0 * end for end in clopper_pearson(5, 400)]
    assert found.certainty.confidence == 0.95
    assert list(found.certainty.loss_percent) == pytest.approx(percent)
    assert list(found.certainty.command_loss_percent) == pytest.approx(
        [100.0 * end for end in clopper_pearson(1, 400)]
    )
    assert found.certainty.reading_delay_share == pytest.approx(0.05 ** (1 / 395))
    assert found.certainty.action_delay_share == pytest.approx(0.05 ** (1 / 399))
    assert (found.reading_losses, found.command_losses) == (None, None), "too few to be modelled"
    # from the hand-over, 250 us after the tick, until the next SYNC is on the bus, 50 us after the next tick
    edges, counts = found.command_histogram.edges_us, found.command_histogram.counts
    assert sum(counts) == 399
    assert edges[0] <= 800.0 <= edges[-1]


def test_losses_that_can_be_modelled_are() -> None:
    rows = rows_of(300)
    rows["fate"][5:300:25] = 1
    found = network(rows, rows_of(100))
    assert found.reading_losses.loss_good == pytest.approx(12 / 400)
    assert found.reading_losses.loss_bad == 1.0


def test_without_readings_or_commands_less_is_known() -> None:
    rows = rows_of(20)
    rows["fate"], rows["delay_ns"] = LOST, NOTHING
    assert network(rows) is None
    disabled = rows_of(20)
    disabled["command_fate"] = COMMAND_FATES.index(CommandFate.NOT_MEASURED)
    found = network(disabled, acting=False)
    assert found.certainty.command_loss_percent is None
    assert found.certainty.action_delay_share is None
    assert found.command_histogram is None


# ---- stages of the commands ---------------------------------------------------------------------------


def told(stages: list[Stage]) -> dict[str, tuple[str, str]]:
    return {each.key: (each.title, each.basis) for each in stages}


def test_how_each_stage_of_a_command_is_known_is_said() -> None:
    rows = rows_of(3)
    commands = [sent(cycle, cycle) for cycle in (1, 2, 3)]
    by_change = {1: change(1, 1_400_000)}
    always = {
        "computation": ("computation", "the host's clock, this loop's decision"),
        "command_on_bus": ("command on the bus", "echo with the kernel's stamp"),
        "sample_to_acting": ("sample to acting", "the most that it may be"),
    }
    found = command_stages(rows, commands, by_change, [5], EchoBasis.KERNEL, "no")
    assert told(found) == always | {
        "command_acting": ("command acting", "6074h and 1013h on change, from the command on the bus")
    }
    (acting,) = [each for each in found if each.key == "command_acting"]
    assert acting.times.largest_ns == 1_400_000 - 1_330_000
    silent = [sent(cycle, cycle, on_bus=False) for cycle in (1, 2, 3)]
    found = command_stages(rows, silent, {}, [5], EchoBasis.NONE, "no")
    since = "6074h with the SYNC, from handing the command over"
    assert told(found) == always | {
        "command_on_bus": ("command on the bus", "no echo of own frames on this bus"),
        "command_acting_least": ("command acting, at least", since),
        "command_acting": ("command acting, at most", since),
    }
    rows["command_fate"] = COMMAND_FATES.index(CommandFate.NOT_MEASURED)
    rows["command_acts_by"] = rows["command_acts_after"] = NOTHING
    found = command_stages(rows, commands, {}, [5], EchoBasis.KERNEL, "it is disabled")
    assert told(found) == always | {
        "command_acting": ("command acting", "it is disabled"),
        "sample_to_acting": ("sample to acting", "it is disabled"),
    }
