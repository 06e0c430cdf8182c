"""How a run is laid out: which pages there are, what stands in each, and over which stretch of time."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import pytest
import rerun.blueprint as rrb

from servobench.drivers.timebase import NS_PER_S
from servobench.hil.recording.blueprint import Whole, layout
from servobench.hil.recording.page_series import AXIS_COLORS
from servobench.hil.rows.recording_plan import (
    AxisPlan,
    ObservedDrive,
    ObservedSignal,
    RecordingPlan,
    ReviewPlan,
)
from tests.unit.hil.recording_tools import plan_for

SPEED: Final = AxisPlan("left", 1.0)
POSITION: Final = AxisPlan("right", 1.0, rated_torque_nm=30.0, quantity="position")
WHOLE: Final = Whole(1.0, 3.0)
LIVE: Final = None
SOLO: Final = plan_for(Path())
"""One axis, axis1."""


def plan(*axes: AxisPlan, **more: Any) -> RecordingPlan:
    return replace(SOLO, review=ReviewPlan(axes), **more)


def root(plan: RecordingPlan, whole: Whole | None) -> rrb.Container:
    found = layout(plan, whole).root_container
    assert isinstance(found, rrb.Horizontal)
    assert (found.column_shares, len(list(found.contents))) == ([7, 3], 2)
    return found


def pages(plan: RecordingPlan, whole: Whole | None) -> dict[str, Any]:
    """By name, in their order; of one with tabs inside, those by name."""
    tabs = parts(root(plan, whole))[0]
    assert (type(tabs).__name__, tabs.active_tab) == ("Tabs", 0)
    return {
        str(page.name): {str(each.name): each for each in parts(page)} if isinstance(page, rrb.Tabs) else page
        for page in parts(tabs)
    }


def parts(container: Any) -> list[Any]:
    return list(container.contents)


def names(page: Any) -> list[str]:
    return [str(each.name) for each in parts(page)]


def paths(page: Any) -> dict[str, list[str]]:
    """What the plots of a page show, by title; of cycles each line, as "/axis1/cycles/speed_reference"."""
    return {
        str(view.name): [each for path in view.contents for each in drawn(view, path)] for view in parts(page)
    }


def drawn(view: Any, path: str) -> list[str]:
    entity = path.removeprefix("+ ")
    lines = view.visualizer_overrides[entity] if entity.endswith("/cycles") else []
    fields = [mapping.selector for line in lines for mapping in line.mappings]
    return [f"{entity}/{field.removeprefix('.')}" for field in fields] or [entity]


def window_s(view: Any) -> tuple[float, float] | None:
    """None: linked to the time of all."""
    axis = view.properties["TimeAxis"]
    if axis.view_range is None:
        return None
    (ends,) = axis.view_range.as_arrow_array().to_pylist()
    return ends["start"] / NS_PER_S, ends["end"] / NS_PER_S


# ---- which pages ---------------------------------------------------------------------------------------


def inside(found: Mapping[str, Any]) -> dict[str, list[str]]:
    """By page with tabs, their names."""
    return {name: list(page) for name, page in found.items() if isinstance(page, dict)}


def test_one_axis_opens_on_its_overview() -> None:
    assert list(pages(SOLO, WHOLE)) == ["Overview", "Timing", "Zoom"]
    assert list(pages(SOLO, LIVE)) == ["Overview", "Timing"], "what goes on has nothing to zoom into"
    assert inside(pages(SOLO, WHOLE)) == {}


def test_several_have_a_page_of_all_and_one_of_each() -> None:
    two = plan(SPEED, replace(SPEED, name="middle"))
    found = pages(two, WHOLE)
    assert list(found) == ["Overview", "left", "middle", "Timing", "Zoom"]
    assert inside(found) == {"Timing": ["left", "middle"], "Zoom": ["left", "middle"]}


SIGNAL: Final = ObservedSignal((0x2030, 1), "h", "motor temperature", "deg C", 0.1)


def test_positions_controllers_and_observed_objects_have_pages_of_their_own() -> None:
    everything = plan(
        SPEED,
        POSITION,
        replace(POSITION, name="third"),
        channels={"third": ("gap", "force")},
        observed={"left": ObservedDrive(3, 0, (SIGNAL, replace_name(SIGNAL, "voltage", "")))},
    )
    found = pages(everything, WHOLE)
    assert list(found) == [
        *("Overview", "left", "right", "third"),
        *("Timing", "Speed", "Controller", "Observed", "Zoom"),
    ]
    assert inside(found) == {
        "Timing": ["left", "right", "third"],
        "Speed": ["right", "third"],
        "Zoom": ["left", "right", "third"],
    }
    assert paths(found["Controller"]) == {
        "gap": ["/third/cycles/controller_gap"],
        "force": ["/third/cycles/controller_force"],
    }
    assert paths(found["Observed"]) == {
        "motor temperature [deg C]": ["/left/observed/2030h_1"],
        "voltage": ["/left/observed/2030h_1"],
    }
    own = [*parts(found["Controller"]), *parts(found["Observed"])]
    assert [window_s(view) for view in own] == [(1.0, 3.0)] * 4
    assert names(found["Speed"]["third"]) == ["Speed [r/min]", "Speed error [r/min]"]
    assert names(found["right"])[1:] == [
        *("Position [rad]", "Position error [rad]", "Torque [N m]", "Delay of the readings [us]")
    ]


def replace_name(signal: ObservedSignal, name: str, unit: str) -> ObservedSignal:
    return signal._replace(name=name, unit=unit)


# ---- what stands in a page -----------------------------------------------------------------------------


@pytest.mark.parametrize("enveloped", [True, False])
def test_a_page_of_an_axis_shows_its_series_their_limits_and_few_marks(enveloped: bool) -> None:
    """Envelopes have no dropouts: their marks are those of the rows."""
    whole = replace(WHOLE, enveloped=enveloped, few_marks=frozenset({"axis1"}))
    cycles = "/axis1/cycles/{}_{}".format
    at = "/overview/axis1/{}/{}".format if enveloped else cycles
    brake = "/overview/axis1/torque/brake" if enveloped else "/axis1/torque/brake"
    shown = {
        "Speed [r/min]": [
            *(at("speed", "reference"), at("speed", "estimate"), at("speed", "measured")),
            *("/limits/axis1/speed/**", "/axis1/speed/dropped"),
        ],
        "Speed error [r/min]": [at("error", "error"), "/limits/axis1/error/**"],
        "Torque [mN m]": [
            *(at("torque", "command"), at("torque", "load"), at("torque", "measured"), brake),
            "/limits/axis1/torque/**",
        ],
        "Delay of the readings [us]": [
            at("delay", "delay"),
            *("/limits/axis1/delay/**", "/axis1/delay/uncertain", "/axis1/delay/dropped"),
        ],
    }
    page = pages(SOLO, whole)["Overview"]
    assert {title: found for title, found in paths(page).items() if title != "States"} == shown
    assert [view.origin for view in parts(page)] == ["/", *["/axis1"] * 4]
    many = paths(pages(SOLO, replace(whole, few_marks=frozenset()))["Overview"])
    assert many["Speed [r/min]"] == shown["Speed [r/min]"][:-1], "they would bury the line"
    assert many["Delay of the readings [us]"] == shown["Delay of the readings [us]"][:-1]
    zoomed = paths(pages(SOLO, replace(whole, few_marks=frozenset()))["Zoom"])
    near = [cycles("speed", each) for each in ("reference", "estimate", "measured")]
    assert zoomed["Speed [r/min]"] == [*near, "/axis1/speed/dropped"], (
        "each dropout is seen and each row, and no limit that is far away"
    )
    assert "/limits/axis1/error/**" in zoomed["Speed error [r/min]"]
    assert "/axis1/speed/dropped" in paths(pages(SOLO, LIVE)["Overview"])["Speed [r/min]"]


def test_a_position_has_its_marks_at_the_delay_alone() -> None:
    solo = plan(POSITION)
    shown = paths(pages(solo, WHOLE)["Overview"])
    assert shown["Position [rad]"] == [
        *("/right/cycles/position_reference", "/right/cycles/position_measured", "/limits/right/position/**")
    ]
    assert shown["Position error [rad]"] == [
        "/right/cycles/position_error_error",
        "/limits/right/position_error/**",
    ]
    assert [window_s(view) for view in parts(pages(solo, WHOLE)["Speed"])] == [(1.0, 3.0)] * 2
    speed = paths(pages(solo, replace(WHOLE, few_marks=frozenset({"right"})))["Speed"])
    assert speed["Speed [r/min]"] == [
        *(f"/right/cycles/speed_{each}" for each in ("reference", "estimate", "measured")),
        "/limits/right/speed/**",
    ]


def test_timing_shows_delay_commands_and_clock() -> None:
    page = pages(SOLO, WHOLE)["Timing"]
    assert page.row_shares == [1, 1, 1]
    assert [window_s(view) for view in parts(page)] == [(1.0, 3.0)] * 3
    assert paths(page) == {
        "Delay of the readings [us]": [
            *("/axis1/cycles/delay_delay", "/limits/axis1/delay/**", "/axis1/delay/uncertain"),
        ],
        "Commands, from hand-over [us]": [
            *(f"/axis1/cycles/commands_{each}" for each in ("on_5f_bus", "acting", "computing")),
            *("/limits/axis1/commands/**", "/axis1/commands/lost"),
        ],
        "Clock offset since the start, with its bounds [us]": [
            *(f"/axis1/cycles/clock_{each}" for each in ("lower", "upper", "offset")),
            "/limits/axis1/clock/**",
        ],
    }


def test_all_axes_share_a_plot_in_colours_of_their_own() -> None:
    many = plan(POSITION, *(replace(SPEED, name=f"a{number}") for number in range(6)))
    page = pages(many, replace(WHOLE, enveloped=True))["Overview"]
    axes = ["right", *(f"a{number}" for number in range(6))]
    shown = paths(page)
    assert list(shown) == [
        *("States", "Speed of all axes [r/min]", "Speed errors [r/min]"),
        *("Torques [N m, mN m]", "Delays of the readings [us]"),
    ]
    assert shown["Speed of all axes [r/min]"] == [
        f"/overview/{name}/speed/{each}" for name in axes for each in ("reference", "measured")
    ]
    assert shown["Delays of the readings [us]"] == [f"/overview/{name}/delay/delay" for name in axes]
    view = parts(page)[1]
    styles = view.visualizer_overrides
    assert list(styles) == [f"/overview/{name}/speed/measured" for name in axes]
    colors = [color_of(styles[path]) for path in styles]
    assert colors == [*AXIS_COLORS, *AXIS_COLORS[:2]], "the sixth has the first one's again"
    assert (view.origin, page.name) == ("/", "Overview")


def color_of(visualizer: Any) -> tuple[int, ...]:
    """Of a line that has another than its own."""
    one = visualizer[0] if isinstance(visualizer, list) else visualizer
    (batch,) = [each for each in one.overrides if "color" in str(each.component_descriptor()).lower()]
    (color,) = batch.as_arrow_array().to_pylist()
    return tuple(color >> shift & 0xFF for shift in (24, 16, 8))


# ---- lanes -----------------------------------------------------------------------------------------------

TRACKS: Final = {
    "host": "",
    "verdict": "",
    "left drive": "left",
    "right drive": "right",
    "left error": "left",
}


def test_lanes_stand_in_order_on_the_pages_of_their_axes() -> None:
    two = plan(SPEED, replace(SPEED, name="right"))
    found = pages(two, replace(WHOLE, tracks=TRACKS))
    assert {name: lanes(found[name]) for name in ("Overview", "left", "right")} == {
        "Overview": ["verdict", "left error", "host"],
        "left": ["verdict", "left error", "host", "left drive"],
        "right": ["verdict", "host", "right drive"],
    }
    assert lanes(pages(SOLO, LIVE)["Overview"]) == ["limits", "axis1 link", "host", "axis1 drive", "phase"]


def lanes(page: Any) -> list[str]:
    """The words above the lanes of a page."""
    (states,) = [view for view in parts(page) if view.name == "States"]
    ((entity, lines),) = states.visualizer_overrides.items()
    assert (entity, states.contents) == ("/state", ["+ /state"])
    return [mapping.source_component for line in lines for mapping in line.mappings]


@pytest.mark.parametrize(
    ("plan", "whole", "states_px"),
    [
        (SOLO, LIVE, 72 + 40 * 5),
        (plan(SPEED, POSITION), LIVE, 72 + 40 * 7),
        (SOLO, WHOLE, 72 + 40 * 3),
        (SOLO, replace(WHOLE, tracks=dict.fromkeys("abc", "")), 72 + 40 * 3),
        (SOLO, replace(WHOLE, tracks=dict.fromkeys("abcd", "")), 72 + 40 * 4),
        (SOLO, replace(WHOLE, tracks=dict.fromkeys("abcdefghijklmnop", "")), 490),
    ],
)
def test_lanes_have_their_room_and_the_speed_most_of_the_rest(
    plan: RecordingPlan, whole: Whole | None, states_px: int
) -> None:
    shares = pages(plan, whole)["Overview"].row_shares
    assert (shares[0], sum(shares)) == (states_px, pytest.approx(980))
    needed = 58 + 26 * 2  # of a plot whose range nobody knows: title, axis and two ticks
    left = 980 - states_px - 4 * needed
    assert shares[1:] == pytest.approx([needed + part * left for part in (0.7, 0.1, 0.1, 0.1)])


# ---- ranges and times ------------------------------------------------------------------------------------


def value_range(view: Any) -> list[float] | None:
    axis = view.properties.get("ScalarAxis")
    return None if axis is None else list(axis.range.as_arrow_array().to_pylist()[0])


def test_plots_have_the_ranges_and_remarks_of_their_axis() -> None:
    ranges = {"axis1/speed": (-1.0, 2.0), "axis1/delay": (0.0, 5.0), "other/error": (0.0, 1.0)}
    remarks = {"axis1/torque": ", limit 5 N m", "axis1/histogram": ", deadline 2000"}
    whole = replace(WHOLE, ranges=ranges, remarks=remarks)
    page = pages(SOLO, whole)["Overview"]
    assert [value_range(view) for view in parts(page)[1:]] == [[-1.0, 2.0], None, None, [0.0, 5.0]]
    assert names(page)[3] == "Torque [mN m], limit 5 N m"
    zoomed = pages(SOLO, whole)["Zoom"]
    assert [value_range(view) for view in parts(zoomed)[1:]] == [None] * 4, "as high as what is seen"
    assert names(parts(root(SOLO, whole))[1])[1] == "axis1: readings over delay [us], deadline 2000"
    # the heights are those of the ranges: 3 ticks of 1 for the speed, 5 for the delay
    shares = page.row_shares
    assert shares[4] - shares[2] == pytest.approx(26 * (5 - 2))


def test_axes_in_one_plot_share_the_widest_of_their_ranges() -> None:
    two = plan(SPEED, POSITION)
    ranges = {"left/speed": (-1.0, 2.0), "right/speed": (0.0, 3.0), "right/error": (-4.0, 4.0)}
    page = pages(two, replace(WHOLE, ranges=ranges))["Overview"]
    assert [value_range(view) for view in parts(page)[1:]] == [[-1.0, 3.0], [-4.0, 4.0], None, None]


def test_a_position_s_plots_are_as_high_as_its_ranges_need() -> None:
    ranges = {"right/position": (0.0, 7.0), "right/speed": (0.0, 1.0), "right/position_error": (0.0, 4.0)}
    position, error = pages(plan(POSITION), replace(WHOLE, ranges=ranges))["Overview"].row_shares[1:3]
    left = 980 - (72 + 40 * 3) - 4 * 58 - 26 * (7 + 4 + 2 + 2)
    assert position == pytest.approx(58 + 26 * 7 + 0.7 * left)
    assert error == pytest.approx(58 + 26 * 4 + 0.1 * left)


def test_a_whole_run_is_shown_from_its_begin_to_its_end_and_lanes_with_a_gutter() -> None:
    page = pages(SOLO, WHOLE)["Overview"]
    lanes, *plots = [window_s(view) for view in parts(page)]
    assert lanes == pytest.approx((1.0 - 2.0 * 31 / 988, 3.0)), "so wide are the labels of a plot, px"
    assert plots == [(1.0, 3.0)] * 4
    assert [window_s(view) for view in parts(pages(SOLO, WHOLE)["Zoom"])] == [None] * 5
    links = [view.properties["TimeAxis"].link.as_arrow_array().to_pylist() for view in parts(page)]
    assert links == [[1]] * 5, "independent"


def test_a_run_that_goes_on_shows_its_last_twenty_seconds() -> None:
    (ends,) = (
        parts(pages(SOLO, LIVE)["Overview"])[1].properties["TimeAxis"].view_range.as_arrow_array().to_pylist()
    )
    assert (ends["start"], ends["end"]) == (-20 * NS_PER_S, 0)
    assert layout(SOLO, LIVE).time_panel.play_state == "following"
    assert layout(SOLO, WHOLE).time_panel.play_state == "paused"


# ---- beside the pages ------------------------------------------------------------------------------------


def test_verdict_delays_and_events_stand_beside_every_page() -> None:
    right = parts(root(SOLO, WHOLE))[1]
    assert right.row_shares == [5.6, 1.7, 2.7]
    assert [(view.origin, view.name) for view in parts(right)] == [
        ("/verdict", "Verdict"),
        ("/delay_histogram/axis1", "axis1: readings over delay [us]"),
        ("/events", "Events"),
    ]


def test_delays_of_several_axes_are_tabs() -> None:
    histograms = parts(parts(root(plan(SPEED, POSITION), LIVE))[1])[1]
    assert isinstance(histograms, rrb.Tabs)
    assert [(view.origin, view.name) for view in parts(histograms)] == [
        ("/delay_histogram/left", "left delays [us]"),
        ("/delay_histogram/right", "right delays [us]"),
    ]
    legend = parts(histograms)[0].properties["PlotLegend"]
    assert legend.visible.as_arrow_array().to_pylist() == [False]
