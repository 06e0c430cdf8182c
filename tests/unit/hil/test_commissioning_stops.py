"""Drives whose stop is not as it should be: mended before they turn fast, or named before they turn."""

from collections.abc import Callable
from pathlib import Path

import pytest

from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.wire.adapters import parse_bus_spec
from servobench.hil.commissioning.commission import all_steps, commission
from servobench.hil.commissioning.dialog import Dialog, EmergencyStop
from servobench.hil.commissioning.findings import StepRecord
from servobench.hil.commissioning.report import Commissioned
from servobench.hil.commissioning.request import CommissionRequest, Nameplate
from servobench.hil.commissioning.sequence import Step
from servobench.hil.configuration.drive_file import load_drive_file
from servobench.hil.execution.world import WorldPlan, open_world
from servobench.virtual_bus.device.object_dictionary import Access, Variable
from servobench.virtual_bus.drive.lacks import take_away
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.drive.unknown_drive import unknown_drive
from tests.draws import few_of
from tests.scenario.test_commissioning_host_gaps import Halting, Standstill

pytestmark = pytest.mark.long

SEED = 3
LIMIT_RAD_S = 167.6
"""Of the motions, for this drive."""
RESTING_RAD_S = 0.01

Trait = Callable[[SimulatedServo], None]


def deceleration(
    value: int | None = None, *, index: int = Object.QUICK_STOP_DECELERATION, fixed: bool = False
) -> Trait:
    """A ramp that holds ``value``, its own if None; ``fixed``: read-only."""

    def change(servo: SimulatedServo) -> None:
        variable = servo.dictionary.variable(index)
        variable.default = variable.value = variable.low = value
        if fixed:
            variable.access = Access.READ_ONLY

    return change


def fixed_option(servo: SimulatedServo) -> None:
    """605Ah cannot be written."""
    servo.dictionary.variable(Object.QUICK_STOP_OPTION).access = Access.READ_ONLY


def without(*lacks: str) -> Trait:
    return lambda servo: take_away(servo.dictionary, lacks)


def odd_unit(servo: SimulatedServo) -> None:
    """One unit of 6085h is a thousandth of what the drive's objects tell."""
    motion = servo.drive.axis.motion
    told = motion.quick_stop
    ruling = Variable(told.index, told.subindex, told.name, told.data_type, default=told.value / 1000.0)
    inner = told.on_write

    def written(new: int) -> None:
        ruling.value = new / 1000.0
        if inner is not None:
            inner(new)

    told.on_write, motion.quick_stop = written, ruling


def tried(folder: Path, *traits: Trait) -> tuple[Commissioned, Standstill]:
    """Commission up to the slow stop."""
    servo, truth = unknown_drive(SEED)
    for trait in traits:
        trait(servo)
    plate = Nameplate.model_validate(truth.nameplate)
    request = CommissionRequest("simulated", 1, folder, nameplate=plate, period_us=2000)
    with open_world(WorldPlan(parse_bus_spec("simulated"), 1_000_000, False, None, SEED), [servo]) as world:
        watching = Standstill(world, servo, {})

        def steps() -> list[Step]:
            names = [step.name for step in all_steps()]
            last = names.index("stop_proof") + 1
            return [Halting(step, watching.begin) for step in all_steps()[:last]]

        return commission(request, world, Dialog(print), EmergencyStop(), steps=steps), watching


def record(result: Commissioned, name: str) -> StepRecord:
    return next(each for each in result.records if each.name == name)


def fastest(watching: Standstill) -> float:
    return max(speed for speed, _ in watching.fastest.values())


MENDED = ((deceleration(0),), (deceleration(1),))


@pytest.mark.parametrize(
    ("traits", "option"),
    few_of(
        [
            (MENDED[0], 2),
            ((deceleration(0, fixed=True),), 3),
            ((without("605A"),), 2),
            ((deceleration(0, fixed=True), deceleration(0, index=Object.PROFILE_DECELERATION)), 3),
            ((without("6085"),), 2),
            ((), 2),
            (MENDED[1], 2),
            ((fixed_option,), 2),
        ],
        3,
    ),
)
def test_a_drive_that_can_be_made_to_stop_does(
    tmp_path: Path, traits: tuple[Trait, ...], option: int
) -> None:
    result, watching = tried(tmp_path, *traits)
    assert result.passed, [(each.name, each.reason) for each in result.records]
    assert record(result, "stop").outcome.figures["option"] == option
    proof = record(result, "stop_proof").outcome.figures
    assert proof["stop_at_limit_s"] < 2.0
    assert fastest(watching) < 0.3 * LIMIT_RAD_S, "nothing turned fast before"
    left = load_drive_file(tmp_path / "drive.toml")
    assert left.stop.option == option, "a bench stops it the same way"
    written = {each.index for each in left.object}
    assert (Object.QUICK_STOP_DECELERATION in written) == (traits in MENDED)


@pytest.mark.parametrize(
    ("traits", "named"),
    [
        ((deceleration(0, fixed=True), fixed_option), "6085h is 0"),
        ((deceleration(1, fixed=True), fixed_option), "6085h is 1, "),
    ],
    ids=["0", "too slow"],
)
def test_a_drive_that_cannot_stop_is_named_before_it_turns(
    tmp_path: Path, traits: tuple[Trait, ...], named: str
) -> None:
    result, watching = tried(tmp_path, *traits)
    assert result.error is not None
    last = result.records[-1]
    assert last.name == "stop"
    assert named in last.reason
    assert "605Ah" in last.reason
    assert fastest(watching) < RESTING_RAD_S
    assert result.left.restoration is not None
    assert result.left.restoration.complete


def test_a_unit_that_is_told_wrong_is_found_by_a_slow_stop_and_mended(tmp_path: Path) -> None:
    result, watching = tried(tmp_path, odd_unit)
    assert result.passed, [(each.name, each.reason) for each in result.records]
    proof = record(result, "stop_proof")
    assert any(fault.startswith("acceleration unit") for fault in proof.outcome.faults)
    assert proof.outcome.figures["stop_at_limit_s"] < 1.0
    found = result.findings.override.acceleration_rad_s2
    assert found is not None
    told = result.findings.told
    assert told is not None
    assert found == pytest.approx(told.acceleration_rad_s2 / 1000.0, rel=0.3)
    assert fastest(watching) < 0.3 * LIMIT_RAD_S
