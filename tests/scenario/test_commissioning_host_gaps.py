"""A host that stands still for a second in each step of a commissioning, and at each prompt.

A drive that turns stops by itself; the step is done once more on a drive that was looked after, and the
commissioning comes to its end. The drive has no 1029h: a lost host takes it out of OPERATIONAL, as the
standard's default has it.
"""

import math
import os
import signal
import subprocess
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any

import pytest

from servobench.drivers.timebase import NS_PER_S, Duration, Instant, MonotonicClock
from servobench.drivers.wire.adapters import open_bus, parse_bus_spec
from servobench.hil.commissioning.commission import all_steps, commission
from servobench.hil.commissioning.dialog import Choice, Dialog, EmergencyStop, Idle
from servobench.hil.commissioning.findings import StepOutcome, StepVerdict
from servobench.hil.commissioning.recording import SessionLog
from servobench.hil.commissioning.report import Commissioned
from servobench.hil.commissioning.request import CommissionRequest, Nameplate
from servobench.hil.commissioning.sequence import Step
from servobench.hil.commissioning.session import Session
from servobench.hil.execution.world import World, WorldPlan, open_world
from servobench.hil.restoring.journal import JournaledNetwork
from servobench.hil.write_lists import COMMISSION
from servobench.virtual_bus.drive.lacks import take_away
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from servobench.virtual_bus.drive.unknown_drive import unknown_drive
from servobench.virtual_bus.hosting.devices import serve
from tests.commissioning import WrappedStep
from tests.motors import LING
from tests.scenario.processes import hub_name, in_background, loop_of
from tests.scenario.test_commissioning_exits import TIMEOUT_MS, command, witness

SEED = 9
PERIOD_US = 5000
STILL = NS_PER_S
MINUTE = 60 * NS_PER_S
TURNING_RAD_S = 1.0
SPEED_KEPT_RAD_S = 0.5


class Standstill:
    """Counts the frames that a step sends, and has the host stand still after one of them, once."""

    def __init__(
        self,
        world: World,
        servo: SimulatedServo,
        at_frame: dict[str, int],
        at_speed: Mapping[str, float] = MappingProxyType({}),
    ) -> None:
        """By step: behind that frame, or the first that is sent while the shaft is so fast, rad/s."""
        self._world = world
        self._servo = servo
        self._at_frame, self._at_speed = at_frame, at_speed
        self._step = ""
        self._sent = 0
        self.fastest: dict[str, tuple[float, int]] = {}
        """By step: the highest speed of the shaft, rad/s, and the frame that was sent then."""
        self.frames: dict[str, int] = {}
        """By step: how many were sent."""
        self.kinds: set[tuple[int, bool]] = set()
        """Identifiers that the host sent in steps, and whether as remote frames."""
        self.stood: dict[str, tuple[float, float]] = {}
        """By step: speed of the shaft when the host stopped, and when it went on, rad/s."""
        world.link.tap(self._tap)

    def begin(self, step: str) -> None:
        """Of an attempt."""
        self._step, self._sent = step, 0

    def _tap(self, way: str, can_id: int, _data: bytes, _extended: bool, remote: bool, _at: Instant) -> None:
        if way != "tx" or not self._step:
            return
        self._sent += 1
        self.kinds.add((can_id, remote))
        speed = self._speed()
        self.frames[self._step] = self._sent
        if speed > self.fastest.get(self._step, (-1.0, 0))[0]:
            self.fastest[self._step] = (speed, self._sent)
        due = self._at_frame.get(self._step) == self._sent
        if (due or speed >= self._at_speed.get(self._step, math.inf)) and self._step not in self.stood:
            self.stood[self._step] = (speed, speed)
            self.stand()
            self.stood[self._step] = (speed, self._speed())

    def stand(self) -> None:
        """The bus goes on, the host does not."""
        self._world.clock.sleep_until(Instant(self._world.clock.now() + STILL))

    def _speed(self) -> float:
        self._servo.drive.advance(self._world.clock.now())
        return abs(self._servo.drive.firmware.inner.speed_rad_s)


class Halting(WrappedStep):
    """A step that tells when it begins."""

    def __init__(self, inner: Step, begin: Callable[[str], None]) -> None:
        super().__init__(inner)
        self._begin = begin

    def run(self, session: Session, outcome: StepOutcome) -> None:
        self._begin(self.name)
        try:
            self._inner.run(session, outcome)
        finally:
            self._begin("")


class Slow(Dialog):
    """Somebody who takes his time: at each prompt ``wait`` is called with what lets time pass. He gives up at
    the first step that fails."""

    attended = True

    def __init__(self, wait: Callable[[Idle], None]) -> None:
        super().__init__(lambda _text: None)
        self._wait = wait

    def choose(self, _question: str, choices: tuple[Choice, ...], idle: Idle) -> Choice:
        self._wait(idle)
        return Choice.QUIT if Choice.REPEAT in choices else choices[0]

    def line(self, question: str, idle: Idle) -> str:
        self._wait(idle)
        return "4" if "pole pairs" in question else ""


def commissioned(
    folder: Path,
    at_frame: dict[str, int],
    wait: Callable[[World, Standstill, Idle], None] | None = None,
    lacks: Sequence[str] = ("1029",),
    at_speed: Mapping[str, float] = MappingProxyType({}),
    **changes: Any,
) -> tuple[Commissioned, Standstill]:
    """In simulated time; ``changes``: of the request."""
    servo, truth = unknown_drive(SEED)
    take_away(servo.dictionary, lacks)
    request = CommissionRequest(
        "simulated", 1, folder, nameplate=Nameplate.model_validate(truth.nameplate), period_us=PERIOD_US,
        **changes,
    )  # fmt: skip
    with open_world(WorldPlan(parse_bus_spec("simulated"), 1_000_000, False, None, SEED), [servo]) as world:
        still = Standstill(world, servo, at_frame, at_speed)
        dialog = Dialog(print) if wait is None else Slow(lambda idle: wait(world, still, idle))

        def steps() -> list[Step]:
            return [Halting(step, still.begin) for step in all_steps()]

        return commission(request, world, dialog, EmergencyStop(), steps=steps), still


@pytest.fixture(scope="module")
def unhurried(tmp_path_factory: pytest.TempPathFactory) -> Standstill:
    """Of a commissioning in which somebody takes a minute at each prompt."""

    def wait(world: World, _still: Standstill, idle: Idle) -> None:
        until = Instant(world.clock.now() + MINUTE)
        while world.clock.now() < until:
            idle()

    result, still = commissioned(tmp_path_factory.mktemp("whole"), {}, wait)
    assert result.passed, "a minute at each prompt harms nothing"
    assert {record.attempts for record in result.records} == {1}
    return still


def test_a_host_that_stands_still_in_every_step(tmp_path: Path, unhurried: Standstill) -> None:
    at_speed = {name: 0.9 * speed for name, (speed, _) in unhurried.fastest.items() if speed > TURNING_RAD_S}
    at_frame = {name: sent // 2 for name, sent in unhurried.frames.items() if name not in at_speed}
    result, still = commissioned(tmp_path, at_frame, at_speed=at_speed)
    said = [(record.name, record.verdict, record.reason) for record in result.records]
    assert all(verdict is StepVerdict.DONE for _, verdict, _ in said), said
    assert result.passed
    turning = {name for name, (before, _) in still.stood.items() if before > TURNING_RAD_S}
    moving = {step.name for step in all_steps() if step.moves}
    assert turning == moving - {"enable"}, still.stood
    assert all(after < SPEED_KEPT_RAD_S for _, after in still.stood.values()), still.stood
    attempts = {record.name: record.attempts for record in result.records}
    assert {name for name in moving if attempts[name] == 2} == moving, attempts


def test_a_host_that_stands_still_at_every_prompt(tmp_path: Path) -> None:
    result, _ = commissioned(tmp_path, {}, lambda _world, still, _idle: still.stand())
    said = [(record.name, record.verdict, record.reason) for record in result.records]
    assert all(verdict is StepVerdict.DONE for _, verdict, _ in said), said


@contextmanager
def drive_without_1029h(bus: str) -> Iterator[None]:
    """Served by a thread of the test until it is left."""
    opened, over = open_bus(parse_bus_spec(bus), 1_000_000), threading.Event()
    servo = SimulatedServo(1, LING, DriveParameters(lacks=("1029",)))
    serving = threading.Thread(target=serve, args=([servo], opened.bus, MonotonicClock(), over.is_set))
    serving.start()
    try:
        yield
    finally:
        over.set()
        serving.join()
        opened.bus.shutdown()


class Somebody:
    """At the terminal of a commissioning."""

    def __init__(self, process: subprocess.Popen[str], keyboard: int) -> None:
        self._process, self._keyboard = process, keyboard
        self.said: list[str] = []

    def read_until(self, text: str) -> None:
        """Read on until a line has ``text``."""
        assert self._process.stderr is not None
        for line in self._process.stderr:
            self.said.append(line)
            if text in line:
                return
        raise AssertionError("".join(self.said))

    def go_on_until(self, title: str) -> None:
        """Press Enter at each question until ``title`` is said."""
        assert self._process.stderr is not None
        for line in self._process.stderr:
            self.said.append(line)
            if title in line:
                return
            if " = go" in line:
                os.write(self._keyboard, b"\n")
        raise AssertionError("".join(self.said))

    def answer(self, title: str, key: str = "") -> None:
        """Press ``key`` and Enter at the next question after ``title`` was said."""
        self.read_until(title)
        self.read_until(" = go" if not key else " = repeat" if key == "r" else " = quit")
        os.write(self._keyboard, f"{key}\n".encode())


@pytest.mark.xdist_group("real time")
def test_a_process_that_is_stopped_at_a_prompt_and_while_the_shaft_turns(tmp_path: Path) -> None:
    bus = hub_name("commission-gap")
    keyboard, terminal = os.openpty()
    try:
        with drive_without_1029h(bus), witness(bus) as watching:
            words = [word for word in command(bus, tmp_path) if word != "--yes"]
            process = in_background(words, terminal, subprocess.DEVNULL)
            somebody = Somebody(process, keyboard)
            somebody.go_on_until("Direction")
            os.kill(loop_of(process.pid), signal.SIGSTOP)
            watching.network.pump(Instant(watching.now() + 2 * TIMEOUT_MS * 1_000_000))
            os.kill(loop_of(process.pid), signal.SIGCONT)
            os.write(keyboard, b"\n")
            watching.until_turning()
            at = watching.now()
            os.kill(loop_of(process.pid), signal.SIGSTOP)
            watching.time_to_rest(at, 1e-3 * TIMEOUT_MS + 2.0, asking=True)
            os.kill(loop_of(process.pid), signal.SIGCONT)
            somebody.answer("failed: the host stood still", "r")
            somebody.answer("Velocity against position", "q")
            process.communicate(timeout=30)
        assert process.returncode == 1
        assert (
            sum("the drive is set up again: its NMT state is PRE_OPER" in line for line in somebody.said) == 2
        )
    finally:
        os.close(keyboard)
        os.close(terminal)


@pytest.mark.xdist_group("real time")
def test_a_fit_that_takes_long_keeps_the_host_s_heartbeat(tmp_path: Path) -> None:
    """It ends only when ten heartbeats were on the bus; a host that was busy with it would send none."""
    bus, beats = hub_name("commission-fit"), threading.Semaphore(0)
    plan = WorldPlan(parse_bus_spec(bus), 1_000_000, False, None, SEED)

    def fit(count: int) -> int:
        for _ in range(count):
            assert beats.acquire(timeout=20.0)
        return count

    with open_world(plan, ()) as world:
        world.link.tap(lambda _way, can_id, *_rest: beats.release() if can_id == 0x77F else None)
        network = JournaledNetwork(world.link, world.clock, COMMISSION)
        log = SessionLog(tmp_path / "recording", world, bus, "a fit")
        session = Session(
            CommissionRequest(bus, 1, tmp_path), world, network, Dialog(print), EmergencyStop(), None, log
        )
        network.produce_heartbeat(Duration(10_000_000))
        assert session.meanwhile(fit, 10) == 10
