"""The steps that only listen and read: bus, identity and dictionary, and all that they say."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from canopen.objectdictionary import ObjectDictionary

from servobench.drivers.cia402.drive_setup import Identity
from servobench.drivers.cia402.profile import Mode
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, NS_PER_US, Instant
from servobench.hil.commissioning import steps_static as module
from servobench.hil.commissioning.findings import StepFailed, StepOutcome
from servobench.hil.commissioning.session import Session
from servobench.hil.commissioning.steps_static import BusCheck, DumpStep, IdentityCheck
from servobench.hil.restoring.journal import DriveMark, Journal, JournalHead, read_journal
from tests.unit.hil.simulated_shaft import Shaft, session_of, shaft_of
from tests.unit.hil.test_known_objects import Node, sheet, variable

TRUTH = shaft_of(1e-3)
DRIVE = Identity("it", 0x1A, 0x2B, 0x3C, 4, 402)
CST, PV = Mode.CYCLIC_SYNCHRONOUS_TORQUE, Mode.PROFILE_VELOCITY


# ---- bus -------------------------------------------------------------------------------------------------


class Bus:
    """``frames`` come while it is listened; each answer takes 10 us longer than the one before."""

    def __init__(self, frames: int, errors: int = 0) -> None:
        self.now = Instant(3 * NS_PER_MS)
        self.asked: list[Any] = []
        self.link = SimpleNamespace(received_frames=1000)
        here = self

        class Timed(SimpleNamespace):
            @property
            def clock_now(self) -> Instant:
                return here.now

        def wait(seconds: float) -> None:
            self.now = Instant(self.now + round(seconds * NS_PER_S))
            self.link.received_frames += frames

        self.session = cast(
            Session,
            Timed(
                network=self,
                request=SimpleNamespace(node=5),
                wait=wait,
                deadline=lambda seconds: seconds,
                drive=SimpleNamespace(connect=lambda deadline: self.asked.append(("connect", deadline))),
                world=SimpleNamespace(load_percent=self._load_percent, error_frames=lambda: errors),
            ),
        )

    def _load_percent(self, begin: int, end: int) -> float:
        self.asked.append((begin, end))
        return 12.345

    def upload(self, *asked: int) -> None:
        self.now = Instant(self.now + (100 + 10 * sum(each == asked for each in self.asked)) * NS_PER_US)
        self.asked.append(asked)


@pytest.mark.parametrize(("frames", "told"), [(0, "0 frames"), (1, "1 frame"), (2, "2 frames")])
def test_what_is_heard_and_how_soon_the_node_answers(frames: int, told: str) -> None:
    bus, outcome = Bus(frames), StepOutcome()
    BusCheck().run(bus.session, outcome)
    assert outcome.lines == [
        f"{told} in 0.5 s, bus load 12.3 %, 0 error frames",
        "answers after 195 us, at most 290 us",
    ]
    assert outcome.figures == {"frames": frames, "error_frames": 0, "sdo_us": 195.0}
    assert bus.asked == [(3_000_000, 503_000_000), ("connect", 5.0), *[(5, 0x1000)] * 20]


def test_error_frames_fail_it_with_all_that_was_heard() -> None:
    outcome = StepOutcome()
    with pytest.raises(StepFailed) as caught:
        BusCheck().run(Bus(3, errors=2).session, outcome)
    assert (caught.value.summary, caught.value.remedy) == (
        "2 error frames on the bus",
        "check bit rate, termination and cable",
    )
    assert len(outcome.lines) == 2
    assert BusCheck().plan(Bus(0).session) == "listen for 0.5 s, then ask node 5 20 times for 1000h"


# ---- identity --------------------------------------------------------------------------------------------


class Introduced:
    """A session with a drive that tells who it is; its journal is in ``folder``."""

    def __init__(
        self, monkeypatch: pytest.MonkeyPatch, folder: Path, dictionary: ObjectDictionary | None = None
    ) -> None:
        self.texts = {0x1009: "hw 2", 0x100A: ""}
        self.journals: list[Journal] = []
        head = JournalHead("hub:x", 5, DriveMark(0x1A, 0x2B, 4), None, None)
        monkeypatch.setattr(
            module,
            "head_of",
            lambda _objects, bus, bitrate, identity: self._head(bus, bitrate, identity, head),
        )
        self.path = folder / "journal.jsonl"
        request = SimpleNamespace(
            eds=None, dry_run=False, bus="hub:x", bitrate_bit_s=500_000, journal=self.path
        )
        self.session = session_of(Shaft(TRUTH), request=request, dictionary=dictionary)
        mine: Any = self.session
        mine.drive = SimpleNamespace(connect=lambda deadline: self._connected(deadline))
        mine.deadline = lambda seconds: seconds
        mine.network = SimpleNamespace(begin_journal=self._begin)
        mine.objects = SimpleNamespace(read_text=lambda index: self.texts[index])

    def _begin(self, journal: Journal) -> None:
        journal.close()
        self.journals.append(journal)

    def _connected(self, deadline: float) -> Identity:
        assert deadline == 5.0
        return DRIVE

    def _head(self, bus: str, bitrate_bit_s: int, identity: Identity, head: JournalHead) -> JournalHead:
        assert (bus, bitrate_bit_s, identity) == ("hub:x", 500_000, DRIVE)
        return head

    def run(self) -> StepOutcome:
        outcome = StepOutcome()
        IdentityCheck().run(self.session, outcome)
        return outcome


def test_who_it_is_and_a_journal_of_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    introduced = Introduced(monkeypatch, tmp_path)
    outcome = introduced.run()
    versions = {"hardware (1009h)": "hw 2"}
    assert outcome.lines == [str(DRIVE)]
    assert outcome.figures == {**DRIVE._asdict(), "versions": versions}
    assert (introduced.session.found.identity, introduced.session.found.versions) == (DRIVE, versions)
    assert len(introduced.journals) == 1
    assert read_journal(introduced.path).head == JournalHead("hub:x", 5, DriveMark(0x1A, 0x2B, 4), None, None)


def test_a_dry_run_has_no_journal(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    introduced = Introduced(monkeypatch, tmp_path)
    introduced.session.request.dry_run = True  # type: ignore[misc]
    introduced.run()
    assert (introduced.journals, introduced.path.exists()) == ([], False)


def of_device(vendor: int, product: int, revision: int) -> ObjectDictionary:
    made = sheet(variable(0x6040, 0))
    information = made.device_information
    information.vendor_number, information.product_number = vendor, product
    information.revision_number = revision
    return made


@pytest.mark.parametrize(
    ("numbers", "part", "of_sheet", "of_drive"),
    [
        ((0x1B, 0x2B, 0x3C), "vendor", "0000001B", "0000001A"),
        ((0x1A, 7, 1), "product", "00000007", "0000002B"),
    ],
)
def test_a_data_sheet_of_another_device_is_refused(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    numbers: tuple[int, int, int],
    part: str,
    of_sheet: str,
    of_drive: str,
) -> None:
    introduced = Introduced(monkeypatch, tmp_path, of_device(*numbers))
    with pytest.raises(StepFailed) as caught:
        introduced.run()
    assert (caught.value.summary, caught.value.evidence, caught.value.remedy) == (
        f"the data sheet is of another device: {part} {of_sheet}h",
        f"the drive says {of_drive}h",
        "give the data sheet of this drive, or none",
    )
    assert introduced.journals == []


def test_another_revision_is_told_and_borne(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    outcome = Introduced(monkeypatch, tmp_path, of_device(0x1A, 0x2B, 0x3D)).run()
    assert outcome.lines == [str(DRIVE), "revision 0000003Ch, the data sheet is for 0000003Dh"]
    assert Introduced(monkeypatch, tmp_path / "b", of_device(0x1A, 0x2B, 0x3C)).run().lines == [str(DRIVE)]


def test_the_plan_names_the_data_sheet() -> None:
    def planned(eds: Path | None) -> str:
        return IdentityCheck().plan(cast(Session, SimpleNamespace(request=SimpleNamespace(eds=eds))))

    assert planned(None) == "read 1000h, 1008h and 1018h; no data sheet"
    assert planned(Path("a/b.eds")) == "read 1000h, 1008h and 1018h, and compare with b.eds"


# ---- dictionary ------------------------------------------------------------------------------------------


def dumped(
    folder: Path, held: dict[tuple[int, int], bytes], dictionary: ObjectDictionary | None
) -> tuple[Session, StepOutcome]:
    session, outcome = session_of(Shaft(TRUTH)), StepOutcome()
    mine: Any = session
    mine.network, mine.dictionary, mine.check_stop = Node(held), dictionary, lambda: None
    mine.request = SimpleNamespace(node=3, out=folder)
    DumpStep().run(session, outcome)
    return session, outcome


def test_all_that_can_be_read_is_written_down_in_order(tmp_path: Path) -> None:
    held = {(0x6041, 0): b"\x40\x02", (0x1018, 1): b"\x1a\0\0\0", (0x1018, 0): b"\1"}
    session, outcome = dumped(tmp_path, held, None)
    text = (tmp_path / "parameters.txt").read_text()
    assert text == "1018h:00 01\n1018h:01 1a000000\n6041h:00 4002\n"
    assert session.found.dump == held
    assert outcome.lines == ["3 objects read into parameters.txt"]
    assert outcome.figures == {"objects": 3}
    assert DumpStep().plan(session) == "read the objects of CiA 301 and CiA 402 into parameters.txt"


def test_forty_of_the_settings_that_differ_are_shown_and_five_that_are_missing(tmp_path: Path) -> None:
    told = sheet(*(variable(0x2000 + number, 0, default=7) for number in range(60)))
    held = {(0x2000 + number, 0): b"\x08\x00" if number < 42 else b"\x07\x00" for number in range(54)}
    session, outcome = dumped(tmp_path, held, told)
    first, differ, *shown, gone = outcome.lines
    assert (first, differ) == (
        "54 objects read into parameters.txt",
        "42 settings differ from the data sheet's defaults",
    )
    assert len(shown) == 40
    assert shown[0].startswith("- 2000h")
    assert shown[-1].startswith("- 2027h")
    assert gone.startswith("6 objects of the data sheet cannot be read: ")
    assert len(gone.split(": ", 1)[1].split(", ")) == 5
    assert outcome.figures == {"objects": 54, "differing": 42, "missing": 6}
    assert DumpStep().plan(session) == (
        "read every object of the data sheet into parameters.txt, and compare with its defaults"
    )


def test_where_all_objects_can_be_read_none_is_said_to_be_missing(tmp_path: Path) -> None:
    told = sheet(variable(0x2000, 0, default=7))
    _, outcome = dumped(tmp_path, {(0x2000, 0): b"\x07\x00"}, told)
    assert outcome.lines == [
        "1 objects read into parameters.txt",
        "0 settings differ from the data sheet's defaults",
    ]
