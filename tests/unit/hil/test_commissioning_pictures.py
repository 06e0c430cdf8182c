"""The pictures of a commissioning's report: what is drawn over what, in which unit, and how it is named."""

import math
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest
from matplotlib.figure import Figure

from servobench.hil.commissioning.excitation import FrequencyResponse, StepLag
from servobench.hil.commissioning.exercise import Recording
from servobench.hil.commissioning.plots import (
    TorqueByAngle,
    draw_angle,
    draw_current,
    draw_delays,
    draw_mechanics,
    draw_response,
    draw_verification,
)
from tests.unit.hil.simulated_shaft import shaft_of

RPM: Final = 30.0 / math.pi
BLUE, RED, GREY = "#1f5fa8", "#c8442c", "#8a8f98"
OUT = Path("x.png")
Drawn = list[tuple[Path, Figure, dict[str, Any]]]


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> Drawn:
    saved: Drawn = []
    monkeypatch.setattr(
        Figure, "savefig", lambda figure, path, **options: saved.append((path, figure, options))
    )
    return saved


def axes_of(drawn: Drawn, height: float, rows: int) -> list[Any]:
    ((path, figure, options),) = drawn
    assert (path, options) == (OUT, {"dpi": 110})
    assert tuple(figure.get_size_inches()) == (8.0, height)
    axes = list(figure.axes)
    assert len(axes) == rows
    for ax in axes:
        assert [ax.spines[side].get_visible() for side in ("top", "right", "left", "bottom")] == [
            False,
            False,
            True,
            True,
        ]
        grid = ax.get_xgridlines()[0]
        assert (grid.get_visible(), grid.get_color(), grid.get_linewidth()) == (True, "#e3e6ea", 0.6)
    return axes


def named(ax: Any) -> tuple[str, str]:
    return ax.get_xlabel(), ax.get_ylabel()


def legend(ax: Any) -> list[str]:
    assert not ax.get_legend().get_frame_on()
    return [text.get_text() for text in ax.get_legend().get_texts()]


def styles(ax: Any) -> list[tuple[str, str, str, float]]:
    """Colour, line, marker and size of each."""
    return [
        (
            line.get_color(),
            line.get_linestyle(),
            line.get_marker(),
            line.get_linewidth() if line.get_linestyle() == "-" else line.get_markersize(),
        )
        for line in ax.lines
    ]


def recording(time: Any, position: Any, torque: Any, velocity: Any = None) -> Recording:
    told = np.zeros(len(time)) if velocity is None else velocity
    return Recording(time, position, told, torque, np.zeros(0), len(time), 0, ())


def test_speed_over_time_and_friction_over_speed(drawn: Drawn) -> None:
    """Up by 50 rad/s^2 with 2 g m^2, which take 0.1 N m of the torque; and down, at 3 to 4 rad/s."""
    time: Any = 1e-3 * np.arange(101)
    up = recording(time, 25.0 * time**2, np.full(101, 0.17))
    back = recording(time, -3.0 * time - 5.0 * time**2, np.full(101, -0.05))
    draw_mechanics(OUT, [up, back], shaft_of(2e-3, 4e-3, 0.05, -0.02))
    above, below = axes_of(drawn, 7.0, 2)
    assert named(above) == ("time, s (one exercise after the other)", "speed, r/min")
    assert named(below) == ("speed, r/min", "torque less inertia, N m")
    inner = slice(20, 80)
    first, second = above.lines
    assert np.allclose(first.get_xdata(), time)
    assert np.allclose(first.get_ydata()[inner], 50.0 * time[inner] * RPM)
    assert np.allclose(second.get_xdata(), time + 0.3)
    assert np.allclose(second.get_ydata()[inner], (-3.0 - 10.0 * time[inner]) * RPM)
    assert styles(above) == [(BLUE, "-", "None", 1.0)] * 2
    forward, backward, fit = below.lines
    assert np.allclose(forward.get_xdata()[inner], 50.0 * time[inner] * RPM)
    assert np.allclose(forward.get_ydata()[inner], 0.17 - 2e-3 * 50.0)
    assert np.allclose(backward.get_xdata()[inner], (-3.0 - 10.0 * time[inner]) * RPM)
    assert np.allclose(backward.get_ydata()[inner], -0.05 + 2e-3 * 10.0)
    assert forward.get_alpha() == backward.get_alpha() == 0.5
    top = 50.0 * (time[-1] - 4e-3)
    speeds = np.linspace(-top, top, 401)
    friction = 4e-3 * speeds + 0.05 * np.sign(speeds) - 0.02
    assert np.allclose(fit.get_xdata(), speeds * RPM)
    assert np.allclose(np.delete(fit.get_ydata(), 200), np.delete(friction, 200))
    peak = 3.0 * (4e-3 * top + 0.05 + 0.02)
    assert below.get_ylim() == pytest.approx((-peak, peak))
    assert styles(below) == [(GREY, "None", ".", 1.5)] * 2 + [(RED, "-", "None", 1.5)]
    assert legend(below) == ["identified friction"]


def test_torque_over_the_angle_each_way(drawn: Drawn) -> None:
    angle: Any = np.array([0.0, math.pi / 2.0, math.pi])
    forward: Any = np.array([0.1, 0.2, 0.3])
    backward: Any = np.array([-0.1, 0.0, 0.5])
    draw_angle(OUT, TorqueByAngle(angle, forward, backward, 0.0123))
    (ax,) = axes_of(drawn, 4.5, 1)
    assert named(ax) == ("angle of the shaft, degrees", "torque less inertia and friction, N m")
    assert [line.get_xdata().tolist() for line in ax.lines] == [[0.0, 90.0, 180.0]] * 2
    assert [line.get_ydata().tolist() for line in ax.lines] == [forward.tolist(), backward.tolist()]
    assert styles(ax) == [(BLUE, "-", "None", 1.2), (RED, "-", "None", 1.2)]
    assert legend(ax) == ["forwards", "backwards"]
    assert ax.get_xlim() == (0.0, 360.0)
    assert ax.get_title() == "standard error of a point 0.012 N m"


def test_torque_over_current_with_the_line_through_it(drawn: Drawn) -> None:
    current: Any = np.array([1.0, -2.0, 3.0])
    torque: Any = np.array([0.6, -0.9, 1.6])
    draw_current(OUT, current, torque, 0.51234, 0.1)
    (ax,) = axes_of(drawn, 4.5, 1)
    pairs, fit = ax.lines
    assert (pairs.get_xdata().tolist(), pairs.get_ydata().tolist()) == (current.tolist(), torque.tolist())
    assert fit.get_xdata().tolist() == [-2.0, 3.0]
    assert fit.get_ydata() == pytest.approx([0.1 - 2.0 * 0.51234, 0.1 + 3.0 * 0.51234])
    assert styles(ax) == [(GREY, "None", ".", 2.0), (RED, "-", "None", 1.5)]
    assert named(ax) == ("current 6078h, A rms", "torque 6077h, N m")
    assert legend(ax)[-1] == "0.5123 N m/A"


def test_magnitude_phase_and_coherence_beside_the_model(drawn: Drawn) -> None:
    """A phase that passes -180 degrees goes on."""
    frequency: Any = np.array([1.0, 10.0, 100.0])
    response: Any = np.array([2.0, 0.5, 0.25]) * np.exp(-1j * np.radians([90.0, 170.0, 250.0]))
    model: Any = np.array([4.0, 2.0, 1.0]) * np.exp(-1j * np.radians([45.0, 135.0, 225.0]))
    coherence: Any = np.array([1.0, 0.9, 0.7])
    draw_response(OUT, FrequencyResponse(frequency, response, coherence), model)
    magnitude, phase, explained = axes_of(drawn, 9.0, 3)
    assert all(line.get_xdata().tolist() == frequency.tolist() for line in magnitude.lines + phase.lines)
    assert [line.get_ydata() for line in magnitude.lines] == [
        pytest.approx([2.0, 0.5, 0.25]),
        pytest.approx([4.0, 2.0, 1.0]),
    ]
    assert [line.get_ydata() for line in phase.lines] == [
        pytest.approx([-90.0, -170.0, -250.0]),
        pytest.approx([-45.0, -135.0, -225.0]),
    ]
    (line,) = explained.lines
    assert (line.get_xdata().tolist(), line.get_ydata().tolist()) == (frequency.tolist(), coherence.tolist())
    measured, line_of_model = (BLUE, "None", "o", 3.0), (RED, "-", "None", 1.2)
    assert styles(magnitude) == styles(phase) == [measured, line_of_model]
    assert styles(explained) == [measured]
    assert [(ax.get_xscale(), ax.get_yscale()) for ax in (magnitude, phase, explained)] == [
        ("log", "log"),
        ("log", "linear"),
        ("log", "linear"),
    ]
    assert [named(ax) for ax in (magnitude, phase, explained)] == [
        ("", "speed / torque, rad/s per N m"),
        ("", "phase, degrees"),
        ("frequency, Hz", "coherence"),
    ]
    assert legend(magnitude) == ["measured", "1/(J s + B)"]
    assert explained.get_ylim() == (0.0, 1.05)
    assert magnitude.get_shared_x_axes().joined(magnitude, explained)


def test_the_delay_of_readings_and_the_answer_to_a_step(drawn: Drawn) -> None:
    readings: Any = np.repeat([100.0, 160.0], [3, 7])
    age: Any = np.array([100.0, 300.0])
    part: Any = np.array([0.2, 0.8])
    draw_delays(OUT, readings, age, part, StepLag(212.6, 0.0, 0.0, 0.0))
    above, below = axes_of(drawn, 7.0, 2)
    assert [bar.get_height() for bar in above.patches] == [3.0] + [0.0] * 58 + [7.0]
    assert above.patches[0].get_x() == 100.0
    assert above.patches[-1].get_x() == pytest.approx(159.0)
    assert named(above) == ("from SYNC to reading, us", "readings")
    samples, half = below.lines
    assert (samples.get_xdata().tolist(), samples.get_ydata().tolist()) == (age.tolist(), part.tolist())
    assert list(half.get_xdata()) == [212.6, 212.6]
    assert styles(below) == [(GREY, "None", ".", 2.0), (RED, "-", "None", 1.2)]
    assert legend(below)[-1] == "half after 213 us"
    assert named(below) == ("age of the command at the sample, us", "part of the step")
    assert below.get_ylim() == (-0.3, 1.4)


def test_the_speed_beside_its_reference_and_the_torque(drawn: Drawn) -> None:
    """The velocity that the drive tells, at its own instants."""
    sampled: Any = np.array([0.0, 1.0, 2.0])
    run = recording(sampled, sampled, np.array([0.1, 0.2, 0.3]), np.array([1.0, 2.0, 4.0]))
    time: Any = np.array([0.5, 1.5])
    draw_verification(OUT, run, time, np.array([3.0, 5.0]))
    above, below = axes_of(drawn, 7.0, 2)
    reference, measured = above.lines
    assert reference.get_xdata().tolist() == time.tolist()
    assert reference.get_ydata() == pytest.approx([3.0 * RPM, 5.0 * RPM])
    assert measured.get_xdata().tolist() == sampled.tolist()
    assert measured.get_ydata() == pytest.approx([RPM, 2.0 * RPM, 4.0 * RPM])
    assert styles(above) == [(RED, "-", "None", 1.2), (BLUE, "-", "None", 1.0)]
    assert legend(above) == ["reference", "measured"]
    (torque,) = below.lines
    assert (torque.get_xdata().tolist(), torque.get_ydata().tolist()) == ([0.0, 1.0, 2.0], [0.1, 0.2, 0.3])
    assert styles(below) == [(BLUE, "-", "None", 0.8)]
    assert [named(above), named(below)] == [("", "speed, r/min"), ("time, s", "torque, N m")]
    assert above.get_shared_x_axes().joined(above, below)
