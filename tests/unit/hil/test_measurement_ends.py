"""Every way out of a measurement: rest, everything put back, and what failed told with what to do."""

from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from servobench.drivers.cia402.supervision import Release
from servobench.drivers.errors import PeerFault
from servobench.hil.execution import drive_session
from servobench.hil.execution.drive_session import DriveSession
from servobench.hil.measuring import measure
from servobench.hil.measuring.measure import Measurement

PUT_BACK = SimpleNamespace(complete=True, failures=[])


class Ends:
    """A measurement whose bench is made up: what is done, in its order."""

    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.done: list[Any] = []
        self.said: list[str] = []
        self.restored: dict[int, Any] = {1: PUT_BACK, 2: PUT_BACK}
        """By node: what comes of putting back, or what is raised."""
        self.releases = {1: Release(True, None), 2: Release(True, None)}
        self.subjects = [self._subject(node) for node in (1, 2)]
        self.journals = {node: self._journal(folder, node) for node in (1, 2)}
        self.measurement: Any = Measurement.__new__(Measurement)
        network = SimpleNamespace(
            journals=self.journals,
            putting_back=False,
            watch=lambda node, timeout: self.done.append(("watch", node, timeout)),
            fall_silent=lambda: self.done.append("silent"),
            clock=SimpleNamespace(now=lambda: 77),
        )
        parts = {
            "network": network,
            "folder": folder,
            "request": SimpleNamespace(enable=True, bus="hub:x", cycles=5, period_us=1000),
            "subjects": self.subjects,
            "say": self.said.append,
            "progress": lambda stage, _seconds: self.done.append(stage),
            "world": SimpleNamespace(
                clock=network.clock,
                settings_told=nullcontext,
                faults=SimpleNamespace(
                    stop=lambda: self.done.append("no faults"), finish=lambda: self.done.append("finish")
                ),
            ),
        }
        session: Any = DriveSession.__new__(DriveSession)
        session._world, self.measurement._session = parts["world"], session
        session.guard = SimpleNamespace(
            calm=lambda: self.done.append("calm"), end=lambda at, _zero: self.done.append(("end", at))
        )
        for name, part in parts.items():
            setattr(self.measurement, f"_{name}", part)
        monkeypatch.setattr(measure, "restore", self._restore)
        monkeypatch.setattr(
            drive_session,
            "stop_all",
            lambda drives: self.done.append(("stop", [drive.node_id for drive in drives])),
        )

    def _subject(self, node: int) -> Any:
        def release() -> Release:
            self.done.append(("release", node))
            return self.releases[node]

        drive = SimpleNamespace(name=f"node {node}", node_id=node, release=release)
        return SimpleNamespace(configured=True, drive=drive)

    def _journal(self, folder: Path, node: int) -> Any:
        path = folder / f"node{node}.jsonl"
        path.touch()
        return SimpleNamespace(
            path=path,
            contents=node,
            note_restored=lambda: self.done.append(("restored", node)),
            close=lambda: self.done.append(("close", node)),
        )

    def _restore(self, network: Any, node: int) -> Any:
        assert network.putting_back
        self.done.append(("restore", node))
        result = self.restored[node]
        if isinstance(result, PeerFault):
            raise result
        return result


@pytest.fixture
def ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Ends:
    folder = tmp_path / "measure-DATE"
    folder.mkdir()
    return Ends(folder, monkeypatch)


def test_everything_is_put_back_in_its_order_and_the_journals_are_gone(ends: Ends, tmp_path: Path) -> None:
    assert ends.measurement._leave() == []
    nodes = [[("restore", node), ("restored", node), ("watch", node, 0), ("close", node)] for node in (1, 2)]
    assert ends.done == [
        "putting back", "calm", "no faults", ("stop", [1, 2]), ("release", 1), ("release", 2), *nodes[0],
        *nodes[1], "silent", ("end", 77), "finish",
    ]  # fmt: skip
    assert (ends.said, list(tmp_path.iterdir())) == ([], [])


def test_a_folder_with_something_else_in_it_stays(ends: Ends) -> None:
    (ends.measurement._folder / "mine").touch()
    assert ends.measurement._leave() == []
    assert [path.name for path in ends.measurement._folder.iterdir()] == ["mine"]


@pytest.mark.parametrize(
    ("enable", "configured", "stopped", "released"),
    [(True, [1], [1], [1]), (False, [1, 2], [], [1, 2]), (True, [], [], [])],
)
def test_only_drives_that_were_configured_are_released_and_only_enabled_ones_stopped(
    ends: Ends, enable: bool, configured: list[int], stopped: list[int], released: list[int]
) -> None:
    ends.measurement._request.enable = enable
    for subject in ends.subjects:
        subject.configured = subject.drive.node_id in configured
    assert ends.measurement._leave() == []
    assert ("stop", stopped) in ends.done
    assert [each for each in ends.done if each[0] == "release"] == [("release", node) for node in released]


def test_a_drive_that_is_not_at_rest_is_told_and_keeps_its_journal(ends: Ends) -> None:
    ends.releases[1] = Release(False, None, "it turns on")
    ends.releases[2] = Release(True, None, "odd", unwatched="1016h holds another value")
    failures = ends.measurement._leave()
    assert failures == ["node 1 is not confirmed at rest: it turns on"]
    assert ends.said == ["node 2: 1016h holds another value", *failures]
    assert all(journal.path.exists() for journal in ends.journals.values())
    assert ends.done[-3:] == ["silent", ("end", 77), "finish"]


def test_what_could_not_be_put_back_is_told_with_the_command_that_does(ends: Ends) -> None:
    ends.restored = {
        1: PeerFault("no answer"),
        2: SimpleNamespace(complete=False, failures=["6040h is another", "6060h too"]),
    }
    commands = {node: f"hil restore {ends.journals[node].path}" for node in (1, 2)}
    failures = ends.measurement._leave()
    assert failures == ["no answer", commands[1], "6040h is another", "6060h too", commands[2]]
    assert ends.said == failures
    kept = [each for each in ends.done if isinstance(each, tuple) and each[0] in ("restored", "close")]
    assert kept == [("close", 1), ("close", 2)]
    assert all(journal.path.exists() for journal in ends.journals.values())


def test_an_error_of_the_run_comes_out_after_everything_was_put_back(
    ends: Ends, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(_measurement: Any) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr(Measurement, "_run", fails)
    ends.releases[1] = Release(False, None, "it turns on")
    with pytest.raises(KeyboardInterrupt):
        ends.measurement.to_the_end()
    assert ends.done[-1] == "finish"
    assert ends.said == ["node 1 is not confirmed at rest: it turns on"]


def test_a_measurement_after_which_something_is_not_as_it_was_is_a_fault(
    ends: Ends, monkeypatch: pytest.MonkeyPatch
) -> None:
    outcome = SimpleNamespace(cycles=2_000)
    monkeypatch.setattr(Measurement, "_run", lambda _measurement: (outcome, "syncs"))
    monkeypatch.setattr(Measurement, "_evaluated", lambda _measurement, *given: given)
    ends.measurement._timing = SimpleNamespace(period=1_000_000)
    assert ends.measurement.to_the_end() == (outcome, "syncs")
    assert ends.done[-1] == "evaluating"
    assert ends.measurement._seconds(2_000) == 2.0
    ends.releases = {node: Release(False, None, "no") for node in (1, 2)}
    for journal in ends.journals.values():
        journal.path.parent.mkdir(exist_ok=True)
        journal.path.touch()
    with pytest.raises(PeerFault) as failed:
        ends.measurement.to_the_end()
    rests = "; ".join(f"node {node} is not confirmed at rest: no" for node in (1, 2))
    assert str(failed.value) == f"not everything is as it was; {rests}"
    assert ends.done[-1] == "finish", "nothing is evaluated"
