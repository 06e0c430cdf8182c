"""The page of a commissioning: its lanes and their colours, its plots with their ranges and heights."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import rerun as rr
import rerun.blueprint as rrb

from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.timebase import NS_PER_S
from servobench.hil.recorded import commissioning_page as commissioned
from servobench.hil.recorded.commissioning_page import _Bus, _Figures, _Step
from servobench.hil.reviewing.envelope import Envelope
from servobench.hil.reviewing.trace.node_objects import KnownNodes
from servobench.hil.reviewing.trace.trace_entry import TraceEntry
from tests.unit.hil.test_blueprint_pages import names, parts, paths, value_range, window_s

GOOD, RED, DIM, AMBER = 0x1565C0FF, 0xD7230AFF, 0x9C9FA4FF, 0xFFFA46FF


class Stream:
    """In the place of Rerun's: what was sent, by entity."""

    def __init__(self) -> None:
        self.styles: dict[str, Any] = {}
        self.rows: dict[str, list[Any]] = {}

    def log(self, path: str, what: Any, *, static: bool) -> None:
        assert static
        self.styles[path] = what

    def send_columns(self, path: str, times: Any, columns: Any) -> None:
        (column,) = times
        instants = [int(at) for at in column.as_arrow_array().cast("int64").to_pylist()]
        batches = [batch.as_arrow_array().to_pylist() for batch in columns]
        self.rows.setdefault(path, []).extend(zip(instants, *batches, strict=True))


def step(name: str, verdict: str) -> _Step:
    return _Step(name, f"The {name}", verdict, (), (), "", "")


def lane_of(events: list[dict[str, Any]], *steps: _Step) -> Any:
    return commissioned._steps(events, _Figures(steps))


def begun(at_ns: int, name: str) -> dict[str, Any]:
    return {"at_ns": at_ns, "track": "step", "state": name}


def test_a_step_that_is_begun_again_has_its_colour_once() -> None:
    events = [begun(1, "a"), begun(2, "b"), begun(3, "a"), {"at_ns": 4, "track": "drive", "state": "x"}]
    lane = lane_of(events, step("a", "done"), step("b", "failed"))
    assert lane.colors == {"The a": GOOD, "The b": RED}
    assert lane.times == [1, 2, 3]
    assert commissioned._told(events) == []


def test_without_a_step_there_is_no_lane_and_texts_begin_with_their_time() -> None:
    events = [{"at_ns": 1_234_567_890, "level": "WARN", "text": "it turns"}]
    assert lane_of(events).times == []
    stream = Stream()
    commissioned._send_texts(cast(rr.RecordingStream, stream), commissioned._told(events))
    assert list(stream.rows) == ["/events"]
    ((at_ns, *cells),) = stream.rows["/events"]
    assert (at_ns, sorted(map(str, cells))) == (1_234_567_890, ["['1.235 s  it turns']", "['WARN']"])


# ---- what the frames tell ------------------------------------------------------------------------------


def bus(*entries: TraceEntry, zero_ns: int | None = None) -> _Bus:
    found = _Bus(cast(Any, ()), KnownNodes(), zero_ns)
    held: dict[Object, list[tuple[int, float]]] = {index: [] for index in commissioned._SIGNALS}
    for entry in entries:
        assert entry.at_ns is not None
        found._take(entry, entry.at_ns, held)
    found.signals = {
        index: signal(*(value for _, value in points)) for index, points in held.items() if points
    }
    return found


def entry(at_ns: int, kind: str, *values: Any, text: str = "") -> TraceEntry:
    return cast(TraceEntry, SimpleNamespace(at_ns=at_ns, kind=kind, values=values, text=text))


def value(index: Object, si: float | None = None, words: str = "") -> Any:
    return SimpleNamespace(index=index, si=si, words=words)


def signal(*values: float) -> Envelope:
    made = Envelope()
    made.add(np.arange(len(values), dtype=np.int64) * 1_000, np.array(values))
    return made


SPEED, TORQUE = Object.VELOCITY_ACTUAL_VALUE, Object.TORQUE_ACTUAL_VALUE


def test_signals_come_by_pdo_alone_and_states_by_sdo_too() -> None:
    found = bus(
        entry(100, "sdo", value(Object.STATUSWORD, words="switched on"), value(SPEED, 9.0)),
        entry(110, "pdo", value(Object.STATUSWORD, words="switched on"), value(SPEED, np.pi), value(TORQUE)),
        entry(120, "pdo", value(Object.STATUSWORD, words="fault"), value(Object.STATUSWORD)),
        entry(130, "emcy", value(SPEED, 5.0), text="4310h"),
        entry(140, "heartbeat", value(Object.STATUSWORD, words="x")),
    )
    assert found.states == [(0, "Switched on"), (20, "Fault")], "from the first frame on"
    assert found.emergencies == [(30, "4310h")]
    assert list(found.signals) == [SPEED]
    assert list(found.ends("speed")) == pytest.approx([30.0, 30.0]), "r/min"
    assert list(found.ends("torque")) == []
    assert found.end_ns == 40
    assert bus(entry(100, "emcy"), zero_ns=90).emergencies == [(10, "")], "from where the events begin"


def test_what_the_bus_told_is_drawn_in_its_lanes_lines_and_events() -> None:
    found = bus(entry(0, "pdo", value(Object.STATUSWORD, words="fault"), value(TORQUE, 0.5)))
    found.emergencies = [(2 * NS_PER_S, "4310h")]
    stream = Stream()
    commissioned._send_bus(cast(rr.RecordingStream, stream), found)
    assert list(stream.rows) == ["/events", "/torque/6077h"]
    lane = commissioned._drive(found)
    assert (lane.track, lane.times, lane.labels) == ("drive", [0], ["Fault"])
    assert lane.colors["Fault"] == RED
    assert "2.000 s  4310h" in str(stream.rows["/events"])
    assert stream.rows["/torque/6077h"][0][:2] == (0, [0.5])


# ---- the layout ------------------------------------------------------------------------------------------


def laid_out(found: _Bus, end_s: float = 10.0) -> tuple[Any, Any]:
    """The column of plots, and what stands at its right."""
    lanes = [commissioned._Lane("step", [0], ["One"], {"One": GOOD})]
    root = commissioned._layout(found, lanes, end_s).root_container
    assert isinstance(root, rrb.Horizontal)
    assert root.column_shares == [6.5, 3.5]
    left, right = parts(root)
    return left, right


def test_there_is_a_plot_for_each_quantity_that_was_on_the_bus() -> None:
    found = bus()
    found.signals = {
        TORQUE: signal(1.0, 3.0),
        SPEED: signal(0.0, 5.0),
        Object.TARGET_VELOCITY: signal(-5.0, 0.0),
    }
    left, right = laid_out(found)
    assert names(left) == ["Steps and states", "Speed [r/min]", "Torque [N m]"]
    assert paths(left) == {
        "Steps and states": ["/state"],
        "Speed [r/min]": ["/speed/**"],
        "Torque [N m]": ["/torque/**"],
    }
    assert [value_range(view) for view in parts(left)[1:]] == [
        pytest.approx([-6.5, 6.5]),
        pytest.approx([0.7, 3.3]),
    ]
    # the labels at the left of a plot, which lanes do not have: 1 000 in most runs, here -6 and 1.0
    assert [window_s(view) for view in parts(left)] == [
        pytest.approx((-0.2 - 10.4 * wider, 10.2)) for wider in (31 / 988, 17.6 / 1344, 25.2 / 1344)
    ]
    assert [(view.origin, view.name) for view in parts(right)] == [
        ("/figures", "What came of it"),
        ("/events", "Events"),
    ]
    assert right.row_shares == [6.5, 3.5]
    # two lanes; 13 ticks of 1 r/min would leave no room for others, 8 do; the rest is shared alike
    lanes_px, speed, torque = left.row_shares
    assert (lanes_px, lanes_px + speed + torque) == (72 + 2 * 40, pytest.approx(980))
    assert speed - torque == pytest.approx(26 * (13 - 2.6))


def test_the_units_are_those_that_were_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    known = commissioned._known(tmp_path)
    assert isinstance(known, KnownNodes)
    read: list[Path] = []
    drive = SimpleNamespace(drive=SimpleNamespace(node=7), override={"a": 1})
    made: list[Any] = []

    def load(path: Path) -> Any:
        read.append(path)
        return drive

    monkeypatch.setattr(commissioned, "load_drive_file", load)
    monkeypatch.setattr(commissioned, "KnownNodes", lambda *given: made.append(given))
    (tmp_path / "drive.toml").touch()
    commissioned._known(tmp_path)
    assert read == [tmp_path / "drive.toml"]
    assert made == [((), {("", 7): {"a": 1}})]
