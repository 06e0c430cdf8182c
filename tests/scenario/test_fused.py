"""The predictor on count and speed on whole runs of a simulated drive with a coarse encoder."""

import numpy as np
import pytest

from servobench.hil.configuration.motor_file import LING2012
from tests import floor_runs
from tests.floor_runs import LOAD_AT_S, Case, fused, lost_ratio, peaks

WITHIN_S = 0.15
CASE = Case("4096 counts", LING2012.model_dump(mode="json"), 1e-3, 4096)
"""h + tau 2 ms."""


@pytest.fixture(scope="module")
def controller() -> dict[str, object]:
    return fused(CASE)


def test_peaks_and_noise_are_those_of_the_design(controller: dict[str, object]) -> None:
    """1.58 of the floor without noise; 2.4 to 2.8, at 6.3 % of noise, is what the speed alone allows."""
    runs = peaks(CASE, controller, 4)
    ratios = [run.peak_rad_s(WITHIN_S) / CASE.floor_rad_s() for run in runs]
    assert 1.3 < np.median(ratios) < 1.7
    assert max(ratios) < 1.85
    noise_nm = float(np.std(runs[0].commands_nm(LOAD_AT_S - 0.3, LOAD_AT_S)))
    assert noise_nm < 0.055 * float(CASE.motor["rating"]["torque_nm"])
    rows = runs[0].rows
    assert (rows["position_told_at"] == rows["received_at"])[rows["fate"] == 0].all()


@pytest.mark.parametrize("inertia", [0.7, 1.3])
def test_it_bears_another_inertia(controller: dict[str, object], inertia: float) -> None:
    runs = peaks(CASE, controller, 2, inertia)
    assert max(run.peak_rad_s(WITHIN_S) for run in runs) < 2.0 * CASE.floor_rad_s(inertia)


def test_ticks_that_wander_through_the_period_are_followed(monkeypatch: pytest.MonkeyPatch) -> None:
    """1003 us are no whole number of ticks: each count is of another part of one.

    With the count alone to tell one tick from the next, a step of the load passed for a tick: six times the
    floor.
    """
    monkeypatch.setattr(floor_runs, "PERIOD_S", 1.003e-3)
    case = Case("1003 us", CASE.motor, 1.003e-3, 4096)
    runs = peaks(case, fused(case), 3, 0.7)
    assert max(run.peak_rad_s(WITHIN_S) for run in runs) < 2.0 * case.floor_rad_s(0.7)


def test_it_bears_five_lost_readings(controller: dict[str, object]) -> None:
    assert lost_ratio(CASE, controller, peaks(CASE, controller, 1)[0], WITHIN_S) < 1.2
