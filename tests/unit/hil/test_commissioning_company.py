"""Commissioning of drives with several effects at once, where each alone does no harm."""

from dataclasses import replace
from pathlib import Path

from servobench.design.mechanism import Coupling, Mechanism
from servobench.hil.commissioning.findings import StepOutcome, StepVerdict
from servobench.virtual_bus.drive.encoder import Encoder, SineErrors
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from servobench.virtual_bus.drive.unknown_drive import unknown_drive
from tests.commissioning import unknown_world

SEED = 7


def step(drive: DriveParameters, name: str, folder: Path, without: tuple[str, ...]) -> StepOutcome:
    """Return that step of a commissioning of the drive, which is done."""
    _truth, result, _spy = unknown_world(SEED, folder, drive=drive, last_step=name, without=without)
    record = result.records[-1]
    assert (record.name, record.verdict) == (name, StepVerdict.DONE), record.reason
    return record.outcome


def test_a_stop_ends_where_a_soft_shaft_swings_back_and_not_when_the_brake_has_closed(tmp_path: Path) -> None:
    """A fine encoder with errors tells motion as long as the drive holds the shaft until its brake holds."""
    motor = unknown_drive(SEED)[1].motor
    half = 0.5 * motor.inertia_kg_m2
    soft = Mechanism(coupling=Coupling(half, half, 1e5 * half, 0.013))
    drive = DriveParameters(
        machine=replace(motor, mechanism=soft),
        encoder=Encoder(1024, SineErrors(0.01, -0.01, 0.01, 0.005)),
        brake_torque_nm=2.0 * motor.rated_torque_nm,
        brake_close_s=0.15,
        brake_waits=True,
    )
    outcome = step(drive, "stop_proof", tmp_path, ("turn",))
    assert outcome.faults == []
    assert outcome.figures["stop_s"] < 1.5 * outcome.figures["computed_s"] + 0.02


def test_a_drive_that_samples_later_than_the_sync_loses_no_reading(tmp_path: Path) -> None:
    """It answers after the next command was sent, and shows commands that came behind the SYNC."""
    drive = DriveParameters(sync_phase_us=250.0)
    without = ("turn", "stop_proof", "mechanics", "torque_constant", "voltage_constant", "response")
    outcome = step(drive, "delays", tmp_path, without)
    assert outcome.figures["readings_lost"] == 0
    assert outcome.figures["current_bandwidth_hz"] is None
    assert 0.0 < outcome.figures["effect_delay_us"] < 150.0, "some 300 us, 250 of them before the sample"
    assert "give or take" in outcome.lines[1]
