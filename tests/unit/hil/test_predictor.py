"""The predictor of the host against textbook matrices with the same data, and its answers to what comes."""

import math
from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
from numpy.typing import NDArray

from servobench.design.speed.predictor_plant import PredictorPlant
from servobench.drivers.exchange import Command, Reading
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Duration, Instant
from servobench.hil.control.load_filter import STEP_SIGMAS, FilterNoise, ShaftMotion
from servobench.hil.control.predictor import LoadCancelling, Predictor
from servobench.hil.loop.protocol import Context, TorqueSetPoint
from servobench.hil.loop.samples import Sample, StateEstimate
from servobench.hil.loop.scenario import Ramp, ReferenceProfile

Array = NDArray[np.float64]
PERIOD = Duration(NS_PER_MS)
PLANT = PredictorPlant(8e-4, 1.85e-3, math.tau * 800.0, math.tau * 500.0)
NOISE = FilterNoise(0.076, 0.01, 1.2, 1.2)
DEAD_TIME = Duration(100_000)


def predicting(noise: FilterNoise = NOISE) -> Predictor:
    return Predictor(PLANT, noise, DEAD_TIME, PERIOD)


def generator(model: PredictorPlant = PLANT) -> Array:
    """Of [T, omega, w, T_L, u]."""
    lever, a, f = 1.0 / model.inertia_kg_m2, model.current_rate_rad_s, model.filter_rate_rad_s
    rates = np.zeros((5, 5))
    rates[0, 0], rates[0, 4] = -a, a
    rates[1, :4] = [lever, -model.viscous_friction_nm_s * lever, 0.0, -lever]
    rates[2, 1:3] = [f, -f]
    return rates


def sample(number: int, at: int, speed: float) -> Sample:
    reading = Reading(speed, None, Instant(at), 0.0, Instant(at), 0.0, Instant(at), 0, Instant(at))
    return Sample(number, reading, Instant(at), 0, True)


def command(at: int, torque_nm: float) -> Command:
    return Command(1, torque_nm, Instant(at), Instant(at + PERIOD))


def estimate(predictor: Predictor, acts_at: int) -> StateEstimate:
    context = Context(PERIOD, ReferenceProfile([]))
    context.begin(1, Instant(0), 0.0, 0.0, Instant(acts_at), Instant(acts_at))
    return predictor.estimate(context)


@pytest.mark.parametrize("length_s", [1e-5, 3e-4, 1e-3])
def test_motion_is_the_matrix_exponential(length_s: float) -> None:
    motion = ShaftMotion(PLANT)
    motion.torque_nm, motion.speed_rad_s, motion.filtered_rad_s = 0.4, 80.0, 78.0
    motion.advance(1.1, 0.6, length_s)
    x = scipy.linalg.expm(generator() * length_s) @ [0.4, 80.0, 78.0, 0.6, 1.1]
    found = [motion.torque_nm, motion.speed_rad_s, motion.filtered_rad_s]
    assert found == pytest.approx(x[:3], rel=1e-6, abs=1e-6)


def test_motion_stands_a_filter_as_fast_as_the_current_loop() -> None:
    motion = ShaftMotion(replace(PLANT, filter_rate_rad_s=PLANT.current_rate_rad_s))
    motion.advance(1.0, 0.0, 1e-3)
    x = scipy.linalg.expm(generator(replace(PLANT, filter_rate_rad_s=PLANT.current_rate_rad_s)) * 1e-3)
    assert motion.filtered_rad_s == pytest.approx(x[2, 4], rel=2e-3)


class Textbook:
    """A Kalman filter in matrices: Van Loan for the noise, an exponential for every piece of a command."""

    def __init__(self) -> None:
        rates, n = generator()[1:4, 1:4], 3
        walk = np.diag([0.0, 0.0, NOISE.load_nm_sqrt_s**2])
        total = scipy.linalg.expm(np.block([[-rates, walk], [np.zeros((n, n)), rates.T]]) * 1e-3)
        self.Phi = total[n:, n:].T
        held = NOISE.torque_nm * np.append(self.Phi[:2, 2], 0.0)
        self.Q = self.Phi @ total[:n, n:] + np.outer(held, held)
        self.C = np.array([0.0, 1.0, 0.0])
        self.P = scipy.linalg.solve_discrete_are(
            self.Phi.T, self.C[:, None], 0.5 * (self.Q + self.Q.T), np.array([[NOISE.speed_rad_s**2]])
        )
        self._correct_covariance()
        self.x = np.zeros(4)
        self.at = 0
        self.commands = [(0, 0.0)]

    def _correct_covariance(self) -> Array:
        gain = self.P @ self.C / (self.C @ self.P @ self.C + NOISE.speed_rad_s**2)
        self.P = self.P - np.outer(gain, self.C @ self.P)
        return np.asarray(gain)

    def ahead(self, until: int) -> Array:
        """The state at an instant, through every command that acts on the way."""
        x, at = self.x, self.at
        edges = sorted({until, *(when for when, _ in self.commands if at < when < until)})
        for edge in edges:
            in_force = [torque for when, torque in self.commands if when <= at][-1]
            x = (scipy.linalg.expm(generator() * ((edge - at) / NS_PER_S)) @ np.append(x, in_force))[:4]
            at = edge
        return np.asarray(x)

    def take(self, at: int, speed: float) -> None:
        """A reading; as many predictions of P as periods have passed."""
        self.x = self.ahead(at)
        for _ in range(round((at - self.at) / PERIOD)):
            self.P = self.Phi @ self.P @ self.Phi.T + self.Q
        self.at = at
        innovation = speed - self.x[2]
        self.x = self.x + np.append(0.0, self._correct_covariance()) * innovation


def test_the_filter_is_the_textbooks_through_losses_late_readings_and_fractions_of_a_period() -> None:
    draw = np.random.default_rng(15)
    predictor, textbook = predicting(), Textbook()
    speed = 0.0
    first = PERIOD
    predictor.receive(sample(1, first, speed))
    textbook.at = first
    waiting: list[tuple[int, int, float]] = []
    for number in range(2, 200):
        at = number * PERIOD + int(draw.integers(-20_000, 20_000))
        speed += float(draw.normal(0.0, 0.03))
        if draw.uniform() > 0.25:
            waiting.append((number, at, speed))
        if draw.uniform() < 0.6:  # several that were late come at once
            for came in waiting:
                predictor.receive(sample(*came))
                textbook.take(came[1], came[2])
            waiting.clear()
        acts_at = (number + 1) * PERIOD + int(draw.integers(0, 300_000))
        found, expected = estimate(predictor, acts_at), textbook.ahead(acts_at + DEAD_TIME)
        assert found.valid_at == acts_at + DEAD_TIME
        assert found.velocity_rad_s == pytest.approx(expected[1], abs=1e-3)
        assert found.torque_nm == pytest.approx(expected[0], abs=1e-6)
        assert predictor.load_nm == pytest.approx(textbook.x[3], abs=1e-3)
        torque = float(draw.normal(0.0, 0.5))
        predictor.sent(command(acts_at, torque))
        textbook.commands.append((acts_at + DEAD_TIME, torque))


def test_it_predicts_with_what_was_sent_and_not_with_what_was_asked_for() -> None:
    cut, whole = predicting(), predicting()
    for predictor, torque in ((cut, 0.5), (whole, 2.0)):
        predictor.receive(sample(1, PERIOD, 0.0))
        predictor.sent(command(2 * PERIOD, torque))
    lever = 8e-4 / 5e-3
    speeds = [estimate(each, 7 * PERIOD).velocity_rad_s * lever for each in (cut, whole)]
    assert speeds == pytest.approx([0.5, 2.0], rel=0.06)


def test_through_a_dropout_it_runs_on_by_the_model() -> None:
    predictor = predicting()
    predictor.receive(sample(1, PERIOD, 100.0))
    found = estimate(predictor, 51 * PERIOD)
    coasting = 100.0 * math.exp(-0.0501 * 1.85e-3 / 8e-4)
    assert found.velocity_rad_s == pytest.approx(coasting, rel=1e-6)
    assert found.sequence == 1


def test_an_overtaken_reading_changes_nothing() -> None:
    predictor = predicting()
    predictor.receive(sample(1, PERIOD, 0.0))
    predictor.receive(sample(3, 3 * PERIOD, 0.1))
    before = estimate(predictor, 4 * PERIOD)
    predictor.receive(sample(2, 2 * PERIOD, 50.0))
    assert estimate(predictor, 4 * PERIOD) == before


def test_a_step_of_the_load_is_followed_faster_than_noise_is() -> None:
    bold = replace(NOISE, load_nm_sqrt_s=0.5, load_max_nm_sqrt_s=10.0)

    def share_of_load(innovation: float) -> float:
        predictor = predicting(bold)
        predictor.receive(sample(1, PERIOD, 0.0))
        predictor.receive(sample(2, 2 * PERIOD, innovation))
        return predictor.load_nm / innovation

    small = 0.5 * NOISE.speed_rad_s
    large = 10.0 * STEP_SIGMAS * NOISE.speed_rad_s
    assert abs(share_of_load(large)) > 3.0 * abs(share_of_load(small))
    assert share_of_load(-small) == pytest.approx(share_of_load(small))


def test_reset_forgets_all() -> None:
    predictor = predicting()
    predictor.receive(sample(1, PERIOD, 0.0))
    predictor.receive(sample(2, 2 * PERIOD, 5.0))
    predictor.sent(command(3 * PERIOD, 1.0))
    predictor.reset()
    fresh = predicting()
    for each in (predictor, fresh):
        each.receive(sample(1, PERIOD, 1.0))
        each.receive(sample(2, 2 * PERIOD, 1.0))
    assert estimate(predictor, 5 * PERIOD) == estimate(fresh, 5 * PERIOD)
    assert predictor.load_nm == fresh.load_nm


def asked(controller: LoadCancelling, context: Context) -> float:
    answer = controller.output(context)
    assert isinstance(answer, TorqueSetPoint)
    return answer.torque_nm


def test_the_load_is_cancelled_and_a_ramp_fed_forward() -> None:
    controller = LoadCancelling(predicting(), PLANT, 0.4, 0.2)
    predictor = controller.observer()
    assert isinstance(predictor, Predictor)
    predictor.load_nm = 0.6
    ramp = ReferenceProfile([Ramp(0.0, 100.0, 1.0)])
    context = Context(PERIOD, ramp)
    context.begin(101, Instant(0), 0.1, 10.0, Instant(0), Instant(PERIOD))
    speed = 100.0 * (0.1 + (PERIOD + DEAD_TIME) / NS_PER_S)
    aim = 0.6 + 1.85e-3 * speed + 8e-4 * 100.0
    context.estimate = StateEstimate(0.0, speed, aim, Instant(0), 1)
    assert asked(controller, context) == pytest.approx(aim, rel=1e-6)
    context.estimate = StateEstimate(0.0, speed - 1.0, aim - 0.1, Instant(0), 1)
    assert asked(controller, context) == pytest.approx(aim + 0.4 * 1.0 + 0.2 * 0.1, rel=1e-6)
    assert controller.telemetry()[0] == 0.6
    assert len(controller.telemetry()) == len(controller.channels())
