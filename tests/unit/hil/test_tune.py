"""``hil tune`` of a speed loop on simulated drives whose gains are objects: what it reads, computes, writes
and leaves, by the dictionary of the drive, and by a node that looks at the shaft.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
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
from servobench.virtual_bus.drive.firmware import FirmwareParameters
from servobench.virtual_bus.drive.loop_gains import LOOP_GAINS
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from tests.draws import few_of
from tests.drive_loops import opened
from tests.motors import LING
from tests.tuned_drives import drawn, verdict
from tests.unit.hil.test_manual_motion import Moved, Tap, memory, moved
from tests.unit.virtual_bus.test_loop_gains import epos4

RUBBING: Final = replace(LING, coulomb_friction_nm=0.1)
SPEED_P, SPEED_I = (LOOP_GAINS, 4), (LOOP_GAINS, 5)
STOPPED_MS: Final = 50
"""From the end of an exercise by a quick stop until the shaft stands."""
STILL_MS: Final = 20
"""A shaft that swings is not still for so long."""


def drive(**how: Any) -> SimulatedServo:
    return SimulatedServo(1, RUBBING, DriveParameters(gain_objects=True, **how))


def tuned(
    out: Path,
    servo: SimulatedServo | None = None,
    *,
    store: bool = False,
    also: Sequence[str] = (),
    when: Callable[[Tap], bool] = lambda _tap: False,
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
        when=when,
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
    loop = opened(RUBBING, servo.drive.firmware.parameters, inner.speed_gain, inner.speed_integral_gain)
    assert loop.bandwidth_hz == pytest.approx(60.0, rel=0.05)
    told = figures(done)["measured with them"]
    assert told["bandwidth_hz"] == pytest.approx(loop.bandwidth_hz, rel=0.05)
    assert told["phase_margin_deg"] == pytest.approx(loop.phase_margin_deg, abs=2.0)
    done.tap.assert_rest()
    with open_world(WorldPlan(parse_bus_spec("simulated"), 1_000_000), [servo]) as world:
        world.clock.sleep_until(Instant(100 * NS_PER_MS))
        network = CanopenNetwork(world.link, world.clock, writes=RESTORE)
        read_identity(RemoteObjects(network, 1))
        assert restore(network, read_journal(tmp_path / "journal.jsonl")).complete
    assert memory(servo) == done.before


def test_a_phase_margin_is_kept_by_the_lag_that_the_loop_shows(tmp_path: Path) -> None:
    servo = drive()
    done = tuned(tmp_path, servo, phase_margin_deg=60.0, apply=True)
    assert done.result.exit_status == 0, done.told
    inner = servo.drive.firmware.inner
    loop = opened(RUBBING, servo.drive.firmware.parameters, inner.speed_gain, inner.speed_integral_gain)
    assert loop.phase_margin_deg == pytest.approx(60.0, abs=3.0)


def test_a_demand_that_cannot_be_met_writes_nothing(tmp_path: Path) -> None:
    done = tuned(tmp_path, bandwidth_hz=500.0, apply=True)
    assert done.result.exit_status == 1
    assert done.after == done.before
    assert any("a bandwidth of 500 Hz cannot be reached" in text for text in done.told)


def lying(out: Path, factor: float) -> Moved:
    """Tune a drive whose loop takes ``factor`` times the P that is written into it."""
    servo = drive()
    variable, inner = servo.dictionary.variable(*SPEED_P), servo.drive.firmware.inner

    def lie(_tap: Tap) -> bool:
        if variable.value != variable.default:
            inner.speed_gain = factor * variable.value
        return False

    return tuned(out, servo, bandwidth_hz=50.0, apply=True, when=lie)


@pytest.mark.parametrize("factor", [0.5, math.sqrt(2.0), 2.0])
def test_a_p_that_acts_as_another_one_is_found_out_and_taken_back(tmp_path: Path, factor: float) -> None:
    done = lying(tmp_path, factor)
    assert done.result.exit_status == 1, done.told
    assert done.after == done.before
    told = next(text for text in done.told if "the gains act as" in text)
    assert float(told.split("act as ")[1].split()[0]) == pytest.approx(factor, rel=0.1)
    done.tap.assert_rest()


@pytest.mark.parametrize("factor", [30.0, 60.0])
def test_a_shaft_that_swings_is_ended_within_100_ms(tmp_path: Path, factor: float) -> None:
    """The loop is unstable, and its torque goes from limit to limit from the first set-point on."""
    done = lying(tmp_path, factor)
    assert done.result.exit_status, done.told
    assert any("the shaft swings by" in text for text in done.told)
    assert done.after == done.before
    done.tap.assert_rest()
    moving = np.abs(np.array(done.tap.rpm)) > 1.0
    last = int(np.flatnonzero(moving)[-1])
    still = np.flatnonzero(np.convolve(moving[:last], np.ones(STILL_MS), "valid") == 0.0)
    assert last - (int(still[-1]) + STILL_MS) < 100 + STOPPED_MS


@pytest.mark.parametrize("seed", few_of(range(40), 6))
def test_a_drawn_drive_has_what_was_asked_for_or_keeps_its_gains(seed: int) -> None:
    text, wrong = verdict(drawn(seed))
    assert not wrong, text


def test_the_opened_loop_is_the_closed_form() -> None:
    """The witness: PI at 16 kHz, current loops of 800 Hz behind 1.5 periods, and a filter of 500 Hz."""
    tick_s, inertia = 1.0 / 16_000, LING.inertia_kg_m2
    proportional = math.tau * 60.0 * inertia
    integral = proportional * math.tau * 15.0
    loop = opened(LING, FirmwareParameters(), proportional, integral)
    omega = np.geomspace(10.0, 5000.0, 20_000)
    s = 1j * omega
    back = np.exp(-s * tick_s)
    current = math.tau * 800.0 * back**1.5 / s
    gain = tick_s / (tick_s + 1.0 / (math.tau * 500.0))
    speed = gain / (1.0 - (1.0 - gain) * back) * back**0.5 / (inertia * s + LING.viscous_friction_nm_s)
    around = (proportional + integral * tick_s * back / (1.0 - back)) * current / (1.0 + current) * speed
    crossing = int(np.flatnonzero(np.abs(around) >= 1.0)[-1])
    assert loop.crossover_hz == pytest.approx(omega[crossing] / math.tau, rel=0.005)
    margin = 180.0 + math.degrees(float(np.unwrap(np.angle(around))[crossing]))
    assert loop.phase_margin_deg == pytest.approx(margin, abs=0.5)
    together = int(np.flatnonzero(np.abs(around / (1.0 + around)) >= math.sqrt(0.5))[-1])
    assert loop.bandwidth_hz == pytest.approx(omega[together] / math.tau, rel=0.01)


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
    assert "inside the loop are " in lines(done)
