"""``hil jog`` and ``hil homing`` on simulated drives: how far the shaft goes, and what every way out leaves,
by a node that looks at the shaft itself.
"""

import math
import os
import pty
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import pytest

from servobench.drivers.cia402.motion import HomingSetup
from servobench.drivers.cia402.profile import State
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Instant
from servobench.drivers.wire.adapters import parse_bus_spec
from servobench.hil.commissioning.commission import commission
from servobench.hil.commissioning.dialog import Choice, Dialog, EmergencyStop, Idle
from servobench.hil.commissioning.findings import StepVerdict
from servobench.hil.commissioning.report import HTML_FILE, Commissioned
from servobench.hil.commissioning.request import CommissionRequest, Nameplate, PlateLimits
from servobench.hil.commissioning.sequence import Step
from servobench.hil.commissioning.steps_manual import (
    Home,
    homing_limits,
    homing_steps,
    jog_limits,
    jog_steps,
)
from servobench.hil.configuration.bench_file import faults_from
from servobench.hil.execution.world import World, WorldPlan, open_world
from servobench.hil.machine.stopping import StopRequest
from servobench.hil.restoring.journal import read_journal
from servobench.hil.write_lists import writes_of
from servobench.virtual_bus.drive.data_sheet import only_modes
from servobench.virtual_bus.drive.load_object import SIMULATED_DRIVE
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from servobench.virtual_bus.frame import Frame
from tests.motors import LING
from tests.parameters.roundtrip import Killed
from tests.scenario.foreign_node import put_on_the_bus
from tests.sdo_writes import SdoWrites

RPM = 120.0
AFTER_S = 0.8
"""The world goes on without its host; a drive's heartbeat time-out is 150 ms."""
ENABLED = State.OPERATION_ENABLED
_VOLATILE = frozenset({0x1003, 0x1013, 0x6040})


class Tap:
    """A node that looks at the shaft each millisecond, and does something ``when`` it turns."""

    def __init__(self, servo: SimulatedServo, at_speed: Callable[[], None]) -> None:
        self.wake_at: Instant | None = None
        self.turns: list[float] = []
        self.rpm: list[float] = []
        self.enabled: list[bool] = []
        self._servo = servo
        self._at_speed: Callable[[], None] | None = at_speed
        self.when: Callable[[Tap], bool] = lambda tap: abs(tap.rpm[-1]) > 30.0

    def start(self, now: Instant) -> Sequence[Frame]:
        self.wake_at = now
        return ()

    def receive(self, frame: Frame, now: Instant) -> Sequence[Frame]:
        del frame, now
        return ()

    def wake(self, now: Instant) -> Sequence[Frame]:
        self.wake_at = Instant(now + NS_PER_MS)
        inner = self._servo.drive.firmware.inner
        self.turns.append(inner.turns + inner.angle_rad / math.tau)
        self.rpm.append(inner.speed_rad_s / RAD_S_PER_RPM)
        self.enabled.append(self._servo.drive.power.state is ENABLED)
        if self._at_speed is not None and self.when(self):
            act, self._at_speed = self._at_speed, None
            act()
        return ()

    def assert_rest(self) -> None:
        """It was enabled, and has stood still, disabled, for the last half second."""
        assert any(self.enabled)
        last = slice(-500, None)
        assert not any(self.enabled[last])
        assert max(self.turns[last]) - min(self.turns[last]) < 1e-3


@dataclass
class Moved:
    """One command."""

    result: Commissioned
    tap: Tap
    before: dict[Any, bytes]
    after: dict[Any, bytes]
    told: list[str] = field(default_factory=list)


class Asked(Dialog):
    """Somebody who answers."""

    attended = True

    def __init__(self, tell: Callable[[str], None], answer: Choice, stands_by: bool = True) -> None:
        super().__init__(tell)
        self.stands_by = stands_by
        self.answer, self.asked = answer, 0

    def choose(self, _question: str, _choices: tuple[Choice, ...], _idle: Idle) -> Choice:
        self.asked += 1
        return self.answer

    def line(self, _question: str, _idle: Idle) -> str:
        return "yes" if self.stands_by else "no"


def memory(servo: SimulatedServo) -> dict[tuple[int, int], bytes]:
    return {
        (entry.index, sub): variable.read()
        for entry in servo.dictionary
        for sub, variable in entry.members.items()
        if variable.writable and variable.readable and entry.index not in _VOLATILE
    }


def moved(
    out: Path,
    steps: Callable[[], Sequence[Step]],
    limits: PlateLimits,
    *,
    purpose: str = "jog",
    servo: SimulatedServo | None = None,
    at_speed: Callable[[], None] = lambda: None,
    when: Callable[[Tap], bool] | None = None,
    stop: EmergencyStop | None = None,
    faults: dict[str, Any] | None = None,
    dialog: Callable[[Callable[[str], None]], Dialog] = Dialog,
    dry_run: bool = False,
    unwatched: bool = False,
    store: bool = False,
    through: Callable[[World], World] = lambda world: world, also: Sequence[str] = (),
) -> Moved:  # fmt: skip
    drive = servo or SimulatedServo(1, LING)
    request = CommissionRequest(
        "simulated", 1, out, nameplate=Nameplate(limits=limits), purpose=purpose, dry_run=dry_run,
        unwatched=unwatched, store=store,
    )  # fmt: skip
    injected = None if faults is None else faults_from(faults, "x")
    plan = WorldPlan(parse_bus_spec("simulated"), 1_000_000, False, injected)
    tap, heard, told = Tap(drive, at_speed), SdoWrites(), list[str]()
    tap.when = when or tap.when
    before: dict[Any, bytes] = {}
    with open_world(plan, [drive]) as world:
        put_on_the_bus(world, tap, heard)
        world.faults.start(world.clock.now())
        world.clock.sleep_until(Instant(100 * NS_PER_MS))
        before = memory(drive)
        writes = writes_of(purpose)
        result = Commissioned()
        try:
            result = commission(
                request, through(world), dialog(told.append), stop or EmergencyStop(), None, steps, writes
            )
        except (RuntimeError, Killed) as defect:
            result.defect = str(defect)
        world.clock.sleep_until(Instant(world.clock.now() + round(AFTER_S * NS_PER_S)))
    assert dry_run or {*heard.unlisted(writes, SIMULATED_DRIVE)} <= {*also}
    return Moved(result, tap, before, memory(drive), told)


def jogged(out: Path, turns: float = 2.0, rpm: float = RPM, percent: float = 30.0, **how: Any) -> Moved:
    return moved(out, lambda: jog_steps(turns), jog_limits(turns, rpm, percent), **how)


def homed(
    out: Path, method: int | None, turns: float = 10.0, limit_s: float = 20.0, offset: float | None = None,
    **how: Any,
) -> Moved:  # fmt: skip
    speeds = HomingSetup(
        RPM * RAD_S_PER_RPM, 0.2 * RPM * RAD_S_PER_RPM, None, None if offset is None else offset * math.tau
    )
    home = Home(method, speeds, turns, limit_s)
    return moved(out, lambda: homing_steps(home), homing_limits(RPM, 30.0), purpose="homing", **how)


@pytest.mark.parametrize("turns", [-1.5, 0.05])
def test_a_jog_goes_where_it_was_sent_and_leaves_everything_as_it_was(tmp_path: Path, turns: float) -> None:
    done = jogged(tmp_path, turns)
    assert done.result.exit_status == 0, done.told
    assert done.tap.turns[-1] - done.tap.turns[0] == pytest.approx(turns, abs=0.01)
    assert max(map(abs, done.tap.rpm)) < 1.05 * RPM
    done.tap.assert_rest()
    assert done.after == done.before
    assert read_journal(tmp_path / "journal.jsonl").restored
    assert "Jog of node 1 on simulated" in (tmp_path / HTML_FILE).read_text()
    assert not list(tmp_path.glob("*.toml")), "those are a commissioning's"
    assert done.result.records[-1].outcome.figures["turns"] == pytest.approx(turns, abs=0.01)


@pytest.mark.parametrize("modes", [0x80, 0x02, 0x01], ids=["csp", "vl", "pp"])
def test_every_mode_of_speeds_or_positions_jogs(tmp_path: Path, modes: int) -> None:
    servo = SimulatedServo(1, LING)
    only_modes(servo.dictionary, modes)
    done = jogged(tmp_path, 1.0, servo=servo)
    assert done.result.exit_status == 0, done.told
    assert done.tap.turns[-1] - done.tap.turns[0] == pytest.approx(1.0, abs=0.1)
    done.tap.assert_rest()
    assert done.after == done.before


def test_a_drive_of_torques_alone_does_not_jog(tmp_path: Path) -> None:
    servo = SimulatedServo(1, LING)
    only_modes(servo.dictionary, 0x200)
    done = jogged(tmp_path, servo=servo)
    assert done.result.exit_status == 1
    assert not any(done.tap.enabled)
    assert done.after == done.before


def test_it_asks_before_the_motion_alone_and_does_nothing_unless_told_to(tmp_path: Path) -> None:
    answers: list[Asked] = []

    def somebody(answer: Choice) -> Callable[[Callable[[str], None]], Dialog]:
        def made(tell: Callable[[str], None]) -> Dialog:
            answers.append(Asked(tell, answer))
            return answers[-1]

        return made

    done = jogged(tmp_path / "go", 0.5, dialog=somebody(Choice.GO))
    assert done.result.exit_status == 0
    done = jogged(tmp_path / "quit", 0.5, dialog=somebody(Choice.QUIT))
    assert [each.asked for each in answers] == [1, 1]
    assert done.result.exit_status == 1
    assert not any(done.tap.enabled)
    assert done.after == done.before
    plan = next(text for text in done.told if "turn the shaft by" in text)
    assert "by +0.5 turns at 120 r/min within" in plan
    assert "with 0.6 N m at most; it is stopped by any key, at 156 r/min, and 0.65 turns from here" in plan


@pytest.mark.parametrize("stands_by", [True, False])
def test_a_drive_that_watches_nobody_moves_only_where_somebody_stands_by(
    tmp_path: Path, stands_by: bool
) -> None:
    class Answering(Asked):
        def choose(self, question: str, choices: tuple[Choice, ...], idle: Idle) -> Choice:
            super().choose(question, choices, idle)
            return Choice.GO if self.asked == 1 else Choice.QUIT

    done = jogged(
        tmp_path, 0.5, servo=SimulatedServo(1, LING, DriveParameters(lacks=("1016", "100C", "100D"))),
        unwatched=True, dialog=lambda tell: Answering(tell, Choice.GO, stands_by),
    )  # fmt: skip
    assert any("Somebody has to stand at its emergency stop" in text for text in done.told)
    assert any(done.tap.enabled) == stands_by
    assert (done.result.exit_status == 0) == stands_by, done.told
    assert not done.tap.enabled[-1]


def test_a_dry_run_writes_nothing_and_says_what_would_come(tmp_path: Path) -> None:
    done = jogged(tmp_path, dry_run=True)
    assert done.result.exit_status == 0
    assert not any(done.tap.enabled)
    assert done.after == done.before
    assert done.result.records[-1].verdict is StepVerdict.NOT_DONE
    assert not (tmp_path / "journal.jsonl").exists()


# ---- every way out ----------------------------------------------------------------------------------------


def pressed(out: Path, motion: Callable[..., Moved]) -> Moved:
    """A key is hit once the shaft turns."""
    keyboard, terminal = pty.openpty()
    with os.fdopen(terminal, "rb", buffering=0) as source:
        done = motion(out, stop=EmergencyStop(None, source), at_speed=lambda: os.write(keyboard, b" "))
    os.close(keyboard)
    return done


def told_to_stop(out: Path, motion: Callable[..., Moved]) -> Moved:
    """A stop signal comes."""
    signals = StopRequest()
    return motion(out, stop=EmergencyStop(signals), at_speed=lambda: signals.ask("SIGTERM"))


def failed(out: Path, motion: Callable[..., Moved]) -> Moved:
    """Something raises in the middle of a cycle."""

    def fail() -> None:
        raise RuntimeError("in a cycle")

    return motion(out, at_speed=fail)


WAYS: dict[str, tuple[Callable[..., Moved], int, str]] = {
    "key": (pressed, 3, "emergency stop by a key"),
    "signal": (told_to_stop, 130, "ended by SIGTERM"),
    "exception": (failed, 0, "in a cycle"),
}
"""What happens, the exit status, and why it ended."""


FAR: Final[dict[str, Callable[..., Moved]]] = {
    "jog": lambda out, **how: jogged(out, 50.0, **how),
    "homing": lambda out, **how: homed(out, 17, 50.0, **how),
}


@pytest.mark.parametrize("motion", FAR.values(), ids=FAR)
@pytest.mark.parametrize(("way", "status", "why"), WAYS.values(), ids=WAYS)
def test_every_way_out_of_a_motion_ends_at_rest_and_puts_everything_back(
    tmp_path: Path, way: Callable[..., Moved], status: int, why: str, motion: Callable[..., Moved]
) -> None:
    done = way(tmp_path, motion)
    assert why in done.result.ended_by
    if status:
        assert done.result.exit_status == status, done.told
    done.tap.assert_rest()
    assert abs(done.tap.turns[-1] - done.tap.turns[0]) < 2.0, "it was on its way over 50 turns"
    assert done.after == done.before
    assert read_journal(tmp_path / "journal.jsonl").restored


@pytest.mark.parametrize("motion", FAR.values(), ids=FAR)
def test_a_bus_that_is_lost_leaves_the_drive_to_its_own_watch_and_names_the_cure(
    tmp_path: Path, motion: Callable[..., Moved]
) -> None:
    down = {"link_down": [{"at_s": 3.0, "duration_s": 1000.0}]}
    done = motion(tmp_path, faults=down)
    assert done.result.exit_status == 3
    done.tap.assert_rest()
    assert max(map(abs, done.tap.rpm)) > 30.0
    assert f"hil restore {tmp_path / 'journal.jsonl'}" in "\n".join(done.told)
    assert done.after != done.before


@pytest.mark.parametrize("motion", FAR.values(), ids=FAR)
def test_a_shaft_that_is_held_ends_the_motion(tmp_path: Path, motion: Callable[..., Moved]) -> None:
    servo = SimulatedServo(1, LING)
    servo.drive.firmware.damage.drag_brake(4.0)
    done = motion(tmp_path, servo=servo)
    assert done.result.exit_status == 1
    assert "the shaft stands for" in done.result.ended_by
    assert sum(done.tap.enabled) < 4000, "ms"
    done.tap.assert_rest()
    assert abs(done.tap.turns[-1] - done.tap.turns[0]) < 0.01
    assert done.after == done.before


# ---- homing -----------------------------------------------------------------------------------------------


def test_a_jog_that_lags_behind_its_way_has_not_arrived(tmp_path: Path) -> None:
    servo = SimulatedServo(1, LING)
    servo.drive.firmware.damage.drag_brake(0.58)  # of 0.6 N m that it may push with: it turns, too slowly
    done = jogged(tmp_path, servo=servo)
    turned = done.tap.turns[-1] - done.tap.turns[0]
    assert 0.5 < turned < 1.8
    assert done.result.exit_status == 1
    assert f"the shaft turned by {turned:+.1f}" in done.result.ended_by
    done.tap.assert_rest()
    assert done.after == done.before


def test_a_homing_finds_the_next_index_and_its_offset_stays(tmp_path: Path) -> None:
    servo = SimulatedServo(1, LING)
    done = homed(tmp_path, 34, servo=servo, offset=0.25)
    assert done.result.exit_status == 0, done.told
    done.tap.assert_rest()
    assert done.after == done.before
    figures = done.result.records[-1].outcome.figures
    rest = done.tap.turns[-1]
    assert figures["position_turns"] == pytest.approx(rest - math.floor(rest) - 0.25, abs=0.01)


def test_a_homing_that_passes_its_path_or_its_time_ends_at_rest(tmp_path: Path) -> None:
    for name, bounds in {"path": {"turns": 0.5}, "time": {"limit_s": 0.5}}.items():
        done = homed(tmp_path / name, 17, **bounds)
        assert done.result.exit_status == 1, done.told
        done.tap.assert_rest()
        assert abs(done.tap.turns[-1] - done.tap.turns[0]) < 1.1
        assert done.after == done.before


def test_a_homing_goes_by_the_drives_own_method_unless_one_is_given(tmp_path: Path) -> None:
    servo = SimulatedServo(1, LING)
    servo.dictionary.variable(0x6098).value = 35
    done = homed(tmp_path, None, servo=servo)
    assert done.result.exit_status == 0
    assert done.result.records[-1].outcome.figures["method"] == 35
    assert not any(abs(rpm) > 1.0 for rpm in done.tap.rpm), "method 35 takes the present place"
