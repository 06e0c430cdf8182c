"""The cases of [Ling2012] and their pictures: figures of runs by hand, and what each plot shows."""

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from servobench.design.delay.delay_loop import Units
from servobench.design.papers.ling2012 import (
    DELAY_S,
    LOAD_NM,
    LOAD_ON_S,
    LOSSES,
    MOTOR,
    PERIOD_S,
    SPEED_RAD_S,
    TABLE_2,
    TAU_S,
)
from servobench.design.sampled.held_loop import SampledNetwork, Strategy
from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import Instant
from servobench.hil.configuration.motor_file import LING2012
from servobench.hil.machine.stopping import Interrupted
from servobench.hil.rows.records_file import RecordsWriter
from servobench.hil.studies import drawing
from servobench.hil.studies.papers import pictures, reproduction
from servobench.hil.studies.papers.reproduction import LOAD_AT_S, PaperRun
from servobench.hil.verdict.verdict import Finding, VerdictKind
from tests.unit.hil.row_tools import plain_rows
from tests.unit.hil.test_report import summary

TIME_S = np.arange(0.0, 5.0, 0.01)


def share_of(at: Callable[[float], float]) -> Any:
    """A speed error, by shares of the largest speed."""
    return SPEED_RAD_S * np.array([at(time_s) for time_s in TIME_S])


def test_a_start_has_settled_once_it_stays_in_each_band() -> None:
    error = share_of(lambda at: 1.0 if at < 0.495 else 0.03 if at < 0.995 else -0.019 if at < 2 else 0.0)
    assert reproduction._figures(TIME_S, error, loaded=False) == {
        "settled": True,
        "overshoot_percent": pytest.approx(1.9),
        "settling_5_percent_s": pytest.approx(0.5),
        "settling_2_percent_s": pytest.approx(1.0),
    }


@pytest.mark.parametrize(
    ("until", "settled", "at_5"), [(4.785, True, 4.79), (4.805, False, 4.81), (6.0, False, None)]
)
def test_a_start_must_be_in_its_band_for_the_last_fifth_of_a_second(
    until: float, settled: bool, at_5: float | None
) -> None:
    found = reproduction._figures(TIME_S, share_of(lambda at: 0.06 if at < until else 0.0), loaded=False)
    assert found["settled"] is settled
    assert found["settling_5_percent_s"] == (None if at_5 is None else pytest.approx(at_5))
    assert found["overshoot_percent"] == 0.0


def test_a_band_holds_its_own_edge() -> None:
    found = reproduction._settling(np.array([1.0, 2.0, 3.0]), np.array([0.06, 0.05, -0.02]), "settling")
    assert found == {"settling_5_percent_s": 2.0, "settling_2_percent_s": 3.0}
    calm = reproduction._settling(np.array([1.0]), np.array([0.0]), "settling")
    assert calm == {"settling_5_percent_s": 1.0, "settling_2_percent_s": 1.0}


def test_under_load_the_peak_the_swing_back_and_the_recovery_count() -> None:
    gone_s = LOAD_AT_S + LOAD_ON_S

    def at(time_s: float) -> float:
        if time_s < LOAD_AT_S - 1e-9:
            return 0.9
        if time_s < gone_s - 1e-9:
            return 0.25
        return -0.1 if time_s < gone_s + 0.295 else 0.03 if time_s < gone_s + 0.395 else 0.0

    assert reproduction._figures(TIME_S, share_of(at), loaded=True) == {
        "peak_rad_s": pytest.approx(0.25 * SPEED_RAD_S),
        "peak_percent": pytest.approx(25.0),
        "swing_back_percent": pytest.approx(10.0),
        "recovery_5_percent_s": pytest.approx(0.3),
        "recovery_2_percent_s": pytest.approx(0.4),
    }


def recorded(folder: Path) -> Path:
    rows = plain_rows(4_000, reference=SPEED_RAD_S, velocity=0.5 * SPEED_RAD_S)
    rows["sampled_at"] = rows["due_at"] + 30_000
    rows["velocity_rad_s"][1] = math.nan
    rows["fate"][1] = 1
    folder.mkdir(parents=True)
    writer = RecordsWriter(folder / "records.arrow")
    writer.begin({}, Instant(0))
    writer.write(rows[:700])
    writer.write(rows[700:])
    writer.close()
    return folder


def test_errors_are_of_the_readings_that_came(tmp_path: Path) -> None:
    time_s, error = reproduction._errors(recorded(tmp_path / "run"))
    assert time_s.size == error.size == 3_999
    assert time_s[:2] == pytest.approx([30e-6, 0.002030])
    assert error == pytest.approx(np.full(3_999, 0.5 * SPEED_RAD_S))


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Runs that leave a recording and nothing else; what was asked for."""
    asked: list[Any] = []

    def run_bench(config: Any, record: Path) -> Any:
        asked.append((config.bench.name, recorded(record)))
        return summary()

    monkeypatch.setattr(reproduction, "run_bench", run_bench)
    return asked


def test_a_paper_is_reproduced_case_by_case(
    bench: list[Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("table2", "strategies", "published_design"):
        monkeypatch.setattr(reproduction, name, lambda name=name: f"its {name}")
    for name in ("case1", "case2", "case3"):
        monkeypatch.setattr(reproduction, name, lambda name=name: {"of": name})
    told: list[str] = []
    figures, runs = reproduction.reproduce(tmp_path, told.append)
    assert [(run.case, run.variant) for run in runs] == list(reproduction.VARIANTS)
    assert [folder for _, folder in bench] == [tmp_path / name for name, _ in bench]
    assert {name: figures[name] for name in ("table2", "strategies", "published_design")} == {
        name: f"its {name}" for name in ("table2", "strategies", "published_design")
    }
    for case, names in (
        ("case1", ["stamp", "arrival"]),
        ("case2", ["pi_careful", "pi_eager"]),
        ("case3", ["stamp", "arrival", "history"]),
    ):
        assert figures[case]["of"] == case
        assert list(figures[case]["bench"]) == names
    whole = figures["case1"]["bench"]["stamp"]
    assert (whole["settled"], whole["delay_p99_us"], whole["recording"]) == (False, 987.5, str(bench[0][1]))
    assert len(told) == 2 + len(runs)
    assert told[2] == "case1, stamp: on the simulated bench"


def test_a_case_that_was_interrupted_ends_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ended = summary().also(Finding(VerdictKind.INTERRUPTED, "ended by SIGINT"))
    monkeypatch.setattr(reproduction, "run_bench", lambda _config, record: ended if record else None)
    with pytest.raises(Interrupted, match="ended by SIGINT"):
        reproduction._run("case1", "stamp", tmp_path, lambda _: None)


def test_rows_of_table_2_are_made_on_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reproduction, "_pool", lambda: ThreadPoolExecutor(1))
    monkeypatch.setattr(reproduction, "table2_row", lambda *row: {"row": row})
    found = reproduction.table2()
    assert found["published"] == [{"row": (error, delay, Units.PUBLISHED)} for error, delay in TABLE_2]
    assert found["si"] == [{"row": (error, delay, Units.SI)} for error, delay in TABLE_2]
    other = replace(LING2012.parameters, rated_torque_nm=3.0)
    monkeypatch.setattr(reproduction, "motor_row", lambda motor, error: (motor.rated_torque_nm, error))
    mine = reproduction.for_motor(other)
    assert mine["load_nm"] == pytest.approx(3.0 * LOAD_NM / MOTOR.rated_torque_nm)
    assert mine["speed_rpm"] == pytest.approx(other.rated_speed_rad_s * 30 / math.pi)
    assert (mine["motor"], mine["rows"]) == (other.name, [(3.0, error) for error, _ in TABLE_2])


def test_the_strategies_run_over_the_network_of_case_3(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(reproduction, "sampled_figures", lambda *given: asked.append(given))
    assert set(reproduction.strategies()) == {"arrival", "stamp", "history"}
    agreed = {Strategy.ARRIVAL: 0.0, Strategy.STAMP: DELAY_S, Strategy.HISTORY: DELAY_S}
    assert [network for _, network in asked] == [
        SampledNetwork(strategy, PERIOD_S, LOSSES, TAU_S, agreed[strategy]) for strategy in Strategy
    ]
    request = asked[0][0]
    assert (request.motor, request.delay_s, request.order) == (MOTOR, DELAY_S, None)
    assert (request.load_nm, request.speed_rad_s, request.current_bandwidth_hz) == (
        LOAD_NM,
        SPEED_RAD_S,
        None,
    )


def test_every_variant_has_its_bench() -> None:
    assert all(reproduction.bench_of(case, name).is_file() for case, name in reproduction.VARIANTS)


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, Any]]:
    """Pictures by name, as they would be saved; at 120 dots per inch."""
    saved: list[tuple[str, Any]] = []

    def save(figure: Figure, path: Path, dpi: int) -> None:
        assert dpi == 120
        saved.append((path.name, figure))

    monkeypatch.setattr(Figure, "savefig", save)
    return saved


def lines(axis: Any) -> dict[str, Any]:
    return {line.get_label(): (list(line.get_xdata()), list(line.get_ydata())) for line in axis.lines}


ROWS: list[Any] = [
    {"error_percent": 2.0, "published_delay_s": 0.08, "ccl_delay_s": 0.07, "exact_delay_s": None},
    {"error_percent": 3.0, "published_delay_s": 0.09, "ccl_delay_s": 0.08, "exact_delay_s": 0.1},
]


def test_table_2_is_drawn_in_milliseconds_by_method(drawn: list[tuple[str, Any]]) -> None:
    pictures.draw_table({"published": ROWS, "si": ROWS[:1]}, Path("table2.png"))
    ((name, figure),) = drawn
    assert name == "table2.png"
    assert tuple(figure.get_size_inches()) == (11.0, 4.5)
    left, right = figure.axes
    assert (left.get_title(), right.get_title()) == (
        "gamma in r/min per N m, as printed",
        "gamma in rad/s per N m",
    )
    found = lines(left)
    assert list(found) == ["printed", "Algorithm 4.2 (CCL)", "exact, full feedback"]
    assert found["printed"] == ([2.0, 3.0], pytest.approx([80.0, 90.0]))
    assert found["exact, full feedback"][1] == pytest.approx([math.nan, 100.0], nan_ok=True)
    assert (left.get_xlabel(), left.get_ylabel(), left.get_yscale()) == (
        "speed error, % of 1500 r/min",
        "largest delay, ms",
        "log",
    )
    assert lines(right)["printed"][0] == [2.0]
    assert left.get_legend() is not None
    assert right.get_legend() is None


def test_a_motor_s_table_leaves_out_what_is_impossible(drawn: list[tuple[str, Any]]) -> None:
    rows = [{"error_percent": 1.0, "impossible": "no gain keeps it"}, *ROWS]
    pictures.draw_motor({"rows": rows, "motor": "mine", "speed_rpm": 3000.0, "load_nm": 1.25}, Path("m.png"))
    (axis,) = drawn[0][1].axes
    assert axis.get_title() == "mine: load step of 1.25 N m"
    assert axis.get_xlabel() == "speed error, % of 3000 r/min"
    assert lines(axis)["printed"][0] == [2.0, 3.0]


def run_of(case: str, variant: str) -> PaperRun:
    return PaperRun(case, variant, np.array([0.0, 4.0]), np.array([0.0, 0.5 * SPEED_RAD_S]), {})


RUNS = [run_of(case, name) for case, name in reproduction.VARIANTS]
TIMES = SimpleNamespace(time_s=np.array([0.0, 1.0]), x=np.array([[0.0, 0.0], [0.0, 0.25 * SPEED_RAD_S]]))


@pytest.fixture
def responses(monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of the continuous loop."""
    for name in ("start_up", "load_pulse"):
        monkeypatch.setattr(pictures, name, lambda: TIMES)


@pytest.mark.usefixtures("responses")
def test_each_case_is_drawn_with_its_runs(drawn: list[tuple[str, Any]]) -> None:
    pictures.draw_start(RUNS, Path("5"))
    pictures.draw_comparison(RUNS, Path("6"))
    pictures.draw_load(RUNS, Path("7"))
    start, comparison, load = (figure.axes[0] for _, figure in drawn)
    found = lines(start)
    assert list(found) == [
        "continuous, constant delay of 64 ms",
        "bench: stamp, 5 of 6 lost",
        "bench: arrival, 5 of 6 lost",
        "0.15 s, printed",
    ]
    assert found["continuous, constant delay of 64 ms"] == ([0.0, 1.0], pytest.approx([0.0, 25.0]))
    assert found["bench: stamp, 5 of 6 lost"] == ([0.0, 4.0], pytest.approx([0.0, 50.0]))
    assert found["0.15 s, printed"][0] == [0.15, 0.15]
    assert start.get_xlim() == (0.0, 1.5)
    found = lines(comparison)
    assert list(found) == [
        "robust controller, stamp, 5 of 6 lost",
        "PI crossing at 60 rad/s, 1 ms",
        "PI crossing at 200 rad/s, 1 ms",
    ]
    assert found["PI crossing at 60 rad/s, 1 ms"][1] == pytest.approx([1500.0, 750.0])
    assert comparison.get_xlim() == (0.0, 1.5)
    found = lines(load)
    assert found["bench: stamp without loss: what history gives"][0] == [-LOAD_AT_S, 4.0 - LOAD_AT_S]
    assert found["5 %, printed"][1] == [5.0, 5.0]
    assert found["first reaction at a delay of 64 ms"][0] == [DELAY_S, DELAY_S]
    assert (load.get_xlim(), load.get_ylim()) == ((-0.05, 0.8), (-15.0, 35.0))
    (span,) = load.patches
    assert (span.get_label(), span.get_alpha()) == ("0.6 N m", 0.1)
    assert (span.get_x(), span.get_width()) == pytest.approx((0.0, LOAD_ON_S))


def test_strategies_are_drawn_over_losses(drawn: list[tuple[str, Any]]) -> None:
    by_losses = [{"decay_per_s": 5.0 - lost, "gamma": None if lost == 2 else 2.0} for lost in range(3)]
    pictures.draw_strategies({"stamp": by_losses, "history": by_losses[:1]}, Path("s.png"))
    decay, gain = drawn[0][1].axes
    assert lines(decay) == {"stamp": ([0, 1, 2], [5.0, 4.0, 3.0]), "history": ([0, 1, 2], [5.0] * 3)}
    assert lines(gain)["stamp"][1] == pytest.approx([2.0, 2.0, math.nan], nan_ok=True)
    assert [axis.get_ylabel() for axis in (decay, gain)] == ["decay, 1/s", "gain, rad/s per N m"]
    assert decay.get_ylim()[0] == gain.get_ylim()[0] == 0.0


@pytest.mark.usefixtures("responses")
def test_all_pictures_go_into_a_folder(drawn: list[tuple[str, Any]], tmp_path: Path) -> None:
    names = ["table2.png", "fig05-start.png", "fig06-pid.png", "fig07-load.png", "strategies.png"]
    by_losses = [{"decay_per_s": 1.0, "gamma": 2.0}]
    figures = {"table2": {"published": ROWS, "si": ROWS}, "strategies": {"stamp": {"by_losses": by_losses}}}
    files = pictures.draw_ling2012(figures, RUNS, tmp_path / "new" / "folder")
    assert files == [tmp_path / "new" / "folder" / name for name in names]
    assert [name for name, _ in drawn] == names


def test_a_picture_that_cannot_be_written_is_bad_input(tmp_path: Path) -> None:
    nowhere = tmp_path / "none" / "a.png"
    with pytest.raises(BadInput) as caught, drawing.picture(nowhere) as axis:
        axis.plot([0.0, 1.0])
    assert (caught.value.source, caught.value.value) == ("--figures", str(nowhere))
    assert caught.value.expected.startswith("a .png, .svg or .pdf file that can be written (")
    with drawing.picture(tmp_path / "a.png", 2, size=(1.0, 1.0)) as axes:
        assert len(axes) == 2
        assert all(line.get_alpha() == 0.3 for line in axes[0].get_xgridlines())
    assert (tmp_path / "a.png").read_bytes()[16:24] == b"\0\0\0\x78" * 2
