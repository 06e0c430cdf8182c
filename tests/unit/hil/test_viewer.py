"""The viewer without a window, by a made-up client: pages, times, the cursor, when a picture is ready."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from servobench.drivers.errors import BadInput, PeerFault
from servobench.drivers.timebase import NS_PER_S
from servobench.hil.recorded import viewer
from servobench.hil.recorded.viewer import HeadlessViewer, page_file
from servobench.hil.recording import serving
from servobench.hil.recording.plot_scale import LANE_GUTTER
from servobench.virtual_bus.timeline import SimulatedClock, Timeline


def container(kind: str, name: str, *contents: str) -> dict[str, Any]:
    """As the viewer tells it; one content alone is no list."""
    inside: Any = list(contents) if len(contents) != 1 else contents[0]
    return {"ContainerBlueprint": {"container_kind": kind, "display_name": name, "contents": inside}}


def blueprint() -> dict[str, Any]:
    """Two pages beside a text, and one that has two inside."""
    return {
        "/container/root": container("Horizontal", "", "container/tabs", "view/text"),
        "/container/tabs": container("Tabs", "", "/container/one/", "container/zoom", "view/loose"),
        "/container/one": container("Vertical", "Overview", "view/a"),
        "/container/zoom": container("Vertical", "Zoom", "container/inner"),
        "/container/inner": container("Tabs", "", "container/left", "container/right"),
        "/container/left": container("Vertical", "axis1", "view/b"),
        "/container/right": container("Vertical", "axis2", "view/c"),
        "/view/a": {"ViewBlueprint": {"class_identifier": "TimeSeries"}},
        "/view/a/TimeAxis": {"TimeAxis": {"link": "LinkToGlobal"}},
        "/view/a/ScalarAxis": {"ScalarAxis": {"range": [-1.0, 1.0]}},
        "/view/b": {"ViewBlueprint": {"class_identifier": "StateTimeline"}},
        "/view/b/TimeAxis": {"TimeAxis": {"link": "LinkToGlobal"}},
    }


class Client:
    """A viewer that loads for so many looks, and whose picture changes for so many."""

    def __init__(self) -> None:
        self.tree = blueprint()
        self.loading = self.changing = 0
        self.reports: list[Any] = []
        self.recordings = [self.recording(("run_time", 2 * NS_PER_S), ("log_time", 9 * NS_PER_S))]
        self.sent: list[Any] = []
        self.pictures = 0

    @staticmethod
    def recording(*ends: tuple[str, int | None]) -> Any:
        return SimpleNamespace(timelines=[SimpleNamespace(name=name, end=end) for name, end in ends])

    def open(self, path: str) -> None:
        self.sent.append(("open", path))

    def get_state(self) -> Any:
        self.loading -= 1
        view = SimpleNamespace(name="Speed", reports=self.reports)
        return SimpleNamespace(loading=self.loading >= 0, recordings=self.recordings, views=[view])

    def get_blueprint(self) -> Any:
        return SimpleNamespace(blueprint=self.tree, store_id="store")

    def set_blueprint(self, tree: dict[str, Any], store_id: str) -> None:
        self.tree = tree
        self.sent.append(("blueprint", store_id))

    def run_command(self, command: str) -> None:
        self.sent.append(command)

    def set_time(self, timeline: str, duration: float, play_state: str) -> None:
        self.sent.append((timeline, duration, play_state))

    def take_screenshot(self) -> bytes:
        self.pictures += 1
        return bytes([min(self.pictures, self.changing)])


@pytest.fixture
def timeline(monkeypatch: pytest.MonkeyPatch) -> Timeline:
    made = Timeline()
    for module in (viewer, serving):
        monkeypatch.setattr(module, "MonotonicClock", lambda: SimulatedClock(made))
    return made


@pytest.fixture
def client() -> Client:
    return Client()


@pytest.fixture
def shown(client: Client, timeline: Timeline) -> HeadlessViewer:
    assert timeline.now == 0
    return HeadlessViewer(client)  # type: ignore[arg-type]


def test_pages_are_the_tabs_by_name(shown: HeadlessViewer) -> None:
    assert shown.pages() == ["overview", "zoom", "zoom/axis1", "zoom/axis2"]


def test_turning_to_a_page_puts_it_and_those_around_it_in_front(
    shown: HeadlessViewer, client: Client
) -> None:
    shown.turn_to("Zoom/AXIS2")
    assert client.tree["/container/tabs"]["ContainerBlueprint"]["active_tab"] == "/container/zoom"
    assert client.tree["/container/inner"]["ContainerBlueprint"]["active_tab"] == "/container/right"
    assert client.sent == [("blueprint", "store")]
    shown.turn_to("overview")
    assert client.tree["/container/tabs"]["ContainerBlueprint"]["active_tab"] == "/container/one"


def test_a_page_that_is_not_there_is_refused_with_those_that_are(
    shown: HeadlessViewer, client: Client
) -> None:
    with pytest.raises(BadInput, match="one of overview, zoom, zoom/axis1, zoom/axis2"):
        shown.turn_to("axis1")
    assert client.sent == []


def test_another_stretch_of_time_is_put_into_every_view_with_a_time_axis(
    shown: HeadlessViewer, client: Client
) -> None:
    """Lanes begin earlier by the gutter in which their names stand."""
    shown.look_at(1.0, 3.0)
    plot = client.tree["/view/a/TimeAxis"]["TimeAxis"]
    assert plot["link"] == "Independent"
    assert plot["view_range"] == {"start": {"Absolute": NS_PER_S}, "end": {"Absolute": 3 * NS_PER_S}}
    lanes = client.tree["/view/b/TimeAxis"]["TimeAxis"]["view_range"]
    assert lanes["start"] == {"Absolute": round((1.0 - LANE_GUTTER * 2.0) * NS_PER_S)}
    assert lanes["end"] == {"Absolute": 3 * NS_PER_S}
    assert "TimeAxis" not in client.tree["/view/a"]
    assert client.tree["/view/a/ScalarAxis"] == {"ScalarAxis": {"range": None}}, "as high as what is seen"
    assert client.sent == [("blueprint", "store")]


def test_the_cursor_is_put_at_an_instant_or_at_the_end(shown: HeadlessViewer, client: Client) -> None:
    client.recordings.append(client.recording(("run_time", 3 * NS_PER_S), ("run_time", None)))
    shown.put_cursor(0.5)
    shown.put_cursor(None)
    assert client.sent == [("run_time", 0.5, "paused"), ("run_time", 3.0, "paused")]
    client.recordings = [client.recording(("log_time", 5))]
    shown.put_cursor(0.5)
    assert len(client.sent) == 2, "there is no run time"


def test_a_picture_is_taken_when_nothing_moves_any_more(
    shown: HeadlessViewer, client: Client, timeline: Timeline, tmp_path: Path
) -> None:
    """After the greeting of 5 s, and looked at each 0.2 s."""
    client.loading, client.changing = 3, 4
    shown.show(tmp_path / "run.rrd")
    assert client.sent == [("open", str((tmp_path / "run.rrd").resolve()))]
    assert timeline.now == 0.6 * NS_PER_S
    assert shown.picture() == bytes([4])
    assert client.pictures == 5
    assert timeline.now == (0.6 + 5.0 + 5 * 0.2) * NS_PER_S
    shown.picture()
    assert timeline.now == pytest.approx((5.6 + 5 * 0.2 + 2 * 0.2) * NS_PER_S), "greeted once"


def test_a_picture_that_never_rests_is_taken_after_eight_seconds(
    shown: HeadlessViewer, client: Client, timeline: Timeline, tmp_path: Path
) -> None:
    client.changing = 255
    shown.show(tmp_path)
    shown.picture()
    assert client.pictures == 40
    assert timeline.now == (5.0 + 8.0) * NS_PER_S


def test_what_cannot_be_shown_is_refused(shown: HeadlessViewer, client: Client, tmp_path: Path) -> None:
    client.recordings = []
    with pytest.raises(BadInput, match="a recording that the viewer can read"):
        shown.show(tmp_path)
    client.loading = 1_000_000
    with pytest.raises(PeerFault, match="the viewer does not come to an end of loading"):
        shown.show(tmp_path)


def test_loading_may_take_five_minutes(
    shown: HeadlessViewer, client: Client, timeline: Timeline, tmp_path: Path
) -> None:
    client.loading = 1501
    shown.show(tmp_path)
    assert timeline.now == 300.2 * NS_PER_S, "at five minutes it is still waited for"
    client.loading = 1502
    with pytest.raises(PeerFault):
        shown.show(tmp_path)


def test_a_view_that_complains_is_an_error(shown: HeadlessViewer, client: Client, tmp_path: Path) -> None:
    shown.show(tmp_path)
    client.reports = [SimpleNamespace(summary="no data", details=None)]
    for ask in (shown.picture, lambda: shown.show(tmp_path)):
        with pytest.raises(PeerFault, match="the view 'Speed' reports: no data"):
            ask()


def test_what_is_opened_of_a_folder(tmp_path: Path) -> None:
    with pytest.raises(BadInput, match=r"the folder of a run, with its run\.rrd, of a commissioning"):
        page_file(tmp_path)
    run = tmp_path / "run.rrd"
    run.touch()
    assert page_file(tmp_path) == page_file(run) == run
    campaign = tmp_path / "campaign.rrd"
    campaign.touch()
    assert page_file(tmp_path) == campaign
    assert page_file(run) == run


@pytest.mark.parametrize(
    ("size", "commands"),
    [
        ((1920, 1080), []),
        ((1366, 768), ["ui.zoom_out_ui"] * 3),
        ((3840, 2160), ["ui.zoom_in_ui"] * 10),
        ((1920, 540), ["ui.zoom_out_ui"] * 5),
        ((800, 450), ["ui.zoom_out_ui"] * 5),
        ((8192, 8192), ["ui.zoom_in_ui"] * 30),
    ],
)
def test_a_page_is_drawn_as_large_as_its_window_holds_all_of_it(
    client: Client, size: tuple[int, int], commands: list[str]
) -> None:
    HeadlessViewer(client, size)  # type: ignore[arg-type]
    assert client.sent == commands
