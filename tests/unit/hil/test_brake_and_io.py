"""``hil brake --test`` and ``hil io`` on simulated drives: brakes that hold, slip and stick; switches
that are swapped, inverted, bounce, or are not there.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.objects import RemoteObjects
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.errors import BadInput, PeerFault
from servobench.drivers.timebase import Instant
from servobench.drivers.wire.adapters import parse_bus_spec
from servobench.hil.cli import app
from servobench.hil.commissioning.steps_brake import brake_limits, brake_steps
from servobench.hil.execution.world import World, WorldPlan, open_world
from servobench.hil.inspecting.digital_io import (
    OutputRequest,
    Panel,
    SwitchTried,
    read_panel,
    set_outputs,
    try_switches,
)
from servobench.hil.restoring.journal import JournaledNetwork, read_journal
from servobench.hil.restoring.restore import restore
from servobench.hil.write_lists import IO, RESTORE
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from servobench.virtual_bus.frame import Frame
from tests.motors import LING
from tests.scenario.foreign_node import Act, put_on_the_bus
from tests.sdo_writes import SdoWrites, written
from tests.unit.hil.test_manual_motion import WAYS, Moved, Tap, moved

PERCENT = 50.0
"""1 N m of the motor's 2."""


def braked(**keys: Any) -> SimulatedServo:
    return SimulatedServo(1, LING, DriveParameters(brake_output=True, **keys))


def tried(out: Path, servo: SimulatedServo, **how: Any) -> Moved:
    return moved(out, lambda: brake_steps(1.0), brake_limits(PERCENT), purpose="brake", servo=servo, **how)


def test_a_sound_brake_holds_and_releases(tmp_path: Path) -> None:
    done = tried(tmp_path, braked(brake_open_s=0.04, brake_close_s=0.05, brake_waits=True))
    assert done.result.exit_status == 0, done.told
    done.tap.assert_rest()
    assert done.after == done.before
    slips = {each.name: each.value for each in done.result.records[-1].outcome.quantities}
    assert slips.keys() == {"slip forwards", "slip backwards"}
    assert max(slips.values()) < 0.1


def test_a_brake_that_is_too_weak_slips(tmp_path: Path) -> None:
    done = tried(tmp_path, braked(brake_torque_nm=0.9))
    assert done.result.exit_status == 1
    assert "the brake slips" in done.result.ended_by
    done.tap.assert_rest()
    assert max(done.tap.turns) - min(done.tap.turns) < 0.8
    assert done.after == done.before


def test_a_brake_that_gives_way_within_the_limits_slips_too(tmp_path: Path) -> None:
    done = tried(tmp_path, braked(brake_torque_nm=0.998))  # of 1 N m that pushes
    slip_deg = 360.0 * (max(done.tap.turns) - min(done.tap.turns))
    assert 1.0 < slip_deg < 150.0
    assert f"the brake slips: {int(slip_deg)}." in done.result.ended_by
    done.tap.assert_rest()


def test_a_brake_that_does_not_let_go_sticks(tmp_path: Path) -> None:
    servo = braked()
    servo.drive.firmware.damage.drag_brake(4.0)
    done = tried(tmp_path, servo)
    assert done.result.exit_status == 1
    assert "the brake sticks" in done.result.ended_by
    done.tap.assert_rest()
    assert done.after == done.before


@pytest.mark.parametrize(
    ("way", "when"),
    [("key", lambda tap: sum(tap.enabled) > 300), ("signal", lambda tap: abs(tap.rpm[-1]) > 20.0)],
    ids=["a key while it pushes", "a signal while it turns"],
)
def test_a_key_and_a_signal_end_at_rest_with_the_brake_left_to_the_drive(
    tmp_path: Path, way: str, when: Callable[[Tap], bool]
) -> None:
    end, status, why = WAYS[way]
    done = end(tmp_path, lambda out, **how: tried(out, braked(), when=when, **how))
    assert done.result.exit_status == status, done.told
    assert why in done.result.ended_by
    done.tap.assert_rest()
    assert done.after == done.before
    assert read_journal(tmp_path / "journal.jsonl").restored
    pushed_ms = sum(done.tap.enabled)
    assert pushed_ms < 1000 if way == "key" else pushed_ms > 3000, "1.8 s of each push"


def test_a_drive_without_a_brake_output_is_left_alone(tmp_path: Path) -> None:
    done = tried(tmp_path, SimulatedServo(1, LING))
    assert "no brake output" in done.result.ended_by
    assert not any(done.tap.enabled)
    assert done.result.exit_status == PeerFault.exit_status
    assert done.after == done.before


# ---- inputs and outputs -----------------------------------------------------------------------------------


@contextmanager
def on_the_bus(servo: SimulatedServo) -> Iterator[tuple[World, JournaledNetwork, RemoteObjects]]:
    with open_world(WorldPlan(parse_bus_spec("simulated"), 1_000_000), [servo]) as world:
        network = JournaledNetwork(world.link, world.clock, IO)
        world.clock.sleep_until(Instant(100_000_000))
        yield world, network, RemoteObjects(network, 1)


def test_the_panel_tells_what_the_drive_tells() -> None:
    servo = braked()
    servo.drive.machine.held = 0b10001 << 1 | 1 << 20
    with on_the_bus(servo) as (_, _, objects):
        panel = read_panel(objects)
    assert panel == Panel(0b10001 << 1 | 1 << 20, 1, 0)
    assert panel.lines() == [
        "input  0 negative limit switch  0",
        "input  1 positive limit switch  1",
        "input  2 home switch            0",
        "input  3 interlock              0",
        "input  5                        1",
        "input 20                        1",
        "output  0 set brake             1 by the drive",
    ]
    assert Panel(None, None, None).lines() == ["no digital inputs (60FDh)", "no digital outputs (60FEh)"]


def asked(out: Path, **levels: bool) -> OutputRequest:
    return OutputRequest(
        "simulated", 1_000_000, 1, out, {int(bit[1:]): level for bit, level in levels.items()}
    )


def test_outputs_are_set_one_after_the_other_and_given_back_by_one_journal(tmp_path: Path) -> None:
    class Heard(SdoWrites):
        def __init__(self) -> None:
            super().__init__()
            self.subs: list[int] = []

        def receive(self, frame: Frame, now: Instant) -> Sequence[Frame]:
            if (key := written(frame)) and key[0] == Object.DIGITAL_OUTPUTS:
                self.subs.append(key[1])
            return super().receive(frame, now)

    with on_the_bus(braked()) as (world, network, objects):
        put_on_the_bus(world, heard := Heard())
        before = read_panel(objects)
        told = set_outputs(network, asked(tmp_path, _16=True))
        assert heard.subs == [1, 2], "with the mask first, the master would decide a former level"
        assert (told.outputs, told.mask) == (1 << 16 | 1, 1 << 16)
        told = set_outputs(network, asked(tmp_path, _17=True, _16=False))
        assert (told.outputs, told.mask) == (1 << 17 | 1, 3 << 16)
        contents = read_journal(tmp_path / "journal.jsonl")
        assert not contents.restored
        done = restore(restoring(world), contents)
        assert done.complete
        assert read_panel(objects) == before


def restoring(world: World) -> CanopenNetwork:
    """Another master, which may put things back."""
    return CanopenNetwork(world.link, world.clock, writes=RESTORE)


def test_a_drive_that_is_enabled_or_has_no_outputs_gets_none(tmp_path: Path) -> None:
    with (
        on_the_bus(SimulatedServo(1, LING)) as (_, network, _),
        pytest.raises(PeerFault, match="has no outputs to set"),
    ):
        set_outputs(network, asked(tmp_path, _16=True))
    with on_the_bus(braked()) as (world, network, _):
        for word in (0x06, 0x07, 0x0F):
            RemoteObjects(restoring(world), 1).write(0x6040, 0, "H", word)
        with pytest.raises(PeerFault, match="is not disabled"):
            set_outputs(network, asked(tmp_path, _16=True))
    assert not (tmp_path / "journal.jsonl").exists()


def actuated(
    rest: int, *levels: tuple[float, int], names: tuple[str, ...] = ("positive",)
) -> list[SwitchTried]:
    """Inputs at rest, then each of ``levels`` from its time on, s."""
    servo = SimulatedServo(1, LING)
    servo.drive.machine.held = rest

    def hold(bits: int) -> Callable[[Instant], None]:
        return lambda _now: setattr(servo.drive.machine, "held", bits)

    with on_the_bus(servo) as (world, _, objects):
        put_on_the_bus(world, *(Act(at_s, hold(bits)) for at_s, bits in levels))
        return try_switches(objects, names, 2.0, lambda _text: None)


@pytest.mark.parametrize(
    ("rest", "levels", "right", "text"),
    [
        (0, [(0.3, 2), (0.6, 0)], True, "right"),
        (4, [(0.3, 6), (0.6, 4)], True, "right"),
        (2, [(0.3, 0), (0.6, 2)], False, "INVERTED"),
        (0, [(0.3, 1), (0.6, 0)], False, "SWAPPED: it is wired to negative"),
        (0, [], False, "NOT SEEN"),
        (0, [(0.3, 2)], False, "STAYS"),
        (0, [(0.3, 2), (0.31, 0), (0.32, 2), (0.6, 0)], False, "BOUNCES: 4 changes"),
    ],
)
def test_a_switch_that_is_actuated_is_judged(
    rest: int, levels: list[tuple[float, int]], right: bool, text: str
) -> None:
    (seen,) = actuated(rest, *levels)
    assert (seen.name, seen.right) == ("positive", right)
    assert seen.text.startswith(text)


def test_one_switch_after_the_other() -> None:
    seen = actuated(0, (0.3, 1), (0.5, 0), (1.2, 4), (1.4, 0), names=("negative", "home"))
    assert [(each.name, each.right) for each in seen] == [("negative", True), ("home", True)]


@pytest.mark.parametrize(
    "words", [("--set", "0=1"), ("--set", "32=1"), ("--set", "16=2"), ("--switch", "up")]
)
def test_words_that_name_no_output_or_switch_are_refused(words: tuple[str, str]) -> None:
    done = CliRunner().invoke(app, ["io", "--bus", "hub:nobody", "--node", "1", *words])
    assert done.exit_code == BadInput.exit_status
    assert words[0] in done.output
