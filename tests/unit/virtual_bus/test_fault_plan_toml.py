"""Fault plans as TOML: what they mean, and what is said of one that cannot be used."""

import tomllib
from pathlib import Path
from typing import Any

import pytest

from servobench.drivers.errors import MISSING, BadInput
from servobench.virtual_bus.bus.judge import Direction
from servobench.virtual_bus.faults.fault_plan import FaultPlan, load_fault_plan, read_fault_plan
from servobench.virtual_bus.faults.frame_fault import node_of
from servobench.virtual_bus.faults.kinds.blackout import Blackout
from servobench.virtual_bus.faults.kinds.burst import Burst
from servobench.virtual_bus.faults.kinds.delay import Delay
from servobench.virtual_bus.faults.kinds.loss import Loss
from servobench.virtual_bus.faults.kinds.periodic_loss import PeriodicLoss

EXAMPLES = sorted((Path(__file__).parents[3] / "examples" / "faults").glob("*.toml"))
OUT, IN = Direction.HOST_TO_DRIVE, Direction.DRIVE_TO_HOST


def load(text: str) -> FaultPlan:
    return load_fault_plan(tomllib.loads(text), "plan.toml")


def error_of(text: str) -> BadInput:
    with pytest.raises(BadInput) as caught:
        load(text)
    return caught.value


def test_every_kind_of_fault_is_read() -> None:
    plan = load("""
        [[loss]]
        probability = 0.02
        [[burst]]
        p_good_to_bad = 0.01
        p_bad_to_good = 0.5
        loss_bad = 0.9
        [[periodic_loss]]
        lost = 2
        direction = "host_to_drive"
        [[blackout]]
        from_s = 0.7
        duration_s = 0.02
        [[delay]]
        delay_us = 0.5
        frames = ["sync", 0x181]
        nodes = [1, 2]
        until_s = 3
        [[delay]]
        delay_min_us = 100
        delay_max_us = 400
        reorder = true
    """)
    assert plan.faults == (
        Loss(probability=0.02),
        Burst(p_good_to_bad=0.01, p_bad_to_good=0.5, loss_bad=0.9, loss_good=0.0),
        PeriodicLoss(lost=2, direction="host_to_drive"),
        Blackout(from_s=0.7, duration_s=0.02),
        Delay(delay_us=0.5, frames=("sync", 0x181), nodes=(1, 2), until_s=3),
        Delay(delay_min_us=100, delay_max_us=400, reorder=True),
    )


def test_left_out_a_selection_means_all_pdos_both_ways() -> None:
    selection = load("[[loss]]\nprobability = 0.1").faults[0]
    assert all(selection.selects(way, can_id) for way in Direction for can_id in (0x181, 0x201, 0x57F))
    assert not any(selection.selects(IN, can_id) for can_id in (0x000, 0x080, 0x81, 0x581, 0x601, 0x701))


def test_an_empty_plan_has_no_faults() -> None:
    assert load("") == FaultPlan()


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.name)
def test_examples_load_and_survive_being_written(path: Path) -> None:
    plan = load_fault_plan(tomllib.loads(path.read_text()), str(path))
    assert plan.faults or plan.node_faults or plan.host_stalls or plan.signals or plan.outages
    assert load_fault_plan(plan.as_tables(), "written") == plan


def test_there_are_examples() -> None:
    assert {path.stem for path in EXAMPLES} >= {"demo", "bursts", "every_third", "jitter"}


@pytest.mark.parametrize(
    ("text", "key", "value", "expected", "remedy"),
    [
        ("[[loss]]\nprobabilty = 0.1", "loss[0].probabilty", 0.1, "probability, the nearest", "known here"),
        ("[[loss]]\nloss_percent = 2", "loss[0].loss_percent", 2, "probability", "write probability = 0.02"),
        ("[[loss]]\nprobability = 2", "loss[0].probability", 2.0, "from 0 to 1", ""),
        ("[[loss]]\nprobability = nan", "loss[0].probability", None, "a number", ""),
        ("[[loss]]\nprobability = true", "loss[0].probability", True, "a number", ""),
        ("[[loss]]", "loss[0].probability", MISSING, "a number", ""),
        ("[loss]\nprobability = 0.1", "loss", "a table", "an array of tables, each headed [[loss]]", ""),
        ("[[lost]]\nprobability = 0.1", "lost", None, "loss, the nearest known key", "known here: loss"),
        ("zzz = 1", "zzz", 1, "no such key", "known here: loss, burst"),
        ("[[delay]]\ndelay_ms = 0.3", "delay[0].delay_ms", 0.3, "delay_us (the unit", "write delay_us = 300"),
        ("[[delay]]\ndelay = 300", "delay[0].delay", 300, "delay_us (the unit", "write delay_us"),
        ("[[delay]]\ndelay_us = 1\nfrom_ms = 5", "delay[0].from_ms", 5, "from_s", "write from_s = 0.005"),
        ("[[delay]]\ndelay_us = -1", "delay[0].delay_us", -1, "from 0 to 10000000 us", ""),
        ("[[delay]]\ndelay_us = 1e300", "delay[0].delay_us", 1e300, "at most 1e+12", ""),
        ("[[delay]]\ndelay_us = 1\ndelay_max_us = 2", "delay[0].delay_max_us", 2, "nothing beside", ""),
        ("[[delay]]\ndelay_min_us = 1", "delay[0].delay_max_us", MISSING, "a number", ""),
        ("[[delay]]\ndelay_min_us = 5\ndelay_max_us = 2", "delay[0].delay_max_us", 2, "delay_min_us = 5", ""),
        ("[[delay]]\nreorder = true", "delay[0].delay_us", MISSING, "a delay, or delay_min_us", ""),
        ("[[delay]]\ndelay_us = 1\nreorder = 1", "delay[0].reorder", 1, "true or false", ""),
        ("[[periodic_loss]]\nlost = 0", "periodic_loss[0].lost", 0, ">= 1", ""),
        ("[[periodic_loss]]\nlost = 1.5", "periodic_loss[0].lost", 1.5, "a whole number", ""),
        ("[[blackout]]\nfrom_s = 1", "blackout[0].duration_s", MISSING, "a duration, or until_s, or", ""),
        ("[[blackout]]\nduration_s = 0", "blackout[0].duration_s", 0, "a time > 0", ""),
        ("[[blackout]]\nduration_s = 1\nuntil_s = 2", "blackout[0].until_s", 2, "nothing beside", ""),
        ("[[blackout]]\nduration_ms = 20", "blackout[0].duration_ms", 20, "duration_s", "duration_s = 0.02"),
        ("[[blackout]]\ncount = 0", "blackout[0].count", 0, ">= 1", ""),
        ("[[blackout]]\nfrom_s = 2\nuntil_s = 1", "blackout[0].until_s", 1, "after from_s = 2", ""),
        ("[[blackout]]\ncount = 1\nfrom_s = -1", "blackout[0].from_s", -1, ">= 0", ""),
    ],
)
def test_a_plan_that_cannot_be_used_is_refused_with_reasons(
    text: str, key: str, value: Any, expected: str, remedy: str
) -> None:
    error = error_of(text)
    assert error.source == "plan.toml"
    assert error.key == key
    assert value is None or error.value == value
    assert expected in error.expected
    assert remedy in error.remedy
    assert "\n" not in str(error)


@pytest.mark.parametrize(
    ("line", "key", "expected"),
    [
        ('direction = "up"', "direction", "one of both, host_to_drive, drive_to_host"),
        ("direction = [1]", "direction", "one of both"),
        ('frames = "pdo"', "frames", "a list"),
        ("frames = []", "frames", "at least one"),
        ('frames = ["pdos"]', "frames", '"pdo", the nearest'),
        ("frames = [1.5]", "frames", "a class of frames or a COB-ID"),
        ("frames = [0x20000000]", "frames", "a COB-ID from 0 to 0x1fffffff"),
        ("nodes = [128]", "nodes", "from 1 to 127"),
        ("nodes = [true]", "nodes", "a list of node ids"),
        ("nodes = 1", "nodes", "a list of node ids"),
        ("until_s = inf", "until_s", "a number"),
        ('side = "bus"', "side", "one of host, drive"),
        ("side = 1", "side", "one of host, drive"),
    ],
)
def test_a_selection_that_cannot_be_used_is_refused(line: str, key: str, expected: str) -> None:
    error = error_of(f"[[loss]]\nprobability = 0.1\n{line}")
    assert error.key == f"loss[0].{key}"
    assert expected in error.expected


def test_all_errors_of_a_file_are_found_at_once() -> None:
    raw = tomllib.loads(
        "[[loss]]\nprobability = 0.1\n[[loss]]\nprobability = 3\n[[delay]]\ndelay_ms = 1\nfoo = 2\n[[los]]"
    )
    plan, errors = read_fault_plan(raw, "bench.toml", "faults")
    keys = ["faults.loss[1].probability", "faults.delay[0].delay_ms", "faults.delay[0].foo", "faults.los"]
    assert [error.key for error in errors] == keys
    assert plan.faults == (Loss(probability=0.1),)
    with pytest.raises(BadInput, match=r"bench.toml: faults.loss\[1\].probability: found 3,"):
        load_fault_plan(raw, "bench.toml", "faults")


@pytest.mark.parametrize(
    ("can_id", "extended", "node"),
    [
        (0x000, False, 0),
        (0x080, False, 0),
        (0x085, False, 5),
        (0x100, False, 0),
        (0x201, False, 1),
        (0x77F, False, 127),
        (0x7E5, False, 0),
        (0x181, True, 0),
    ],
)
def test_the_node_of_a_frame(can_id: int, extended: bool, node: int) -> None:
    assert node_of(can_id, extended) == node


@pytest.mark.parametrize("side", ["host", "drive", None])
def test_the_side_is_kept_as_it_was_named(side: str | None) -> None:
    line = "" if side is None else f'side = "{side}"'
    plan = load(f"[[loss]]\nprobability = 0.1\n{line}")
    assert plan.faults[0].side == side
    written = plan.as_tables()
    assert written["loss"][0].get("side") == side
    assert load_fault_plan(written, "written") == plan
