"""The Rerun viewer as a process of its own, without a window: pages of a recording as pictures.

What is drawn is what a user sees on opening the file; the layout is the one that is in it, with another page
in front or another stretch of time, if that was asked for.
"""

import math
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from rerun.experimental import ViewerClient

from servobench.drivers.errors import BadInput, PeerFault, printable
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Instant, MonotonicClock
from servobench.hil.recorded.commissioning_page import commissioning_page, is_commissioning
from servobench.hil.recording.blueprint import ZOOM_PAGE
from servobench.hil.recording.page_series import TIMELINE
from servobench.hil.recording.plot_scale import LANE_GUTTER
from servobench.hil.recording.serving import choose_ports, comes_to_listen, free_port, serve_file
from servobench.hil.rows.recording_plan import LOOPBACK, ServedPorts
from servobench.hil.rows.run_files import CAMPAIGN_PAGE, RERUN_FILE, not_a_recording
from servobench.hil.rows.seal import seal_of
from servobench.virtual_bus.child_python import python_command, python_environment

LAID_OUT_FOR: Final = 1920, 1080
"""Points, width and height, in which the pages have room for all lanes, labels and words."""
_ZOOM_STEP, _ZOOM_LEAST, _ZOOM_MOST = 0.1, 0.5, 4.0
"""Of the viewer's own commands."""
_LOAD_MAX_NS: Final = 300 * NS_PER_S
"""An hour with three axes takes half a minute on two slow processors."""
_GREETING_NS: Final = 5 * NS_PER_S
"""For so long the viewer shows a notice over the page."""
_SETTLE_TRIES: Final = 40
"""At :data:`_POLL_NS`: eight seconds for a page to stop changing."""
_EVIDENCE_MAX: Final = 200
"""Characters of what a viewer said last; its logs are long."""
_POLL_NS: Final = 200 * NS_PER_MS
"""Nobody sees a fifth of a second where a picture takes several."""
_REMEDY: Final = (
    "it needs a Vulkan driver, for which a software one will do: apt-get install mesa-vulkan-drivers"
)


class HeadlessViewer:
    """One viewer; :meth:`show` first."""

    def __init__(self, client: ViewerClient, size: tuple[int, int] = LAID_OUT_FOR) -> None:
        """``size``: of its window, px; a page is drawn smaller or larger in it, and is all there."""
        self._client = client
        steps = round((zoom_of(size) - 1.0) / _ZOOM_STEP)
        for _ in range(abs(steps)):
            self._client.run_command("ui.zoom_in_ui" if steps > 0 else "ui.zoom_out_ui")
        self._clock = MonotonicClock()
        self._shown_at = Instant(0)

    def show(self, recording: Path) -> None:
        """Open a recording. Raises BadInput if it cannot be read, PeerFault if a view complains."""
        self._client.open(str(recording.resolve()))
        give_up = self._clock.now() + _LOAD_MAX_NS
        while self._client.get_state().loading:
            if self._clock.now() > give_up:
                raise PeerFault(f"the viewer does not come to an end of loading {recording}", "")
            self._wait(_POLL_NS)
        if not self._client.get_state().recordings:
            raise BadInput("RUN", "", str(recording), "a recording that the viewer can read")
        self._check_views()
        self._shown_at = self._clock.now()

    def pages(self) -> list[str]:
        """Names of the pages, those inside others as "Zoom/axis1"."""
        return list(_pages(self._client.get_blueprint().blueprint))

    def turn_to(self, page: str) -> None:
        """Put a page in front. Raises BadInput for one that is not there."""
        shown = self._client.get_blueprint()
        pages = _pages(shown.blueprint)
        tabs_in_front = pages.get(page.casefold())
        if tabs_in_front is None:
            raise BadInput("--page", "", page, f"one of {', '.join(pages)}")
        for tabs, page_path in tabs_in_front:
            shown.blueprint[tabs]["ContainerBlueprint"]["active_tab"] = page_path
        self._client.set_blueprint(shown.blueprint, store_id=shown.store_id)

    def look_at(self, begin_s: float, end_s: float) -> None:
        """Show another stretch of time in all views, run time, and plots as high as what is seen in it."""
        shown = self._client.get_blueprint()
        for path, archetypes in shown.blueprint.items():
            if "ScalarAxis" in archetypes:
                archetypes["ScalarAxis"]["range"] = None
            if "TimeAxis" not in archetypes:
                continue
            view = shown.blueprint.get(path.removesuffix("/TimeAxis"), {}).get("ViewBlueprint", {})
            lanes = view.get("class_identifier") != "TimeSeries"
            begin = begin_s - (LANE_GUTTER * (end_s - begin_s) if lanes else 0.0)
            window = {
                name: {"Absolute": round(at * NS_PER_S)} for name, at in (("start", begin), ("end", end_s))
            }
            archetypes["TimeAxis"] = {"link": "Independent", "view_range": window}
        self._client.set_blueprint(shown.blueprint, store_id=shown.store_id)

    def put_cursor(self, at_s: float | None) -> None:
        """At an instant of the run time, where there is one; None: at its end."""
        if ends := self._ends():
            cursor_s = max(ends) / NS_PER_S if at_s is None else at_s
            self._client.set_time(TIMELINE, duration=cursor_s, play_state="paused")

    def picture(self) -> bytes:
        """The whole window as PNG, when it does not change any more. Raises PeerFault if a view complains."""
        self._wait(max(0, self._shown_at + _GREETING_NS - self._clock.now()))
        last = b""
        for _ in range(_SETTLE_TRIES):
            self._wait(_POLL_NS)
            screenshot = self._client.take_screenshot()
            if screenshot == last:
                break
            last = screenshot
        self._check_views()
        return last

    def _check_views(self) -> None:
        for view in self._client.get_state().views:
            for report in view.reports:
                raise PeerFault(f"the view {view.name!r} reports: {report.summary}", report.details or "")

    def _ends(self) -> list[int]:
        """Return the end of each recording, in run time."""
        return [
            timeline.end
            for recording in self._client.get_state().recordings
            for timeline in recording.timelines
            if timeline.name == TIMELINE and timeline.end is not None
        ]

    def _wait(self, duration_ns: int) -> None:
        self._clock.sleep_until(Instant(self._clock.now() + duration_ns))


def zoom_of(size: tuple[int, int]) -> float:
    """Return how large the viewer has to draw so that a window of ``size``, px, holds a page."""
    zoom = min(own / laid_out for own, laid_out in zip(size, LAID_OUT_FOR, strict=True))
    steps = math.floor(round(zoom / _ZOOM_STEP, 6))
    return min(max(_ZOOM_STEP * steps, _ZOOM_LEAST), _ZOOM_MOST)


def _untold(_seal: str) -> None:
    """Nobody asks what the seal says."""


def page_file(run: Path, *, unsealed: bool = False, tell_seal: Callable[[str], None] = _untold) -> Path:
    """Return the file the viewer opens for a folder: run.rrd of a run or of a campaign, or that of a
    commissioning, made now; a file is returned unchanged.

    ``unsealed``: whether or not the files of a run are as they were recorded. ``tell_seal`` is told how they
    are sealed. Raises BadInput.
    """
    if run.is_dir() and is_commissioning(run):
        return commissioning_page(run)
    if (run / CAMPAIGN_PAGE).is_file():
        return run / CAMPAIGN_PAGE
    if run.is_file() and run.suffix != ".rrd":
        raise not_a_recording(run, RERUN_FILE)
    recording = run / RERUN_FILE if run.is_dir() else run
    if not recording.is_file():
        expected = (
            f"the folder of a run, with its {RERUN_FILE}, of a commissioning, or of a reported campaign"
        )
        raise BadInput("RUN", "", str(run), expected)
    tell_seal(seal_of(recording.parent, unsealed=unsealed))
    return recording


def draw_page(
    run: Path,
    page: str | None = None,
    at_s: float | None = None,
    window_s: tuple[float | None, float | None] = (None, None),
    *,
    size: tuple[int, int] = LAID_OUT_FOR,
    unsealed: bool = False,
    tell_seal: Callable[[str], None] = _untold,
) -> bytes:
    """A page of the run or commissioning in a folder, or of a run.rrd, as PNG.

    ``at_s``: the cursor, None: at the end. ``window_s``: from when to when, None: as the page opens.
    ``size``: of the picture, px. ``unsealed``, ``tell_seal``: as :func:`page_file`. Raises BadInput, and
    PeerFault if the viewer cannot run here.
    """
    recording = page_file(run, unsealed=unsealed, tell_seal=tell_seal)
    with headless_viewer(size) as viewer:
        viewer.show(recording)
        if page is not None:
            viewer.turn_to(page)
        begin_s, end_s = window_s
        if begin_s is not None and end_s is not None:
            if page is None:
                _turn_to_single_rows(viewer)
            viewer.look_at(begin_s, end_s)
        viewer.put_cursor(at_s)
        return viewer.picture()


def open_at(recording: Path, at_s: float, span_s: float | None) -> None:
    """A viewer with a window that outlives this process, the cursor at an instant of the run time.

    ``span_s``: so much time about it, None: as the page opens. Raises PeerFault if it does not run here.
    """
    process, port = _start_viewer("--bind", LOOPBACK)
    viewer = HeadlessViewer(_connect(process, port))
    viewer.show(recording)
    if span_s is not None:
        _turn_to_single_rows(viewer)
        viewer.look_at(at_s - span_s / 2, at_s + span_s / 2)
    viewer.put_cursor(at_s)


def serve(recording: Path, tell: Callable[[ServedPorts], None], stopped: Callable[[], bool]) -> None:
    """Serve a recording to browsers and viewers of this machine until ``stopped``; ``tell`` is told where.

    Raises PeerFault if the server does not come up, or ends by itself.
    """
    clock, ports = MonotonicClock(), choose_ports()
    process = serve_file(ports, recording)
    try:
        for port in ports:
            _await(process, port)
        tell(ports)
        while not stopped():
            if process.poll() is not None:
                raise _gone(process)
            clock.sleep_until(Instant(clock.now() + _POLL_NS))
    finally:
        process.kill()
        process.wait()


def _turn_to_single_rows(viewer: HeadlessViewer) -> None:
    """A part of a run is looked at where each cycle is drawn: the first page has envelopes of the whole."""
    if ZOOM_PAGE.casefold() in viewer.pages():
        viewer.turn_to(ZOOM_PAGE)


def _start_viewer(*options: str) -> "tuple[subprocess.Popen[bytes], int]":
    """A viewer in a session of its own, and the port at which it is spoken to."""
    port = free_port()
    process = subprocess.Popen(
        python_command("rerun_cli", *options, "--port", str(port), "--hide-welcome-screen"),
        env=python_environment(),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )
    return process, port


@contextmanager
def headless_viewer(size: tuple[int, int] = LAID_OUT_FOR) -> Iterator[HeadlessViewer]:
    """A viewer that ends with the block. Raises PeerFault if it cannot run here."""
    window = "x".join(map(str, size))
    process, port = _start_viewer("--headless", "--bind", LOOPBACK, "--window-size", window)
    try:
        yield HeadlessViewer(_connect(process, port), size)
    except ConnectionError:  # it listens before it looks for a graphics driver
        raise _gone(process) from None
    finally:
        # The command is a shim; its child, the viewer, ends with the session's leader's group.
        subprocess.run(["kill", "--", f"-{process.pid}"], check=False, stderr=subprocess.DEVNULL)
        if process.stderr is not None and not process.stderr.closed:
            process.communicate()


def _pages(blueprint: dict[str, Any]) -> dict[str, list[tuple[str, str]]]:
    """By a page's name, in small letters: which tabs have to be in front, as tabs and what is in them."""
    containers = {
        path.strip("/"): archetypes["ContainerBlueprint"]
        for path, archetypes in blueprint.items()
        if "ContainerBlueprint" in archetypes
    }
    pages: dict[str, list[tuple[str, str]]] = {}

    def inside(path: str) -> list[str]:
        contents = containers.get(path, {}).get("contents", [])
        return [each.strip("/") for each in ([contents] if isinstance(contents, str) else contents)]

    def look_in(path: str, above: list[tuple[str, str]], name: str) -> None:
        for inner in inside(path):
            tabs = containers[path].get("container_kind") == "Tabs"
            if not tabs or inner not in containers:
                look_in(inner, above, name)
                continue
            own = "/".join(filter(None, (name, containers[inner].get("display_name", "").casefold())))
            pages[own] = [*above, (f"/{path}", f"/{inner}")]
            look_in(inner, pages[own], own)

    inner = {each for path in containers for each in inside(path)}
    for path in containers:
        if path not in inner:
            look_in(path, [], "")
    return pages


def _connect(process: "subprocess.Popen[bytes]", port: int) -> ViewerClient:
    _await(process, port)
    return ViewerClient.connect(f"rerun+http://{LOOPBACK}:{port}/proxy")


def _await(process: "subprocess.Popen[bytes]", port: int) -> None:
    """Return when the process listens. Raises PeerFault if it does not come to that."""
    if not comes_to_listen(process, port):
        raise _gone(process)


def _gone(process: "subprocess.Popen[bytes]") -> PeerFault:
    """Return the error for a viewer that has ended, with its last words."""
    subprocess.run(["kill", "--", f"-{process.pid}"], check=False, stderr=subprocess.DEVNULL)
    said = (process.communicate()[1] or b"").decode(errors="replace").strip().splitlines()
    complaint = next((line for line in said if "adapter" in line or "panicked" in line), "".join(said[-1:]))
    return PeerFault("the Rerun viewer does not run here", printable(complaint)[:_EVIDENCE_MAX], _REMEDY)
