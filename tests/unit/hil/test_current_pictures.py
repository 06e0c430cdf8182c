"""Pictures of current loops beside closed forms: G = 1/(s + 1), K = 2/(s + 3)."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from servobench.design.statespace import StateSpace
from servobench.hil.studies.current import pictures
from tests.unit.hil.made_analyses import MARGINS


def lag(gain: float, rate: float) -> StateSpace:
    return StateSpace(np.array([[-rate]]), np.array([[1.0]]), np.array([[gain]]), np.array([[0.0]]))


WEIGHTS = {name: SimpleNamespace(system=lag(place + 1.0, 5.0)) for place, name in enumerate(("S", "KS", "T"))}
DESIGN: Any = SimpleNamespace(
    plant=lag(1.0, 1.0),
    controller=lag(2.0, 3.0),
    weights=SimpleNamespace(by_function=WEIGHTS),
    margins=replace(MARGINS, gain_margin_db=6.125, phase_margin_deg=45.5),
    step=SimpleNamespace(settling_time_s=2.0, rise_time_s=0.5),
)


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, Any]]:
    saved: list[tuple[str, Any]] = []
    monkeypatch.setattr(
        Figure, "savefig", lambda figure, path, dpi: saved.append((path.name, figure, dpi)[:2])
    )
    return saved


def decibels(values: Any) -> Any:
    return 20.0 * np.log10(np.abs(values))


def expected(name: str, omega: Any) -> Any:
    s = 1j * omega
    loop = 2.0 / ((s + 1.0) * (s + 3.0))
    return {"S": 1.0, "KS": 2.0 / (s + 3.0), "T": loop}[name] / (1.0 + loop)


def test_each_function_is_drawn_beside_its_bound(drawn: list[tuple[str, Any]]) -> None:
    pictures.draw_bounds(DESIGN, Path("bounds.png"))
    ((name, figure),) = drawn
    assert name == "bounds.png"
    assert tuple(figure.get_size_inches()) == (12.0, 4.0)
    for place, (axis, function) in enumerate(zip(figure.axes, ("S", "KS", "T"), strict=True)):
        assert (axis.get_title(), axis.get_xlabel(), axis.get_ylabel()) == (f"|{function}|", "rad/s", "dB")
        assert axis.get_xscale() == "log"
        bound, gain = axis.lines
        omega = gain.get_xdata()
        assert (omega[0], omega[-1], omega.size) == (pytest.approx(1e-3), pytest.approx(1e7), 1500)
        assert gain.get_ydata() == pytest.approx(decibels(expected(function, omega)), abs=1e-6)
        weight = (place + 1.0) / (1j * omega + 5.0)
        assert bound.get_ydata() == pytest.approx(-decibels(weight), abs=1e-6)
        assert (bound.get_linestyle(), bound.get_label(), gain.get_label()) == (
            "--",
            "bound 1/|w|",
            f"|{function}|",
        )
        least = max(-180.0, float(np.min(gain.get_ydata())) - 5.0)
        assert axis.get_ylim()[0] == pytest.approx(least)


def test_one_function_has_a_picture_of_its_own(drawn: list[tuple[str, Any]]) -> None:
    pictures.draw_bound(DESIGN, "T", Path("t.png"))
    (axis,) = drawn[0][1].axes
    assert axis.get_title() == "|T|"
    assert axis.get_ylim()[0] == -180.0, "it falls further than is drawn"


def test_the_open_loop_is_drawn_with_its_margins(drawn: list[tuple[str, Any]]) -> None:
    pictures.draw_open_loop(DESIGN, Path("l.png"))
    gain, phase = drawn[0][1].axes
    assert gain.get_title() == "gain margin 6.12 dB, phase margin 45.50 degrees"
    omega = gain.lines[0].get_xdata()
    s = 1j * omega
    loop = 2.0 / ((s + 1.0) * (s + 3.0))
    assert (omega[0], omega[-1]) == pytest.approx((1e-2, 1e5))
    assert gain.lines[0].get_ydata() == pytest.approx(decibels(loop), abs=1e-6)
    assert list(gain.lines[1].get_ydata()) == [0.0, 0.0]
    degrees = -np.degrees(np.arctan(omega) + np.arctan(omega / 3.0))
    assert phase.lines[0].get_ydata() == pytest.approx(degrees, abs=1e-6)


def test_a_step_is_drawn_for_three_settling_times(drawn: list[tuple[str, Any]]) -> None:
    pictures.draw_step(DESIGN, Path("s.png"))
    (axis,) = drawn[0][1].axes
    assert axis.get_title() == "rise 500.00 ms, settling 2000.00 ms"
    time_ms, current = axis.lines[0].get_xdata(), axis.lines[0].get_ydata()
    assert (time_ms[0], time_ms[-1], time_ms.size) == (0.0, pytest.approx(6000.0), 800)
    t = 1e-3 * time_ms
    # T = 2/(s^2 + 4 s + 5): poles at -2 +- j
    answer = 0.4 * (1.0 - np.exp(-2.0 * t) * (np.cos(t) + 2.0 * np.sin(t)))
    assert current == pytest.approx(answer, abs=1e-6)


def run_of(factor: float) -> Any:
    time_s = np.array([0.0, 0.5])
    values = {name: factor * np.array([0.0, place + 1.0]) for place, name in enumerate(("t", "q", "d", "w"))}
    return SimpleNamespace(
        time_s=time_s,
        torque_nm=values["t"],
        current_q_a=values["q"],
        current_d_a=values["d"],
        speed_rad_s=values["w"],
    )


def test_runs_of_the_drive_are_drawn_over_each_other(drawn: list[tuple[str, Any]]) -> None:
    pictures.draw_runs({"nominal": run_of(1.0), "half_inertia": run_of(2.0)}, Path("r.png"))
    axes = drawn[0][1].axes
    assert [axis.get_ylabel() for axis in axes] == ["torque, N m", "i_q, A", "i_d, A", "speed, rad/s"]
    assert [axis.get_xlabel() for axis in axes] == ["", "", "ms", "ms"]
    for place, axis in enumerate(axes, start=1):
        assert [line.get_label() for line in axis.lines] == ["nominal", "half inertia"]
        assert [list(line.get_xdata()) for line in axis.lines] == [[0.0, 500.0]] * 2
        assert [line.get_ydata()[1] for line in axis.lines] == [place, 2.0 * place]


def test_every_figure_of_the_paper_has_its_file(drawn: list[tuple[str, Any]], tmp_path: Path) -> None:
    runs = {"nominal": run_of(1.0), "varied": run_of(2.0)}
    files = pictures.draw_paper({"q": (DESIGN, DESIGN), "d": (DESIGN, DESIGN)}, runs, tmp_path / "all")
    assert [path.name for path in files] == [name for name, _ in drawn]
    assert all(path.parent == tmp_path / "all" for path in files)
    figures = dict(drawn)
    assert figures["fig09-sensitivity-q.png"].axes[0].get_title() == "|S|"
    assert figures["fig10-control-q.png"].axes[0].get_title() == "|KS|"
    assert figures["fig11-complementary-q.png"].axes[0].get_title() == "|T|"
    assert len(figures["fig12-nominal.png"].axes[0].lines) == 1
    assert len(figures["fig13-varied.png"].axes[0].lines) == 2
    assert len(files) == 10
