"""Every way out of a commissioning: what is put back, what is noted, and what is told."""

from types import SimpleNamespace
from typing import Any, cast

import pytest

from drivers.errors import NoAnswer
from hil.commissioning import commission as module
from hil.commissioning.commission import _end_log, _finish
from hil.commissioning.report import Commissioned
from hil.commissioning.session import Session
from hil.restoring.restore import Restoration


class Ending:
    """A session at its end; ``done`` is what is done, in order."""

    def __init__(
        self,
        monkeypatch: pytest.MonkeyPatch,
        restoration: Restoration | Exception | None = None,
        *,
        store: bool = False,
        configured: bool = True,
        stores: bool = True,
    ) -> None:
        self.done: list[Any] = []
        contents = SimpleNamespace(originals=lambda: {"6072h": b"\1"})
        journal = SimpleNamespace(
            contents=contents,
            note_restored=lambda: self.done.append("noted"),
            close=lambda: self.done.append("closed"),
        )

        def restore(network: Any, asked: Any) -> Restoration:
            assert asked is contents
            assert network.putting_back is True
            self.done.append("restored")
            if isinstance(restoration, Exception):
                raise restoration
            assert restoration is not None
            return restoration

        def stored(_session: Session, result: Commissioned) -> None:
            self.done.append("stored")
            result.stored = stores

        monkeypatch.setattr(module, "restore", restore)
        monkeypatch.setattr(module, "_store", stored)
        monkeypatch.setattr(module, "_rest", lambda _session: self.done.append("at rest"))
        monkeypatch.setattr(module, "set_objects", lambda _session: {"6072h": b"\2"})
        self.network: Any = SimpleNamespace(
            journal=journal,
            putting_back=False,
            fall_silent=lambda: self.done.append("silent"),
            watch=lambda *asked: self.done.append(asked),
        )
        self.session: Any = SimpleNamespace(
            network=self.network,
            found=SimpleNamespace(settings={}, originals={}),
            configured=configured,
            request=SimpleNamespace(node=5, store=store, restore_command="hil restore X"),
            guard=SimpleNamespace(end=lambda now: self.done.append(f"guarded until {now}")),
            clock_now=77,
            dialog=SimpleNamespace(tell=lambda text: self.done.append(text)),
        )

    def finish(self, **result: Any) -> Commissioned:
        made = Commissioned(**result)
        _finish(cast(Session, self.session), made)
        return made


LAST = ["guarded until 77", "silent", (5, 0), "closed"]
TOLD = "not everything is as it was: hil restore X"


def test_a_drive_is_put_back_and_the_journal_told_so(monkeypatch: pytest.MonkeyPatch) -> None:
    ending = Ending(monkeypatch, Restoration(3, 2))
    result = ending.finish()
    assert ending.done == ["at rest", "restored", "noted", *LAST]
    assert result.restoration == Restoration(3, 2)
    assert (ending.session.found.settings, ending.session.found.originals) == (
        {"6072h": b"\2"},
        {"6072h": b"\1"},
    )


def test_what_is_not_put_back_waits_in_the_journal(monkeypatch: pytest.MonkeyPatch) -> None:
    ending = Ending(monkeypatch, Restoration(3, 2, ["6072h"]))
    ending.finish()
    assert ending.done == ["at rest", "restored", *LAST, TOLD]


def test_a_drive_that_cannot_be_put_back_is_left_with_the_command_that_does(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ending = Ending(monkeypatch, NoAnswer("it is gone"))
    with pytest.raises(NoAnswer):
        ending.finish()
    assert ending.done == ["at rest", "restored", *LAST, TOLD]


def test_a_drive_that_was_never_set_up_need_not_be_brought_to_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    ending = Ending(monkeypatch, Restoration(), configured=False)
    ending.finish()
    assert ending.done == ["restored", "noted", *LAST]


@pytest.mark.parametrize(("stores", "told"), [(True, []), (False, [TOLD])])
def test_what_was_asked_to_be_stored_is_not_put_back(
    monkeypatch: pytest.MonkeyPatch, stores: bool, told: list[str]
) -> None:
    ending = Ending(monkeypatch, store=True, stores=stores)
    ending.finish()
    assert ending.done == ["at rest", "stored", *LAST, *told]


def test_after_an_error_nothing_is_stored(monkeypatch: pytest.MonkeyPatch) -> None:
    ending = Ending(monkeypatch, Restoration(), store=True)
    ending.finish(error=NoAnswer("it is gone"))
    assert ending.done == ["at rest", "restored", "noted", *LAST]


def test_without_a_journal_nothing_was_changed(monkeypatch: pytest.MonkeyPatch) -> None:
    ending = Ending(monkeypatch)
    ending.network.journal = None
    assert ending.finish().restoration is None
    assert ending.done == []


@pytest.mark.parametrize(
    ("result", "failed", "events"),
    [
        (Commissioned(), "", []),
        (
            Commissioned(restoration=Restoration(3, 2)),
            "",
            [("INFO", "3 objects hold again what they held before")],
        ),
        (
            Commissioned(restoration=Restoration(3, 2, ["a", "b"])),
            "",
            [("ERROR", "not put back: a"), ("ERROR", "not put back: b")],
        ),
        (Commissioned(stored=True), "", [("INFO", "the settings were stored in the drive (1010h)")]),
        (Commissioned(), "no space", ["the recording ends early: no space"]),
    ],
)
def test_the_recording_ends_with_how_the_drive_was_left(
    result: Commissioned, failed: str, events: list[Any]
) -> None:
    told: list[Any] = []

    def close() -> None:
        told.append("closed")

    log = SimpleNamespace(event=lambda level, text: told.append((level, text)), close=close, failed=failed)
    _end_log(cast(Session, SimpleNamespace(log=log, dialog=SimpleNamespace(tell=told.append))), result)
    place = len(events) - bool(failed)
    assert told == [*events[:place], "closed", *events[place:]]
