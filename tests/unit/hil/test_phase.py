"""``hil phase`` on simulated drives that have to be told how their motor commutates: what it finds and keeps,
and what every way out leaves, by a node that looks at the shaft itself.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import pytest
from typer.testing import CliRunner

from servobench.design.motor import Commutation, PmsmParameters
from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.nmt_states import NmtCommand
from servobench.drivers.canopen.objects import RemoteObjects
from servobench.drivers.cia402.drive_setup import read_identity
from servobench.drivers.errors import BadInput, PeerFault
from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.drivers.wire.adapters import parse_bus_spec
from servobench.hil.cli import app
from servobench.hil.commissioning.steps_phase import phase_limits, phase_steps
from servobench.hil.execution.world import WorldPlan, open_world
from servobench.hil.restoring.journal import read_journal
from servobench.hil.restoring.restore import restore
from servobench.hil.write_lists import RESTORE
from servobench.virtual_bus.drive.commutation import COMMUTATION
from servobench.virtual_bus.drive.servo import SimulatedServo
from tests.motors import LING
from tests.unit.hil.test_manual_motion import WAYS, Moved, memory, moved

RUBBING: Final = replace(LING, coulomb_friction_nm=0.1)
SETTINGS: Final = {(COMMUTATION, sub) for sub in (1, 2, 3)}


def drive(motor: PmsmParameters = RUBBING, **true: Any) -> SimulatedServo:
    return SimulatedServo(1, replace(motor, commutation=Commutation(**true)))


def phased(
    out: Path, servo: SimulatedServo | None = None, *, apply: bool = True, turns: float = 1.0, **how: Any
) -> Moved:
    return moved(
        out,
        lambda: phase_steps(apply),
        phase_limits(30.0, turns),
        purpose="phase",
        servo=servo or drive(),
        **how,
    )


def changed(done: Moved) -> set[tuple[int, int]]:
    return {key for key, held in done.before.items() if done.after[key] != held}


def figures(done: Moved) -> dict[str, Any]:
    return done.result.records[-1].outcome.figures


def undone(out: Path, servo: SimulatedServo) -> dict[tuple[int, int], bytes]:
    """What the drive holds after ``hil restore``."""
    with open_world(WorldPlan(parse_bus_spec("simulated"), 1_000_000), [servo]) as world:
        world.clock.sleep_until(Instant(100 * NS_PER_MS))
        network = CanopenNetwork(world.link, world.clock, writes=RESTORE)
        read_identity(RemoteObjects(network, 1))
        contents = read_journal(out / "journal.jsonl")
        assert not contents.restored
        assert restore(network, contents).complete
    return memory(servo)


def after_reset(servo: SimulatedServo) -> dict[tuple[int, int], bytes]:
    """What the drive holds when it has come up again."""
    with open_world(WorldPlan(parse_bus_spec("simulated"), 1_000_000), [servo]) as world:
        network = CanopenNetwork(world.link, world.clock)
        network.command(NmtCommand.RESET_NODE, 1)
        network.pump(Instant(world.clock.now() + 500 * NS_PER_MS))
    return memory(servo)


def test_what_is_found_is_kept_proved_stored_and_undone_to_the_byte(tmp_path: Path) -> None:
    servo = drive(offset_rad=1.9, lines_swapped=True, pole_pairs_set=3)
    done = phased(tmp_path, servo, store=True)
    assert done.result.exit_status == 0, done.told
    inner = servo.drive.firmware.inner
    assert (inner.lines_mirrored, inner.commutation_pole_pairs) == (0, 4.0)
    ahead_rad = math.remainder(inner.commutation_ahead_rad, math.tau)
    assert math.degrees(ahead_rad) == pytest.approx(0.0, abs=1.0)
    assert changed(done) == SETTINGS
    assert figures(done)["pole_pairs"] == 4
    done.tap.assert_rest()
    assert max(done.tap.turns) - min(done.tap.turns) < 1.0
    assert any("The settings were stored in the drive (1010h)" in text for text in done.told)
    assert after_reset(servo) == done.after
    assert undone(tmp_path, servo) == done.before


def test_without_being_asked_to_keep_it_everything_is_put_back(tmp_path: Path) -> None:
    servo = drive(offset_rad=math.radians(20.0))
    done = phased(tmp_path, servo, apply=False)
    assert done.result.exit_status == 0, done.told
    assert done.after == done.before
    assert read_journal(tmp_path / "journal.jsonl").restored
    lines = "\n".join(done.result.records[-1].outcome.lines)
    assert "the drive's angle is -20.0 electrical degrees beyond the rotor's" in lines
    assert "4 pole pairs; the rotor's electrical angle rises with the encoder's" in lines
    done.tap.assert_rest()


def test_a_drive_without_the_mode_is_left_alone(tmp_path: Path) -> None:
    done = phased(tmp_path, SimulatedServo(1, LING))
    assert "not for this maker: the drive has no mode 11" in done.result.ended_by
    assert not any(done.tap.enabled)
    assert done.result.exit_status == PeerFault.exit_status
    assert done.after == done.before


def test_of_a_maker_whose_angle_no_document_names_it_tells_and_writes_nothing(tmp_path: Path) -> None:
    servo = drive(offset_rad=1.0, lines_swapped=True)
    servo.dictionary.conceal(COMMUTATION)
    done = phased(tmp_path, servo)
    assert done.result.exit_status == 0, done.told
    assert done.after == done.before
    assert (figures(done)["pole_pairs"], figures(done)["rises"]) == (4, False)
    assert any("nothing was written" in text for text in done.told)


@pytest.mark.parametrize(("way", "status", "why"), WAYS.values(), ids=WAYS)
def test_every_way_out_ends_at_rest_and_puts_everything_back(
    tmp_path: Path, way: Callable[..., Moved], status: int, why: str
) -> None:
    def motion(out: Path, **how: Any) -> Moved:
        return phased(out, drive(offset_rad=math.pi), **how)

    done = way(tmp_path, motion)
    assert why in done.result.ended_by
    if status:
        assert done.result.exit_status == status, done.told
    done.tap.assert_rest()
    assert 30.0 < max(map(abs, done.tap.rpm)) < 150.0, "a ramp would turn it faster and faster"
    assert sum(done.tap.enabled) < 1500, "ms: at once, not behind the sweep"
    assert done.after == done.before
    assert read_journal(tmp_path / "journal.jsonl").restored


def test_a_bus_that_is_lost_ends_at_rest_though_no_ramp_could_stop_this_motor(tmp_path: Path) -> None:
    servo = drive(offset_rad=math.pi)
    done = phased(tmp_path, servo, faults={"link_down": [{"at_s": 2.5, "duration_s": 1000.0}]})
    assert done.result.exit_status == 3
    done.tap.assert_rest()
    assert any(done.tap.enabled)
    assert max(map(abs, done.tap.rpm)) < 200.0
    assert f"hil restore {tmp_path / 'journal.jsonl'}" in "\n".join(done.told)
    assert undone(tmp_path, servo) == done.before


@pytest.mark.parametrize(
    ("drag_nm", "text"), [(4.0, "does not follow the field"), (0.38, "the rotor slips in the field")]
)
def test_a_rotor_that_is_held_or_dragged_is_not_taken_for_aligned(
    tmp_path: Path, drag_nm: float, text: str
) -> None:
    servo = drive()
    servo.drive.firmware.damage.drag_brake(drag_nm)
    done = phased(tmp_path, servo)
    assert done.result.exit_status == 1
    assert text in done.result.ended_by
    done.tap.assert_rest()
    assert done.after == done.before


def test_a_shaft_that_goes_farther_than_it_may_is_let_go(tmp_path: Path) -> None:
    done = phased(tmp_path, turns=0.2)
    assert done.result.exit_status == 1
    assert "the shaft turned by 0.2 turns" in done.result.ended_by
    done.tap.assert_rest()
    assert max(map(abs, done.tap.turns)) < 0.3
    assert done.after == done.before


def test_nothing_is_stored_that_is_not_kept() -> None:
    done = CliRunner().invoke(app, ["phase", "--bus", "hub:nobody", "--node", "1", "--store", "--yes"])
    assert done.exit_code == BadInput.exit_status
    assert "--store" in done.output
