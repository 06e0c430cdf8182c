"""The covariance of the predictor's Kalman filter against matrices, and what makes its load bold."""

import math
from typing import NamedTuple

import numpy as np
import pytest
import scipy.linalg
from numpy.typing import NDArray

from servobench.hil.control.load_filter import STEP_SIGMAS, Covariance, FilterNoise, LoadFilter
from tests.unit.hil.test_predictor import PLANT, generator

Array = NDArray[np.float64]
PERIOD_S = 1e-3
SEEN = np.array([0.0, 1.0, 0.0])
"""The filtered speed of [speed, filtered speed, load]."""
QUIET, BOLD = 0.3, 6.0
NOISE = FilterNoise(0.076, 0.02, QUIET, BOLD)


class Model(NamedTuple):
    """Of one period."""

    transition: Array
    process: Array


def model_of(walk: float, torque_nm: float = NOISE.torque_nm) -> Model:
    """Van Loan's: the integral of the walk's noise over a period; a torque acts as a load does, but once."""
    rates, n = generator()[1:4, 1:4], 3
    walks = np.diag([0.0, 0.0, walk**2])
    total = scipy.linalg.expm(np.block([[-rates, walks], [np.zeros((n, n)), rates.T]]) * PERIOD_S)
    transition = total[n:, n:].T
    held = torque_nm * np.append(transition[:2, 2], 0.0)
    return Model(transition, transition @ total[:n, n:] + np.outer(held, held))


def settled(model: Model) -> Array:
    """P just after a reading, when nothing changes any more."""
    noise = np.array([[NOISE.speed_rad_s**2]])
    before = scipy.linalg.solve_discrete_are(model.transition.T, SEEN[:, None], model.process, noise)
    return corrected(before)[0]


def predicted(before: Array, model: Model) -> Array:
    return np.asarray(model.transition @ before @ model.transition.T + model.process)


def corrected(before: Array) -> tuple[Array, Array]:
    """P and the gains."""
    gain = before @ SEEN / (SEEN @ before @ SEEN + NOISE.speed_rad_s**2)
    return before - np.outer(gain, SEEN @ before), gain


def entries(covariance: Covariance) -> Array:
    ss, sf, sl = covariance.ss, covariance.sf, covariance.sl
    ff, fl, ll = covariance.ff, covariance.fl, covariance.ll
    return np.array([[ss, sf, sl], [sf, ff, fl], [sl, fl, ll]])


def gains(covariance: Covariance) -> list[float]:
    return [covariance.speed_gain, covariance.filtered_gain, covariance.load_gain]


@pytest.mark.parametrize("walk", [QUIET, BOLD])
@pytest.mark.parametrize("torque_nm", [0.0, 0.02])
def test_a_covariance_settles_where_the_riccati_equation_says(walk: float, torque_nm: float) -> None:
    model = model_of(walk, torque_nm)
    noise = FilterNoise(NOISE.speed_rad_s, torque_nm, QUIET, BOLD)
    found = Covariance(PLANT, noise, walk, PERIOD_S)
    expected = settled(model)
    assert entries(found) == pytest.approx(expected, rel=1e-3)
    assert gains(found) == pytest.approx(corrected(predicted(expected, model))[1], rel=1e-3)


def test_readings_that_are_lost_widen_it_and_the_next_one_narrows_it() -> None:
    model, found = model_of(BOLD), Covariance(PLANT, NOISE, BOLD, PERIOD_S)
    expected = settled(model)
    for lost in (0, 1, 7):
        for _ in range(lost + 1):
            found.predict()
            expected = predicted(expected, model)
        assert entries(found) == pytest.approx(expected, rel=1e-3)
        assert found.spread == pytest.approx(expected[1, 1] + NOISE.speed_rad_s**2, rel=1e-3)
        found.correct()
        expected, gain = corrected(expected)
        assert entries(found) == pytest.approx(expected, rel=1e-3)
        assert gains(found) == pytest.approx(gain, rel=1e-3)


def test_the_process_noise_of_a_period_is_added_whole() -> None:
    """From nothing: then each entry of Q stands alone."""
    found = Covariance(PLANT, NOISE, BOLD, PERIOD_S)
    found.ss = found.sf = found.sl = found.ff = found.fl = found.ll = 0.0
    found.predict()
    assert entries(found) == pytest.approx(model_of(BOLD).process, rel=1e-3)


@pytest.mark.parametrize("place", [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)])
def test_each_entry_is_carried_over_by_the_transition(place: tuple[int, int]) -> None:
    """The propagation is linear: of what one entry adds."""
    model, found = model_of(QUIET), Covariance(PLANT, NOISE, QUIET, PERIOD_S)
    names = [["ss", "sf", "sl"], ["sf", "ff", "fl"], ["sl", "fl", "ll"]]
    unit = np.zeros((3, 3))
    unit[place] = unit[place[::-1]] = 1.0
    for row in range(3):
        for column in range(row, 3):
            setattr(found, names[row][column], float(unit[row, column]))
    found.predict()
    expected = model.transition @ unit @ model.transition.T
    assert entries(found) - model.process == pytest.approx(expected, rel=1e-3, abs=1e-6)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("sigmas", "walk"), [(0.999, QUIET), (1.001, BOLD)])
def test_an_innovation_beyond_its_bound_goes_on_from_the_bold_covariance(
    sign: float, sigmas: float, walk: float
) -> None:
    quiet, bold = model_of(QUIET), model_of(BOLD)
    found = LoadFilter(PLANT, NOISE, PERIOD_S)
    found.predict(3)
    both = {QUIET: settled(quiet), BOLD: settled(bold)}
    for _ in range(3):
        both = {QUIET: predicted(both[QUIET], quiet), BOLD: predicted(both[BOLD], bold)}
    assert STEP_SIGMAS == 1.5, "one in seven by chance"
    sigma = math.sqrt(both[QUIET][1, 1] + NOISE.speed_rad_s**2)
    found.correct(sign * sigmas * 1.5 * sigma)
    expected, gain = corrected(both[walk])
    assert entries(found.quiet) == pytest.approx(expected, rel=1e-3)
    assert gains(found.quiet) == pytest.approx(gain, rel=1e-3)


def test_after_a_step_of_the_load_it_calms_down_by_itself() -> None:
    found = LoadFilter(PLANT, NOISE, PERIOD_S)
    calm = entries(found.quiet)
    found.predict(1)
    found.correct(1e3)
    assert found.quiet.ll > 10.0 * calm[2, 2]
    for _ in range(5000):
        found.predict(1)
        found.correct(0.0)
    assert entries(found.quiet) == pytest.approx(calm, rel=1e-6)
