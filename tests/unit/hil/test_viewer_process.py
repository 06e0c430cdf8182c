"""The viewer as a process: how it is started, waited for, ended, and what is told where it does not run."""

import errno
import socket
import subprocess
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import pytest

from servobench.drivers.errors import BadInput, PeerFault
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S
from servobench.hil.recorded import viewer
from servobench.hil.recorded.viewer import HeadlessViewer, draw_page, headless_viewer, page_file
from servobench.virtual_bus.timeline import Timeline
from tests.unit.hil.test_viewer import Client, timeline

__all__ = ["timeline"]

PORT: Final = 40_000
REMEDY: Final = (
    "it needs a Vulkan driver, for which a software one will do: apt-get install mesa-vulkan-drivers"
)


class Machine:
    """Processes and sockets, in the place of the real ones."""

    pid = 4711

    def __init__(self) -> None:
        self.log: list[object] = []
        self.options: dict[str, Any] = {}
        self.said: bytes | None = b""
        self.refusals = 0
        """So often nobody listens yet."""
        self.ends_after: int | None = None
        """So often it is found running; None: always."""
        self.stderr = SimpleNamespace(closed=False)

    # ---- the process -----------------------------------------------------------------------------------

    def start(self, command: list[str], **options: Any) -> "Machine":
        self.log.append(command[1:])
        self.options = options
        return self

    def run(self, command: list[str], *, check: bool, stderr: int) -> None:
        assert (check, stderr) == (False, subprocess.DEVNULL)
        self.log.append(command)

    def poll(self) -> int | None:
        if self.ends_after == 0:
            return 1
        if self.ends_after is not None:
            self.ends_after -= 1
        return None

    def communicate(self) -> tuple[None, bytes | None]:
        self.log.append("its end")
        self.stderr.closed = True
        return None, self.said

    # ---- its port --------------------------------------------------------------------------------------

    def __enter__(self) -> "Machine":
        return self

    def __exit__(self, *_error: object) -> None:
        pass

    def bind(self, address: tuple[str, int]) -> None:
        assert address == ("127.0.0.1", 0)

    def getsockname(self) -> tuple[str, int]:
        return "127.0.0.1", PORT

    def connect_ex(self, address: tuple[str, int]) -> int:
        assert address == ("127.0.0.1", PORT)
        self.refusals -= 1
        return errno.ECONNREFUSED if self.refusals >= 0 else 0


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch, timeline: Timeline) -> Machine:
    made = Machine()
    assert timeline.now == 0
    monkeypatch.setattr(subprocess, "Popen", made.start)
    monkeypatch.setattr(subprocess, "run", made.run)
    monkeypatch.setattr(socket, "socket", lambda: made)
    monkeypatch.setattr(viewer, "ViewerClient", SimpleNamespace(connect=lambda url: made.log.append(url)))
    return made


STARTED: Final = [
    *("-P", "-m", "rerun_cli", "--headless", "--bind", "127.0.0.1", "--window-size", "1920x1080"),
    *("--port", str(PORT), "--hide-welcome-screen"),
]
CONNECTED: Final = f"rerun+http://127.0.0.1:{PORT}/proxy"
KILLED: Final = ["kill", "--", "-4711"]


def test_a_viewer_is_started_reached_and_ended_with_its_session(machine: Machine, timeline: Timeline) -> None:
    with headless_viewer() as shown:
        assert isinstance(shown, HeadlessViewer)
        assert machine.log == [STARTED, CONNECTED]
    assert machine.log[2:] == [KILLED, "its end"]
    assert timeline.now == 0
    assert machine.options["stderr"] == subprocess.PIPE
    assert machine.options["stdin"] == machine.options["stdout"] == subprocess.DEVNULL
    assert machine.options["start_new_session"] is True
    assert "PYTHONPATH" in machine.options["env"]


def test_it_is_ended_where_what_is_done_with_it_fails_too(machine: Machine) -> None:
    with pytest.raises(ZeroDivisionError), headless_viewer():
        raise ZeroDivisionError
    assert machine.log[2:] == [KILLED, "its end"]


@pytest.mark.parametrize("refusals", [1, 149])
def test_it_is_asked_each_fifth_of_a_second_until_it_listens(
    machine: Machine, timeline: Timeline, refusals: int
) -> None:
    machine.refusals = refusals
    with headless_viewer():
        assert timeline.now == refusals * 200 * NS_PER_MS


def gone(within: Callable[[], AbstractContextManager[object]] = headless_viewer) -> PeerFault:
    with pytest.raises(PeerFault) as caught, within():
        raise AssertionError("there is a viewer")
    return caught.value


def test_after_half_a_minute_it_is_given_up(machine: Machine, timeline: Timeline) -> None:
    machine.refusals = 150
    assert gone().summary == "the Rerun viewer does not run here"
    assert timeline.now == 30 * NS_PER_S
    assert machine.log == [STARTED, KILLED, "its end", KILLED], "what it said is read once"


@pytest.mark.parametrize(
    ("said", "told"),
    [
        (b"", ""),
        (None, ""),
        (b"one\ntwo\n", "two"),
        (b"\nno adapter found\nthe end\n", "no adapter found"),
        (b"it panicked\nno adapter\n", "it panicked"),
        (b"x" * 300, "x" * 200),
        (b"a\xff\x1b[1mb", "a\N{REPLACEMENT CHARACTER}\\x1b[1mb"),
    ],
)
def test_of_one_that_ends_what_it_said_is_told(
    machine: Machine, timeline: Timeline, said: bytes | None, told: str
) -> None:
    machine.refusals, machine.ends_after, machine.said = 1_000, 3, said
    fault = gone()
    assert (fault.summary, fault.evidence, fault.remedy) == (
        "the Rerun viewer does not run here",
        told,
        REMEDY,
    )
    assert timeline.now == 3 * 200 * NS_PER_MS


def test_one_that_listens_and_then_finds_no_graphics_is_told_alike(machine: Machine) -> None:
    machine.said = b"no adapter\n"
    with pytest.raises(PeerFault, match="the Rerun viewer does not run here") as caught, headless_viewer():
        raise ConnectionError
    assert caught.value.evidence == "no adapter"
    assert caught.value.__cause__ is None
    assert machine.log == [STARTED, CONNECTED, KILLED, "its end", KILLED]


@pytest.mark.parametrize(
    ("page", "at_s", "window_s", "calls"),
    [
        (None, None, (None, None), [("cursor", None)]),
        ("Timing", 0.5, (1.0, 2.0), [("page", "Timing"), ("window", 1.0, 2.0), ("cursor", 0.5)]),
        (None, 0.0, (0.0, 0.0), [("page", "Zoom"), ("window", 0.0, 0.0), ("cursor", 0.0)]),
        ("x", None, (1.0, None), [("page", "x"), ("cursor", None)]),
        ("x", None, (None, 1.0), [("page", "x"), ("cursor", None)]),
    ],
)
def test_a_page_is_turned_to_moved_and_taken(
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    page: str | None,
    at_s: float | None,
    window_s: tuple[float | None, float | None],
    calls: list[object],
) -> None:
    log: list[object] = []
    shown = SimpleNamespace(
        show=lambda path: log.append(("show", path)),
        pages=lambda: ["overview", "zoom"],
        turn_to=lambda name: log.append(("page", name)),
        look_at=lambda begin_s, end_s: log.append(("window", begin_s, end_s)),
        put_cursor=lambda at_s: log.append(("cursor", at_s)),
        picture=lambda: b"PNG",
    )

    @contextmanager
    def viewers(size: tuple[int, int]) -> Iterator[Any]:
        assert size == (1920, 1080)
        log.append("begins")
        yield shown
        log.append("ends")

    monkeypatch.setattr(viewer, "headless_viewer", viewers)
    (tmp_path / "run.rrd").touch()
    assert draw_page(tmp_path, page, at_s, window_s) == b"PNG"
    assert log == ["begins", ("show", tmp_path / "run.rrd"), *calls, "ends"]


def test_what_is_no_recording_needs_no_viewer(machine: Machine, tmp_path: Path) -> None:
    with pytest.raises(BadInput) as caught:
        draw_page(tmp_path / "missing")
    expected = "the folder of a run, with its run.rrd, of a commissioning, or of a reported campaign"
    assert str(caught.value) == f"RUN: found '{tmp_path / 'missing'}', expected {expected}"
    assert machine.log == []


def test_of_a_commissioning_the_page_is_made(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    made: list[Path] = []

    def make(folder: Path) -> Path:
        made.append(folder)
        return folder / "page.rrd"

    monkeypatch.setattr(viewer, "commissioning_page", make)
    (tmp_path / "recording").mkdir()
    (tmp_path / "recording" / "frames.arrow").touch()
    assert page_file(tmp_path) == tmp_path / "page.rrd"
    assert made == [tmp_path]


def test_a_loaded_recording_is_greeted_from_the_moment_that_it_is_there(
    timeline: Timeline, tmp_path: Path
) -> None:
    """Of a picture that is taken 7 s later the greeting is over."""
    client = Client()
    shown = HeadlessViewer(client)  # type: ignore[arg-type]
    shown.show(tmp_path)
    timeline.run_until(timeline.now + 7 * NS_PER_S)  # type: ignore[arg-type]
    shown.picture()
    assert timeline.now == 7 * NS_PER_S + 2 * 200 * NS_PER_MS
