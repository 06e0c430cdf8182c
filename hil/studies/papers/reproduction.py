"""[Ling2012] as ``hil reproduce ling2012`` gives it: Table 2, the printed design, and Cases 1 to 3."""

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from design.delay.speed_loop import Units
from design.motor import PmsmParameters
from design.papers.ling2012 import (
    DELAY_S,
    LOAD_NM,
    LOSSES,
    MOTOR,
    PERIOD_S,
    SPEED_RAD_S,
    TABLE_2,
    TAU_S,
    case1,
    case2,
    case3,
    motor_row,
    published_design,
    table2_row,
)
from design.papers.ling2012 import (
    K as PUBLISHED_GAIN,
)
from design.sampled.held_loop import SampledNetwork, Strategy
from drivers.rotation import RAD_S_PER_RPM
from hil.studies.papers.runs import PaperRun, run_cases
from hil.studies.speed.analysis import LoopRequest, sampled_figures

_PROCESSES = 2


def reproduce(runs: Path, tell: Callable[[str], None]) -> tuple[dict[str, Any], list[PaperRun]]:
    """The figures, and the recorded runs, which go into folders below ``runs``."""
    tell("Table 2: 11 rows by 4 methods in 2 conventions of units")
    figures: dict[str, Any] = {"table2": table2(), "published_design": published_design()}
    tell("the three strategies: certificates for every sequence")
    figures["strategies"] = strategies()
    recorded = run_cases(runs, tell)
    cases: dict[str, Callable[[], dict[str, Any]]] = {"case1": case1, "case2": case2, "case3": case3}
    for name, case in cases.items():
        figures[name] = case() | {"bench": {run.variant: run.figures for run in recorded if run.case == name}}
    return figures, recorded


def for_motor(motor: PmsmParameters) -> dict[str, Any]:
    """Table 2 for another motor: the largest delay for each error of the paper, at its own rating."""
    errors = [error for error, _ in TABLE_2]
    with _pool() as pool:
        rows = list(pool.map(motor_row, [motor] * len(errors), errors))
    share = LOAD_NM / MOTOR.rated_torque_nm
    return {
        "motor": motor.name,
        "load_nm": share * motor.rated_torque_nm,
        "speed_rpm": motor.rated_speed_rad_s / RAD_S_PER_RPM,
        "rows": rows,
    }


def table2() -> dict[str, list[dict[str, Any]]]:
    """Every row in both conventions, on two processes."""
    asked = [(error, delay_s, units) for units in (Units.PUBLISHED, Units.SI) for error, delay_s in TABLE_2]
    with _pool() as pool:
        rows = list(pool.map(table2_row, *zip(*asked, strict=True)))
    half = len(TABLE_2)
    return {"published": rows[:half], "si": rows[half:]}


def _pool() -> ProcessPoolExecutor:
    return ProcessPoolExecutor(_PROCESSES, mp_context=get_context("spawn"))


def strategies() -> dict[str, dict[str, Any]]:
    """The printed gain in the sampled loop of Case 3, by what is done with a sample."""
    request = LoopRequest(MOTOR, PUBLISHED_GAIN, DELAY_S, None, LOAD_NM, SPEED_RAD_S)
    agreed_s = {Strategy.ARRIVAL: 0.0, Strategy.STAMP: DELAY_S, Strategy.HISTORY: DELAY_S}
    return {
        strategy.value: sampled_figures(
            request, SampledNetwork(strategy, PERIOD_S, LOSSES, TAU_S, agreed_s[strategy])
        )
        for strategy in Strategy
    }
