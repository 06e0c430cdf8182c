"""``hil commission`` and ``hil restore`` around the sequence: what is refused, what is said, how it ends."""

import io
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from servobench.drivers.canopen.write_list import WriteList
from servobench.drivers.cia402.drive_setup import Identity
from servobench.drivers.cia402.profile import State
from servobench.drivers.cia402.supervision import Release
from servobench.drivers.errors import BadInput, PeerFault
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant
from servobench.hil.commissioning import commission as module
from servobench.hil.commissioning import restore_command
from servobench.hil.commissioning.commission import _rest, _store, run_command
from servobench.hil.commissioning.dialog import Dialog, EmergencyStop, Terminal, say
from servobench.hil.commissioning.drive_left import DriveLeft
from servobench.hil.commissioning.findings import StepOutcome, StepRecord, StepVerdict
from servobench.hil.commissioning.report import Commissioned, as_json
from servobench.hil.commissioning.request import CommissionRequest, Nameplate
from servobench.hil.commissioning.restore_command import check_mark, run_restore
from servobench.hil.commissioning.session import Session
from servobench.hil.restoring.journal import (
    DriveMark,
    Journal,
    JournalHead,
    ObjectKey,
    ObjectWrite,
    read_journal,
)
from servobench.hil.restoring.restore import Restoration
from servobench.hil.write_lists import RESTORE
from servobench.virtual_bus.drive.unknown_drive import unknown_drive

SEED = 5
SHEET = Path(__file__).parents[2] / "contract/conformance/rehearsed.eds"


class Command:
    """The command, with ``result`` in place of the sequence."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, result: Commissioned | None = None) -> None:
        self.result = result or Commissioned()
        self.asked: list[tuple[Any, ...]] = []
        monkeypatch.setattr(module, "commission", self._commission)
        monkeypatch.setattr(sys, "stdin", io.StringIO())

    def _commission(self, *asked: Any) -> Commissioned:
        self.asked.append(asked)
        return self.result

    def run(
        self,
        bus: str = "simulated",
        *,
        yes: bool = True,
        rehearse: int | None = SEED,
        rehearse_eds: Path | None = None,
        plate_given: bool = False,
        **request: Any,
    ) -> tuple[int, dict[str, Any]]:
        made = CommissionRequest(bus, 1, Path("out"), **request)
        return run_command(
            made, yes=yes, rehearse=rehearse, rehearse_eds=rehearse_eds, plate_given=plate_given
        )

    def refused(self, *bus: str, **options: Any) -> str:
        with pytest.raises(BadInput) as caught:
            self.run(*bus, **options)
        assert not self.asked
        return str(caught.value)


def test_one_drive_is_rehearsed_with(monkeypatch: pytest.MonkeyPatch) -> None:
    told = Command(monkeypatch).refused(rehearse_eds=Path("x.eds"))
    assert told == "--rehearse-eds: found 'x.eds', expected either it or --rehearse SEED"


@pytest.mark.parametrize(
    ("bus", "seed", "sheet"),
    [("simulated", None, None), ("hub:x", 0, None), ("hub:x", None, Path("x.eds"))],
)
def test_a_simulated_bus_is_for_rehearsals_and_no_other_is(
    monkeypatch: pytest.MonkeyPatch, bus: str, seed: int | None, sheet: Path | None
) -> None:
    told = Command(monkeypatch).refused(bus, rehearse=seed, rehearse_eds=sheet)
    assert told == (
        f"--bus: found '{bus}', expected --rehearse SEED or --rehearse-eds FILE with --bus simulated, and "
        "only with it"
    )


def test_without_a_terminal_nobody_can_be_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    told = Command(monkeypatch).refused(yes=False)
    assert told == "--yes: found 'no terminal to ask at', expected --yes, or a terminal as standard input"
    command = Command(monkeypatch)
    command.run(yes=False, dry_run=True)
    command.run(yes=True)
    assert [type(dialog) for _, _, dialog, *_ in command.asked] == [Dialog, Dialog]
    at_a_terminal = Command(monkeypatch)
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(isatty=lambda: True, fileno=lambda: -1))
    monkeypatch.setattr(module, "EmergencyStop", lambda _signals, _source: EmergencyStop())
    at_a_terminal.run(yes=False)
    assert type(at_a_terminal.asked[0][2]) is Terminal


def test_a_rehearsed_drive_brings_its_own_nameplate(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    command = Command(monkeypatch)
    status, figures = command.run()
    request, world, *_, sheet = command.asked[0]
    _, truth = unknown_drive(SEED, 1)
    assert request.nameplate == Nameplate.model_validate(truth.nameplate)
    assert request.trust_nameplate is True
    assert (world.real_time, sheet) == (False, None)
    assert capsys.readouterr().err == (
        "no --motor: the rehearsed drive's own nameplate is taken, and trusted against the drive\n"
        "0 of 0 steps done, 0 faults found; see out/report.html\n"
    )
    assert (status, figures) == (0, as_json(request, command.result))


def test_a_drive_by_its_data_sheet_is_commissioned_with_that_sheet(monkeypatch: pytest.MonkeyPatch) -> None:
    for given in (None, SHEET):
        command = Command(monkeypatch)
        command.run(rehearse=None, rehearse_eds=SHEET, eds=given)
        request, *_, sheet = command.asked[0]
        assert request.eds == SHEET
        assert sheet.dictionary is not None


def record(verdict: StepVerdict, *faults: str) -> StepRecord:
    return StepRecord("x", "a step", "", verdict, outcome=StepOutcome(faults=list(faults)))


@pytest.mark.parametrize(
    ("result", "status", "told"),
    [
        (Commissioned(records=[record(StepVerdict.DONE, "a")]), 0, "1 of 1 steps done, 1 faults found"),
        (
            Commissioned(records=[record(StepVerdict.DONE, "a", "b"), record(StepVerdict.FAILED, "c")]),
            1,
            "1 of 2 steps done, 3 faults found",
        ),
        (Commissioned(records=[record(StepVerdict.SKIPPED)]), 0, "0 of 1 steps done, 0 faults found"),
        (
            Commissioned(left=DriveLeft(restoration=Restoration(failures=["x"]))),
            1,
            "0 of 0 steps done, 0 faults found",
        ),
        (Commissioned(left=DriveLeft(not_stored="no")), 1, "0 of 0 steps done, 0 faults found"),
    ],
)
def test_the_exit_status_tells_whether_it_passed(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    result: Commissioned,
    status: int,
    told: str,
) -> None:
    assert Command(monkeypatch, result).run(plate_given=True)[0] == status
    assert capsys.readouterr().err == f"{told}; see out/report.html\n"


def test_what_ended_it_early_is_told_and_is_the_exit_status(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    error = BadInput("a", "b", 1, "c")
    status, figures = Command(monkeypatch, Commissioned(error=error)).run(plate_given=True)
    assert (status, figures["error"]) == (2, str(error))
    assert capsys.readouterr().err.splitlines()[-1] == f"hil: error: {error}"


# ---- how the drive is left -------------------------------------------------------------------------------


class Network:
    """Notes what is asked of it; ``refusal``: what a download raises."""

    def __init__(self, refusal: PeerFault | None = None) -> None:
        self.sdo_timeout_s = 0.25
        self.told: list[Any] = []
        self._refusal = refusal

    def download(self, *asked: Any) -> None:
        self.told.append((asked, self.sdo_timeout_s))
        if self._refusal is not None:
            raise self._refusal

    def deadline_after(self, limit: Duration) -> Instant:
        return Instant(limit)

    def pump(self, until: Instant) -> None:
        self.told.append(until)


@pytest.mark.parametrize("refusal", [None, PeerFault("1010h: refused", "0800 0020h")])
def test_a_drive_has_two_seconds_to_store(refusal: PeerFault | None) -> None:
    said: list[str] = []
    network, left = Network(refusal), DriveLeft()
    session = SimpleNamespace(
        network=network, request=SimpleNamespace(node=5), dialog=SimpleNamespace(tell=said.append)
    )
    _store(cast(Session, session), left)
    assert network.told == [((5, 0x1010, 1, b"save"), 2.0), 50 * NS_PER_MS]
    assert network.sdo_timeout_s == 0.25
    assert left.stored is (refusal is None)
    assert left.not_stored == ("" if refusal is None else str(refusal))
    assert said == (
        []
        if refusal is None
        else [
            "the drive does not store: 1010h: refused; 0800 0020h; it keeps the settings until it is "
            "switched off"
        ]
    )


@pytest.mark.parametrize(
    ("unwatched", "at_rest", "told"),
    [
        ("", True, []),
        ("nobody watches it", True, ["axis: nobody watches it"]),
        ("", False, ["the drive is not confirmed at rest: it turns"]),
    ],
)
def test_what_a_release_shows_is_told(unwatched: str, at_rest: bool, told: list[str]) -> None:
    said: list[str] = []
    evidence = "" if at_rest else "it turns"
    release = Release(at_rest, State.READY if at_rest else None, evidence, unwatched=unwatched)
    left = DriveLeft()
    session = SimpleNamespace(
        configured=True,
        drive=SimpleNamespace(name="axis", release=lambda: release),
        drives=SimpleNamespace(
            let_go=lambda drives, released, stopped: [released(each, each.release()) for each in drives]
        ),
        dialog=SimpleNamespace(tell=said.append),
    )
    _rest(cast(Session, session), left)
    assert said == told
    assert (left.at_rest, left.disabled, left.evidence) == (at_rest or None, at_rest or None, evidence)


# ---- hil restore -----------------------------------------------------------------------------------------

MARK = DriveMark(0x1A, 0x2B, 3)


class Restored:
    """``hil restore`` with ``result`` in place of what it does to the drive."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, folder: Path, result: Restoration) -> None:
        self.journal = folder / "journal.jsonl"
        written = Journal(self.journal, JournalHead("hub:x", 7, MARK, None, None, 500_000))
        written.note(ObjectWrite(ObjectKey(0x6072, 0), b"\1\0", b"\2\0"))
        written.close()
        self.done: list[Any] = []
        network = object()

        @contextmanager
        def drive_network(bus: str, bitrate_bit_s: int, writes: WriteList) -> Iterator[object]:
            self.stores = writes is not RESTORE
            self.done.append((bus, bitrate_bit_s))
            yield network

        def restore(over: object, contents: Any, tell: Any) -> Restoration:
            assert (over, contents.head.node, tell) == (network, 7, say)
            self.done.append("restored")
            return result

        monkeypatch.setattr(restore_command, "drive_network", drive_network)
        monkeypatch.setattr(restore_command, "await_answer", lambda _over, *asked: self.done.append(asked))
        monkeypatch.setattr(
            restore_command, "check_mark", lambda objects, mark: self.done.append((objects.node_id, mark))
        )
        monkeypatch.setattr(restore_command, "restore", restore)
        monkeypatch.setattr(
            restore_command,
            "store_settings",
            lambda over, node: self.done.append(("stored", over is network, node)),
        )


def test_a_drive_that_is_as_it_was_has_it_noted_in_its_journal(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    restored = Restored(monkeypatch, tmp_path, Restoration(4, 3))
    assert run_restore(restored.journal, None) == {
        "objects": 4,
        "written": 3,
        "complete": True,
        "failures": [],
        "stored": False,
        "text": ["4 objects, 3 had to be written", "everything is as it was, byte for byte"],
    }
    assert restored.done == [("hub:x", 500_000), (7, 5 * NS_PER_S), (7, MARK), "restored"]
    assert not restored.stores
    assert read_journal(restored.journal).restored


@pytest.mark.parametrize("failures", [[], ["6072h"]])
def test_a_drive_stores_only_what_is_as_it_was(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, failures: list[str]
) -> None:
    restored = Restored(monkeypatch, tmp_path, Restoration(4, 3, failures))
    outcome = run_restore(restored.journal, None, store=True)
    assert outcome["stored"] is not bool(failures)
    assert restored.done[4:] == ([] if failures else [("stored", True, 7)])
    assert restored.stores


def test_what_is_still_different_is_told_and_the_journal_waits(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    restored = Restored(monkeypatch, tmp_path, Restoration(4, 3, ["6072h", "6080h"]))
    assert run_restore(restored.journal, "socketcan:can0", store=True) == {
        "objects": 4,
        "written": 3,
        "complete": False,
        "failures": ["6072h", "6080h"],
        "stored": False,
        "text": ["4 objects, 3 had to be written", "still different: 6072h", "still different: 6080h"],
    }
    assert restored.done[0] == ("socketcan:can0", 500_000)
    assert not read_journal(restored.journal).restored


def test_a_bus_that_no_journal_has_is_refused_with_the_journal_s_name(tmp_path: Path) -> None:
    journal = Journal(tmp_path / "journal.jsonl", JournalHead("hubb:x", 7, MARK, None, None))
    journal.close()
    with pytest.raises(BadInput, match=rf"{journal.path}: bus: found 'hubb:x'.*did you mean 'hub'"):
        run_restore(journal.path, None)


@pytest.mark.parametrize("other", [(0x1B, 0x2B, 3), (0x1A, 0x2C, 3), (0x1A, 0x2B, 4)])
def test_another_drive_than_that_of_the_journal_is_refused(
    monkeypatch: pytest.MonkeyPatch, other: tuple[int, int, int]
) -> None:
    def objects_of(vendor: int, product: int, serial: int) -> Any:
        identity = Identity("x", vendor, product, 9, serial, 402)
        monkeypatch.setattr(restore_command, "read_identity", lambda _objects: identity)
        return SimpleNamespace(node_id=7)

    check_mark(objects_of(*MARK), MARK)
    with pytest.raises(PeerFault) as caught:
        check_mark(objects_of(*other), MARK)
    assert (caught.value.summary, caught.value.evidence, caught.value.remedy) == (
        "node 7 is not the drive of the journal",
        "vendor, product and serial number are {:X}h, {:X}h, {}; the journal is of 1Ah, 2Bh, 3".format(
            *other
        ),
        "connect the drive whose journal it is",
    )
