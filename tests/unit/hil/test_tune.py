"""``hil tune`` of a speed loop on simulated drives whose gains are objects: what it reads, computes, writes
and leaves, by the dictionary of the drive, and by a node that looks at the shaft.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import pytest

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.objects import RemoteObjects
from servobench.drivers.cia402.drive_setup import read_identity
from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.drivers.vendors.families import quirks_for
from servobench.drivers.wire.adapters import parse_bus_spec
from servobench.hil.commissioning.steps_tune import TuneRequest, tune_limits, tune_steps
from servobench.hil.execution.world import WorldPlan, open_world
from servobench.hil.restoring.journal import read_journal
from servobench.hil.restoring.restore import restore
from servobench.hil.write_lists import RESTORE
from servobench.virtual_bus.device.object_dictionary import ObjectDictionary
from servobench.virtual_bus.drive.data_sheet import tell_motor
from servobench.virtual_bus.drive.loop_gains import LOOP_GAINS
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from tests.motors import LING
from tests.unit.hil.test_manual_motion import Moved, memory, moved
from tests.unit.virtual_bus.test_loop_gains import epos4

RUBBING: Final = replace(LING, coulomb_friction_nm=0.1)
SPEED_P, SPEED_I = (LOOP_GAINS, 4), (LOOP_GAINS, 5)


def drive(**how: Any) -> SimulatedServo:
    return SimulatedServo(1, RUBBING, DriveParameters(gain_objects=True, **how))


def tuned(
    out: Path,
    servo: SimulatedServo | None = None,
    *,
    store: bool = False,
    also: Sequence[str] = (),
    **how: Any,
) -> Moved:
    return moved(
        out,
        lambda: tune_steps(TuneRequest(**how)),
        tune_limits(600.0, 50.0, 40.0),
        purpose="tune",
        servo=servo or drive(),
        store=store,
        also=also,
    )


def lines(done: Moved) -> str:
    return "\n".join(done.result.records[-1].outcome.lines)


def figures(done: Moved) -> dict[str, Any]:
    return done.result.records[-1].outcome.figures


def test_gains_are_told_in_si_units_and_nothing_is_written(tmp_path: Path) -> None:
    """A speed loop of 30 Hz: P = 2 pi 30 J, I = P 2 pi 30 / 4."""
    done = tuned(tmp_path)
    assert done.result.exit_status == 0, done.told
    assert done.after == done.before
    held = figures(done)["held"]
    assert held["p"] == pytest.approx(math.tau * 30.0 * LING.inertia_kg_m2, rel=1e-5)
    assert "2121h:04, proportional gain: " in lines(done)
    assert " N m s/rad" in lines(done)
    assert not any(done.tap.enabled), "nothing turns for that"


def test_a_bandwidth_is_reached_by_what_the_drive_then_holds_and_hil_restore_undoes_it(
    tmp_path: Path,
) -> None:
    servo = drive()
    done = tuned(tmp_path, servo, bandwidth_hz=60.0, apply=True)
    assert done.result.exit_status == 0, done.told
    changed = {key for key, held in done.before.items() if done.after[key] != held}
    assert changed == {SPEED_P, SPEED_I}
    assert figures(done)["as it is"]["bandwidth_hz"] < 60.0
    assert figures(done)["with these"]["bandwidth_hz"] == pytest.approx(60.0, rel=1e-4)
    inner = servo.drive.firmware.inner
    omega = math.tau * 60.0
    s = 1j * omega
    loop = (inner.speed_gain + inner.speed_integral_gain / s) / (LING.inertia_kg_m2 * s)
    assert abs(loop / (1.0 + loop)) == pytest.approx(math.sqrt(0.5), rel=0.05)
    done.tap.assert_rest()
    with open_world(WorldPlan(parse_bus_spec("simulated"), 1_000_000), [servo]) as world:
        world.clock.sleep_until(Instant(100 * NS_PER_MS))
        network = CanopenNetwork(world.link, world.clock, writes=RESTORE)
        read_identity(RemoteObjects(network, 1))
        assert restore(network, read_journal(tmp_path / "journal.jsonl")).complete
    assert memory(servo) == done.before


def test_a_demand_that_cannot_be_met_writes_nothing(tmp_path: Path) -> None:
    done = tuned(tmp_path, phase_margin_deg=60.0, apply=True)
    assert done.result.exit_status == 1
    assert done.after == done.before
    assert any("nothing is known" in text for text in done.told)


def test_gains_that_make_the_shaft_scatter_are_taken_back(tmp_path: Path) -> None:
    """At 400 Hz a loop that is reckoned without its delay swings: the current loops have 800 Hz at best."""
    servo = drive(inner_rate_hz=4000)
    done = tuned(tmp_path, servo, bandwidth_hz=400.0, apply=True)
    assert done.result.exit_status == 1, done.told
    assert done.after == done.before
    assert any("the gains are taken back" in text for text in done.told)
    done.tap.assert_rest()


def test_a_drive_whose_maker_tells_no_gains_is_left_alone(tmp_path: Path) -> None:
    done = tuned(tmp_path, SimulatedServo(1, RUBBING), bandwidth_hz=40.0)
    assert "the drive has no 2121h:04" in done.result.ended_by
    assert done.after == done.before
    assert not any(done.tap.enabled)


def test_of_a_maker_gains_are_written_in_the_maker_s_units(tmp_path: Path) -> None:
    """EPOS4: uA s/rad and uA/rad, an ampere being worth 3001h:5, in uN m."""

    def vendor(dictionary: ObjectDictionary) -> None:
        epos4(dictionary)
        tell_motor(dictionary, RUBBING)

    makers = quirks_for(0xFB, 0, "EPOS4")
    servo = SimulatedServo(1, RUBBING, DriveParameters(gain_objects=True, makers_units=makers), vendor=vendor)
    done = tuned(tmp_path, servo, bandwidth_hz=50.0, apply=True, also=["30A2h:01", "30A2h:02"])
    assert done.result.exit_status == 0, done.told
    changed = {key for key, held in done.before.items() if done.after[key] != held}
    assert changed == {(0x30A2, 1), (0x30A2, 2)}
    inner, per_ampere_nm = servo.drive.firmware.inner, 1e-6 * int(done.before[0x3001, 5])
    assert int(done.after[0x30A2, 1]) == pytest.approx(inner.speed_gain / per_ampere_nm * 1e6, rel=1e-5)
    assert figures(done)["with these"]["bandwidth_hz"] == pytest.approx(50.0, rel=1e-3)
    assert "the loop is computed at 2500 Hz: 600 us of delay" in lines(done)
