"""Ranges and heights of plots, so that their ticks have labels."""

import pytest

from servobench.hil.recording.plot_scale import about, around_zero, fitted, plot_heights

LABEL_PX, TITLE_PX = 26, 58


@pytest.mark.parametrize(
    ("reach", "most"), [(1.0, 1.3), (2.0, 2.6), (2.4, 13.0), (44.0, 130.0), (90.0, 117.0), (0.003, 0.013)]
)
def test_a_range_about_zero_needs_few_ticks(reach: float, most: float) -> None:
    assert around_zero(reach) == pytest.approx((-most, most))


def test_a_range_of_values_has_a_margin_and_none_is_made_of_one_value() -> None:
    assert about([0.0, -10.0, 90.0]) == pytest.approx((-25.0, 105.0))
    assert about([3.0, 3.0]) is None
    assert about([]) is None


def test_each_plot_has_room_for_its_labels_and_the_first_gets_the_rest() -> None:
    heights = plot_heights([(-200.0, 1700.0), (-10.5, 10.5), None], 800.0, (1.0, 0.0, 0.0))
    assert sum(heights) == pytest.approx(800.0)
    assert heights[1:] == pytest.approx([TITLE_PX + 2.1 * LABEL_PX, TITLE_PX + 2 * LABEL_PX])


def test_where_not_all_find_room_that_of_fewest_ticks_that_is_enough_reaches_to_the_next_power_of_ten() -> (
    None
):
    torque, speed, delay = (-6500.0, 6500.0), (-100.0, 2600.0), (-10.0, 575.0)
    room_px = 3 * TITLE_PX + 14 * LABEL_PX
    shown = fitted([speed, torque, delay], room_px)
    assert shown == [speed, pytest.approx((-6500.0, 12000.0)), delay]
    assert sum(plot_heights(shown, room_px, (0.0, 0.0, 0.0))) <= room_px
    assert fitted([speed, torque, delay], room_px + 10 * LABEL_PX) == [speed, torque, delay]
    little_px = sum(plot_heights([speed, torque, delay], 0.0, (0.0,) * 3)) - LABEL_PX
    assert fitted([speed, torque, delay], little_px) == [speed, torque, pytest.approx((-10.0, 1200.0))]
    assert fitted([(-8700.0, 6500.0), None], 10.0) == [pytest.approx((-12000.0, 6500.0)), None]
