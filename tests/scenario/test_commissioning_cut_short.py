"""Commissioning broken off at every step, in simulated time: the drive is put back byte for byte.

The bus goes away in the middle of a step, for good, as for a process that is killed: nothing of what the
program would still like to do reaches the drive. A second master then works from the journal alone.

All tries have the same beginning: one commissioning runs to its end, and where a step begins its process is
forked for each try of that step.
"""

import json
import os
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from html import unescape
from pathlib import Path
from shutil import rmtree
from typing import Any, NamedTuple

import pytest

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.nmt_states import NmtCommand, NmtState
from servobench.drivers.canopen.objects import RemoteObjects
from servobench.drivers.cia402.drive_setup import read_identity
from servobench.drivers.cia402.profile import State
from servobench.drivers.errors import BusDown, PeerFault
from servobench.drivers.timebase import NS_PER_S, Instant
from servobench.drivers.wire.adapters import parse_bus_spec
from servobench.drivers.wire.link import BusLink, StampSource
from servobench.drivers.written_file import DiskFull
from servobench.hil.commissioning.commission import all_steps, commission
from servobench.hil.commissioning.dialog import Dialog, EmergencyStop
from servobench.hil.commissioning.findings import StepOutcome, StepVerdict
from servobench.hil.commissioning.report import Commissioned
from servobench.hil.commissioning.request import CommissionRequest, Nameplate
from servobench.hil.commissioning.restore_command import check_mark
from servobench.hil.commissioning.sequence import Step
from servobench.hil.commissioning.session import Session
from servobench.hil.execution.world import World, WorldPlan, open_world
from servobench.hil.machine.stopping import Interrupted
from servobench.hil.restoring.journal import DriveMark, append_restored, read_journal
from servobench.hil.restoring.restore import restore
from servobench.hil.write_lists import RIG
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.drive.unknown_drive import unknown_drive
from tests.commissioning import WrappedStep
from tests.draws import few_of
from tests.forked_folder import take_a_copy
from tests.scenario.cut_bus import CutBus

SEED = 9
"""Polarity, position and velocity are told wrong."""
PERIOD_US = 5000
CLOCK = 0x1013
"""Goes on by itself."""
WRITING = [step.name for step in all_steps() if step.writes or step.moves]
FIRST_READING = ["bus", "identity", "dump", "units"]
UNPLUGGED = ["setup", "polarity"]
PARTS = dict(few_of([("late", 0.6), ("early", 0.1)], 1))

pytestmark = [pytest.mark.xdist_group("commissioning cut short"), pytest.mark.timeout(600)]


class Stop(EmergencyStop):
    """A Ctrl-C after so many frames."""

    def __init__(self, bus: CutBus) -> None:
        super().__init__()
        self.bus = bus
        self.at: int | None = None

    def __call__(self) -> bool:
        return self.at is not None and self.bus.sent >= self.at

    @property
    def asked_by(self) -> str:
        return "SIGINT"


class InTheMiddle(WrappedStep):
    """A step at whose beginning ``arm`` is called with its name."""

    def __init__(self, inner: Step, arm: Callable[[str], None], note: Callable[[str, int], None]) -> None:
        super().__init__(inner)
        self._arm = arm
        self._note = note

    def run(self, session: Session, outcome: StepOutcome) -> None:
        self._arm(self.name)
        before = session.network.link.sent_frames
        try:
            self._inner.run(session, outcome)
        finally:
            self._note(self.name, session.network.link.sent_frames - before)


class Rig:
    """A drive on a simulated bus that can be cut."""

    def __init__(self, world: World, servo: SimulatedServo, folder: Path) -> None:
        self.bus = CutBus(world.link.bus)
        link = BusLink(self.bus, world.clock, StampSource.MONOTONIC, "simulated")
        self.world = replace(world, link=link)
        self.servo = servo
        _, truth = unknown_drive(SEED)
        self.request = CommissionRequest(
            bus="simulated",
            node=1,
            out=folder,
            nameplate=Nameplate.model_validate(truth.nameplate),
            period_us=PERIOD_US,
        )
        self.stop = Stop(self.bus)
        self.sent: dict[str, int] = {}
        self.said: list[str] = []

    def memory(self) -> dict[tuple[int, int], bytes]:
        """All that the bus could have changed."""
        dictionary = self.servo.dictionary
        return {
            (entry.index, sub): dictionary.upload(entry.index, sub)
            for entry in dictionary
            for sub, variable in entry.members.items()
            if variable.writable and variable.readable and entry.index != CLOCK
        }

    def commission(self, arm: Callable[[str], None] = lambda _: None, last_step: str = "") -> Commissioned:
        """Run it; ``arm`` is called at the beginning of each step. ``last_step``: none behind that one."""

        def steps() -> Sequence[Step]:
            wrapped = [InTheMiddle(step, arm, self.sent.__setitem__) for step in all_steps()]
            names = [step.name for step in wrapped]
            return wrapped[: names.index(last_step) + 1] if last_step else wrapped

        return commission(self.request, self.world, Dialog(self.said.append), self.stop, steps=steps)

    def left(self, result: Commissioned) -> dict[str, Any]:
        """How the drive was left by figures.json; terminal, report.md and report.html say the same."""
        out = self.request.out
        figures = json.loads((out / "figures.json").read_text())
        filed = json.loads((out / "certificate.json").read_text())
        assert filed["verdict"] == figures["verdict"]
        assert figures["error"] == str(result.error)
        left: dict[str, Any] = figures["left"]
        assert self.said[-len(left["text"]) :] == left["text"]
        for name in ("report.md", "report.html"):
            text = unescape((out / name).read_text())
            assert "Ended early" in text
            assert all(sentence in text for sentence in left["text"]), name
        return left

    def stands_disabled(self) -> bool:
        """By the simulated drive itself."""
        drive = self.servo.drive
        turning = abs(drive.firmware.inner.speed_measured_rad_s) > 0.1
        return drive.power.state is State.SWITCH_ON_DISABLED and not turning

    def restore(self) -> None:
        """What ``hil restore`` does, as a process of its own."""
        self.bus.cut_at = self.bus.unplugged_at = None
        network = CanopenNetwork(self.world.link, self.world.clock)
        network.pump(Instant(self.world.clock.now() + 2 * NS_PER_S))
        assert self.servo.drive.power.state is not State.OPERATION_ENABLED, "the drive missed its host"
        result = restore(network, read_journal(self.request.journal))
        assert result.failures == []
        append_restored(self.request.journal)


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    """The drive of SEED, up and running."""
    servo, _ = unknown_drive(SEED)
    with open_world(WorldPlan(parse_bus_spec("simulated"), 1_000_000, False, None, SEED), [servo]) as world:
        yield Rig(world, servo, tmp_path)


@pytest.fixture(scope="module")
def frames(tmp_path_factory: pytest.TempPathFactory) -> dict[str, int]:
    """Frames that each step sends, of a run that nothing disturbs."""
    servo, _ = unknown_drive(SEED)
    with open_world(WorldPlan(parse_bus_spec("simulated"), 1_000_000, False, None, SEED), [servo]) as world:
        rig = Rig(world, servo, tmp_path_factory.mktemp("whole"))
        before = rig.memory()
        result = rig.commission()
        assert [(r.name, r.reason) for r in result.records if r.verdict is not StepVerdict.DONE] == []
        assert result.passed
        assert rig.memory() == before
        return rig.sent


def test_every_writing_step_is_tried(frames: dict[str, int]) -> None:
    assert set(WRITING) <= set(frames)
    assert all(frames[name] > 0 for name in WRITING)


Ends = Mapping[tuple[str, str], str]
"""By step and try: empty, or the traceback of what was wrong."""


class Try(NamedTuple):
    """A commissioning that is broken off within a step."""

    arm: Callable[[Rig], None]
    """Called at the beginning of the step."""
    check: Callable[[Rig, Commissioned], None]


def _cut(rig: Rig, frames: int) -> None:
    rig.bus.cut_at = rig.bus.sent + max(1, frames)


def _put_back_by_the_journal(rig: Rig, result: Commissioned, before: Mapping[Any, bytes]) -> None:
    assert isinstance(result.error, BusDown)
    left = rig.left(result)
    assert left["at_rest"] is None or rig.stands_disabled()
    if rig.memory() != before:
        assert (left["settings"], left["mend"]) == ("changed", rig.request.restore_command)
    rig.restore()
    assert rig.memory() == before
    assert read_journal(rig.request.journal).restored


def _ask(rig: Rig, frames: int) -> None:
    rig.stop.at = rig.bus.sent + frames


def _put_back_by_itself(rig: Rig, result: Commissioned, before: Mapping[Any, bytes], name: str) -> None:
    assert isinstance(result.error, Interrupted), [(r.name, r.reason) for r in result.records]
    assert result.records[-1].name == name or rig.bus.sent >= (rig.stop.at or 0)
    assert rig.memory() == before
    assert rig.stands_disabled()
    left = rig.left(result)
    assert left["settings"] in ("restored", "unchanged")
    assert (left["at_rest"], left["disabled"]) in ((True, True), (None, None))
    assert left["at_rest"] or name in FIRST_READING


def _hit(rig: Rig) -> None:
    rig.stop.at, rig.stop.key = rig.bus.sent + 40, True


def _at_rest_by_a_key(rig: Rig, result: Commissioned, before: Mapping[Any, bytes]) -> None:
    assert result.error is not None
    assert (str(result.error), result.error.exit_status) == ("emergency stop by a key", 3)
    left = rig.left(result)
    assert (left["at_rest"], left["disabled"], left["settings"]) == (True, True, "restored")
    assert (rig.stands_disabled(), rig.memory() == before) == (True, True)


def _pull(rig: Rig) -> None:
    rig.bus.unplugged_at = rig.bus.sent + 40


def _open_without_the_drive(rig: Rig, result: Commissioned, before: Mapping[Any, bytes], name: str) -> None:
    assert result.error is not None
    assert result.error.exit_status == 3
    left = rig.left(result)
    assert (left["at_rest"], left["disabled"], left["settings"]) == (None, None, "changed")
    assert left["mend"] == rig.request.restore_command
    enabled = "The drive was never enabled." if name == "setup" else "NOT confirmed at rest"
    assert enabled in left["text"][0]
    assert rig.memory() != before
    rig.restore()
    assert rig.memory() == before


def tries_of(name: str, frames: int, before: Mapping[Any, bytes]) -> Iterator[tuple[str, Try]]:
    """The tries of the step ``name``, which sends so many ``frames``; ``before``: the drive's memory."""
    if name in (*FIRST_READING, *WRITING):
        check = partial(_put_back_by_itself, before=before, name=name)
        yield "ctrl-c", Try(partial(_ask, frames=frames // 2), check)
    if name in WRITING:
        for when, part in PARTS.items():
            check = partial(_put_back_by_the_journal, before=before)
            yield when, Try(partial(_cut, frames=round(part * frames)), check)
    if name in UNPLUGGED:
        yield "unplugged", Try(_pull, partial(_open_without_the_drive, before=before, name=name))
    if name == "polarity":
        yield "key", Try(_hit, partial(_at_rest_by_a_key, before=before))


class Tries:
    """One commissioning, forked at the beginning of each step for each of its tries."""

    def __init__(self, rig: Rig, frames: Mapping[str, int]) -> None:
        self.ends: dict[tuple[str, str], str] = {}
        self._rig, self._frames, self._before = rig, frames, rig.memory()
        self._mine: Try | None = None
        """The try that this process is, if it is one."""
        self._told = rig.request.out.with_name("told")

    def run(self) -> None:
        try:
            result = self._rig.commission(self._fork)
            if self._mine is not None:
                self._mine.check(self._rig, result)
            else:
                assert result.passed
        finally:
            if self._mine is not None:
                self._told.write_text(traceback.format_exc() if sys.exc_info()[0] else "")
                os._exit(0)

    def _fork(self, name: str) -> None:
        if self._mine is not None:
            return
        folder = self._rig.request.out
        aside = folder.with_name("aside")
        for which, each in tries_of(name, self._frames[name], self._before):
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", DeprecationWarning)  # pytest-xdist has threads, unused here
                process = os.fork()
            if not process:
                self._mine = each
                take_a_copy(folder, aside)
                each.arm(self._rig)
                return
            _, status = os.waitpid(process, 0)
            told = self._told.read_text() if self._told.exists() else f"ended with status {status}"
            self.ends[name, which] = told
            self._told.unlink(missing_ok=True)
            if aside.exists():
                rmtree(folder)
                aside.rename(folder)


@pytest.fixture(scope="module")
def ends(frames: dict[str, int], tmp_path_factory: pytest.TempPathFactory) -> Ends:
    servo, _ = unknown_drive(SEED)
    with open_world(WorldPlan(parse_bus_spec("simulated"), 1_000_000, False, None, SEED), [servo]) as world:
        folder = tmp_path_factory.mktemp("tries") / "out"
        folder.mkdir()
        tries = Tries(Rig(world, servo, folder), frames)
        tries.run()
    return tries.ends


@pytest.mark.parametrize("part", PARTS)
@pytest.mark.parametrize("name", WRITING)
def test_a_journal_alone_puts_the_drive_back(ends: Ends, name: str, part: str) -> None:
    assert ends[name, part] == ""


@pytest.mark.parametrize("name", [*FIRST_READING, *WRITING])
def test_ctrl_c_puts_the_drive_back_by_itself(ends: Ends, name: str) -> None:
    assert ends[name, "ctrl-c"] == ""


def test_a_key_leaves_a_report_of_a_drive_at_rest_and_put_back(ends: Ends) -> None:
    assert ends["polarity", "key"] == ""


@pytest.mark.parametrize("name", UNPLUGGED)
def test_a_drive_that_is_unplugged_leaves_a_report_of_what_is_open(ends: Ends, name: str) -> None:
    assert ends[name, "unplugged"] == ""


def test_a_disk_without_room_ends_it_with_the_drive_put_back(rig: Rig) -> None:
    before = rig.memory()
    full = Path("/dev/full")
    (rig.request.out / "parameters.txt").symlink_to(full)
    (rig.request.out / "report.html").symlink_to(full)
    result = rig.commission()
    assert isinstance(result.error, DiskFull)
    assert "No space left on device" in str(result.error)
    assert [record.name for record in result.records][-1] == "dump"
    assert rig.memory() == before
    said = "\n".join(rig.said)
    assert "the report is not whole: --out: " in said
    assert json.loads((rig.request.out / "figures.json").read_text())["left"]["settings"] == "restored"
    assert result.left.sentences(rig.request) == rig.said[-2:]


def test_the_journal_of_another_drive_is_refused(rig: Rig) -> None:
    network = CanopenNetwork(rig.world.link, rig.world.clock)
    identity = read_identity(RemoteObjects(network, 1))
    mark = DriveMark(identity.vendor, identity.product, identity.serial)
    check_mark(RemoteObjects(network, 1), mark)
    with pytest.raises(PeerFault, match="not the drive of the journal"):
        check_mark(RemoteObjects(network, 1), mark._replace(serial=mark.serial + 1))


def test_a_drive_that_was_operational_is_so_again(rig: Rig) -> None:
    network = CanopenNetwork(rig.world.link, rig.world.clock, writes=RIG)
    objects = RemoteObjects(network, 1)
    objects.write(0x1017, 0, "H", 100)
    network.command(NmtCommand.START, 1)
    before = rig.memory()
    rig.commission(last_step="polarity")
    assert read_journal(rig.request.journal).head.nmt == NmtState.OPERATIONAL
    assert rig.memory() == before
    network.status(1)
    network.pump(Instant(rig.world.clock.now() + NS_PER_S))
    assert network.status(1).state is NmtState.OPERATIONAL
