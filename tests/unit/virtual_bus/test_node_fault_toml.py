"""The further kinds of faults as TOML: what they mean, and what is said of those that cannot be used."""

import json
import tomllib
from pathlib import Path
from typing import Any

import pytest

from servobench.drivers.errors import MISSING, BadInput
from servobench.virtual_bus.faults.fault_plan import FaultPlan, load_fault_plan
from servobench.virtual_bus.faults.kinds.bus_off import BusOff
from servobench.virtual_bus.faults.kinds.clock_drift import ClockDrift
from servobench.virtual_bus.faults.kinds.clock_step import ClockStep
from servobench.virtual_bus.faults.kinds.corruption import Corruption
from servobench.virtual_bus.faults.kinds.drive_fault import DriveFault
from servobench.virtual_bus.faults.kinds.duplicate import Duplicate
from servobench.virtual_bus.faults.kinds.measured_delay import MeasuredDelay
from servobench.virtual_bus.faults.kinds.reorder import Reorder
from servobench.virtual_bus.faults.kinds.silence import Silence
from servobench.virtual_bus.faults.kinds.slow_drive import SlowDrive
from tests.fates import keys
from tests.unit.virtual_bus.test_fault_plan_toml import error_of, load

PLAN = """
    [[measured_delay]]
    edges_us = [0, 10, 20.5]
    counts = [3, 4]
    [[reorder]]
    probability = 0.1
    held_us = 7
    [[duplicate]]
    probability = 0.2
    later_us = 1.5
    [[corruption]]
    probability = 0.3
    [[corruption]]
    probability = 0.3
    effect = "data"
    [[silence]]
    nodes = [1, 2]
    at_s = 0.5
    duration_s = 0.25
    [[bus_off]]
    probability_per_s = 0.1
    from_s = 1
    until_s = 3
    [[bus_off]]
    at_s = 2
    recover_after_s = 0.5
    [[drive_fault]]
    fault = "under_voltage"
    at_s = 1
    [[drive_fault]]
    fault = "encoder_loss"
    at_s = 1
    [[clock_step]]
    at_s = 4
    step_us = -3
    [[clock_drift]]
    drift_ppm = -2.5
    until_s = 1
    [[slow_drive]]
    sdo_delay_us = 4
    tpdo_delay_min_us = 1
    tpdo_delay_max_us = 2
    boot_s = 0.5
"""


def test_every_further_kind_is_read_and_survives_being_written() -> None:
    plan = load(PLAN)
    assert plan.faults == (
        MeasuredDelay(edges_us=(0, 10, 20.5), counts=(3, 4)),
        Reorder(probability=0.1, held_us=7),
        Duplicate(probability=0.2, later_us=1.5),
        Corruption(probability=0.3),
        Corruption(probability=0.3, effect="data"),
    )
    window = keys(probability_per_s=0.1, from_s=1, until_s=3)
    assert plan.node_faults == (
        Silence(nodes=(1, 2), at_s=0.5, duration_s=0.25),
        BusOff(**window),
        BusOff(at_s=2, recover_after_s=0.5),
        DriveFault(at_s=1, fault="under_voltage"),
        DriveFault(
            at_s=1,
            fault="encoder_loss",
            detected_after_ms=2,
            duration_s=0.1,
        ),
        ClockStep(at_s=4, step_us=-3),
        ClockDrift(drift_ppm=-2.5, until_s=1),
        SlowDrive(
            sdo_delay_us=4,
            tpdo_delay_min_us=1,
            tpdo_delay_max_us=2,
            boot_s=0.5,
        ),
    )
    assert load_fault_plan(plan.as_tables(), "written") == plan


@pytest.mark.parametrize(
    ("text", "key", "value", "expected"),
    [
        (
            "[[measured_delay]]\ncounts = [1]",
            "measured_delay[0].edges_us",
            MISSING,
            "a list of times, or file",
        ),
        (
            "[[measured_delay]]\nedges_us = [0, 1]\ncounts = [1, 2]",
            "measured_delay[0].counts",
            None,
            "1 counts",
        ),
        (
            "[[measured_delay]]\nedges_us = [0, 0]\ncounts = [1]",
            "measured_delay[0].edges_us",
            None,
            "each above",
        ),
        (
            "[[measured_delay]]\nedges_us = [-1, 0]\ncounts = [1]",
            "measured_delay[0].edges_us",
            None,
            "from 0 to",
        ),
        (
            "[[measured_delay]]\nedges_us = [0, 1]\ncounts = [0]",
            "measured_delay[0].counts",
            None,
            "not all of",
        ),
        ("[[measured_delay]]\nedges_us = [0, 1]\ncounts = [-1]", "measured_delay[0].counts", None, ">= 0"),
        (
            "[[measured_delay]]\nedges_us = [0, inf]\ncounts = [1]",
            "measured_delay[0].edges_us",
            None,
            "numbers",
        ),
        (
            "[[measured_delay]]\nfile = 'none.csv'",
            "measured_delay[0].file",
            None,
            "an existing delay histogram",
        ),
        (
            "[[measured_delay]]\nfile = 'a'\ncounts = [1]",
            "measured_delay[0].counts",
            None,
            "nothing beside file",
        ),
        ("[[reorder]]\nprobability = 0.1", "reorder[0].held_us", MISSING, "held_min_us and held_max_us"),
        ("[[reorder]]\nprobability = 0.1\nheld_us = 0", "reorder[0].held_us", 0, "a time > 0"),
        ("[[reorder]]\nprobability = 0.1\nheld_ms = 1", "reorder[0].held_ms", 1, "held_us (the unit"),
        ("[[duplicate]]\nprobability = 2", "duplicate[0].probability", 2, "from 0 to 1"),
        ("[[duplicate]]\nprobability = 1\nlater_us = -1", "duplicate[0].later_us", -1, "a time from 0"),
        (
            "[[corruption]]\nprobability = 1\neffect = 'x'",
            "corruption[0].effect",
            "x",
            "one of error_frame, lost",
        ),
        ("[[silence]]\nat_s = 1", "silence[0].duration_s", MISSING, "a number"),
        ("[[silence]]\nat_s = 1\nduration_s = 0", "silence[0].duration_s", 0, "a time > 0"),
        (
            "[[silence]]\nduration_s = 1",
            "silence[0].probability_per_s",
            MISSING,
            "or at_s or every_s instead",
        ),
        (
            "[[silence]]\nduration_s = 1\nat_s = 1\nfrom_s = 1",
            "silence[0].from_s",
            1,
            "no window beside at_s",
        ),
        ("[[silence]]\nduration_s = 1\nat_ms = 1", "silence[0].at_ms", 1, "at_s (the unit"),
        ("[[silence]]\nduration_s = 1\nat_s = 1\nnodes = [0]", "silence[0].nodes", 0, "from 1 to 127"),
        ("[[bus_off]]\nat_s = 1\nrecover_after_s = 0", "bus_off[0].recover_after_s", 0, "a time > 0"),
        ("[[bus_off]]\nprobability_per_s = 1", "bus_off[0].probability_per_s", 1, "from 0 to below 1"),
        (
            "[[bus_off]]\nprobability_per_s = 0.1\nat_s = 1",
            "bus_off[0].probability_per_s",
            0.1,
            "no at_s beside",
        ),
        (
            "[[drive_fault]]\nat_s = 1",
            "drive_fault[0].fault",
            MISSING,
            "one of over_current, over_temperature",
        ),
        (
            "[[drive_fault]]\nat_s = 1\nfault = 'over_current'\ndetected_after_ms = 1",
            "drive_fault[0].detected_after_ms",
            1,
            "nothing unless",
        ),
        (
            "[[drive_fault]]\nat_s = 1\nfault = 'encoder_loss'\nduration_s = 0.001",
            "drive_fault[0].duration_s",
            0.001,
            "at least detected_after_ms = 2",
        ),
        ("[[clock_step]]\nat_s = 1", "clock_step[0].step_us", MISSING, "a step, or step_min_us"),
        (
            "[[clock_step]]\nat_s = 1\nstep_min_us = 1\nstep_max_us = 0",
            "clock_step[0].step_max_us",
            0,
            "from step_min_us = 1",
        ),
        ("[[clock_drift]]\ndrift_ppm = 1e6", "clock_drift[0].drift_ppm", 1e6, "from -10000 to 10000"),
        ("[[clock_drift]]\ndrift_ppm = 1\nat_s = 1", "clock_drift[0].at_s", 1, "no such key"),
        ("[[slow_drive]]", "slow_drive[0].sdo_delay_us", MISSING, "sdo_delay_us, tpdo_delay_us or boot_s"),
        ("[[slow_drive]]\nboot_s = -1", "slow_drive[0].boot_s", -1, "a time from 0 to 600"),
        ("[[slow_drive]]\nboot_ms = 20", "slow_drive[0].boot_ms", 20, "boot_s (the unit"),
        (
            "[[slow_drive]]\nsdo_delay_min_us = 5\nsdo_delay_max_us = 2",
            "slow_drive[0].sdo_delay_max_us",
            2,
            "from sdo_delay_min_us = 5",
        ),
        ("[[slow_drives]]\nboot_s = 1", "slow_drives", None, "slow_drive, the nearest"),
    ],
)
def test_what_cannot_be_used_is_refused_with_reasons(text: str, key: str, value: Any, expected: str) -> None:
    error = error_of(text)
    assert error.source == "plan.toml"
    assert error.key == key
    assert value is None or error.value == value
    assert expected in error.expected
    assert "\n" not in str(error)


def with_file(folder: Path, name: str, text: str) -> FaultPlan:
    (folder / name).write_text(text)
    plan = folder / "plan.toml"
    return load_fault_plan(tomllib.loads(f"[[measured_delay]]\nfile = '{name}'"), str(plan))


HISTOGRAM = MeasuredDelay(edges_us=(0, 1, 5), counts=(2, 3))


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("a.csv", "0,1,2\n1,5,3\n"),
        ("a.csv", "# measured\nfrom_us,to_us,count\n\n0, 1.0, 2\n1, 5, 3"),
        ("a.json", json.dumps({"edges_us": [0, 1, 5], "counts": [2, 3]})),
        ("a.json", json.dumps({"frames": 5, "delay_histogram": {"edges_us": [0, 1, 5], "counts": [2, 3]}})),
    ],
)
def test_a_histogram_may_stand_in_a_file_beside_the_plan(tmp_path: Path, name: str, text: str) -> None:
    assert with_file(tmp_path, name, text) == FaultPlan((HISTOGRAM,))


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("a.csv", "0,1,2\n2,5,3\n", "a bar from 1 us, where the last one ends"),
        ("a.csv", "0,1,2\nx,5,3\n", "from_us,to_us,count"),
        ("a.csv", "0,1,2.5\n", "from_us,to_us,count"),
        ("a.csv", "", "at least two times"),
        ("a.json", "{", "a histogram"),
        ("a.json", "[1]", "a histogram"),
        ("a.json", '{"edges_us": [0, "x"], "counts": [1]}', "numbers"),
    ],
)
def test_a_file_that_is_no_histogram_is_refused(tmp_path: Path, name: str, text: str, expected: str) -> None:
    with pytest.raises(BadInput) as caught:
        with_file(tmp_path, name, text)
    assert expected in caught.value.expected
    assert caught.value.key.startswith("measured_delay[0].")
