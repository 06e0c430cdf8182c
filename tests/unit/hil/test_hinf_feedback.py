"""The H-infinity controller of the host against the same matrices in numpy."""

from pathlib import Path

import numpy as np
import pytest

from servobench.drivers.errors import BadInput
from servobench.drivers.exchange import Command
from servobench.drivers.timebase import NS_PER_MS, Duration, Instant
from servobench.hil.configuration.bench_file import load_controller
from servobench.hil.configuration.controller_kinds import HinfSection
from servobench.hil.configuration.motor_file import LING2012
from servobench.hil.control.controllers import HinfFeedback
from servobench.hil.control.setup import Setup
from servobench.hil.loop.protocol import Context, TorqueSetPoint
from servobench.hil.loop.samples import StateEstimate
from servobench.hil.loop.scenario import Ramp, ReferenceProfile

PERIOD = Duration(NS_PER_MS)
A = ((0.5, 0.2, 0.0), (-0.2, 0.5, 0.0), (0.0, 0.1, 0.9))
B, L, C, D = (0.3, -0.1, 0.05), (0.2, 0.4, 0.1), (0.7, -0.2, 0.6), 0.8
FILE = Path("examples/controllers/ling2012-hinf.toml")


def feedback(answer_periods: float = 1.6) -> HinfFeedback:
    return HinfFeedback(A, B, L, C, D, 8e-4, 1.85e-3, answer_periods)


def drive(
    controller: HinfFeedback, speeds: np.ndarray, most_nm: float, profile: ReferenceProfile
) -> list[float]:
    """What it asks for; more than ``most_nm`` is cut off before it is sent."""
    context, asked = Context(PERIOD, profile), []
    for number, speed in enumerate(speeds):
        at = (number + 1) * PERIOD
        time_s = number * 1e-3
        context.begin(
            number + 1, Instant(0), time_s, profile.value(time_s), Instant(at), Instant(at + PERIOD)
        )
        context.estimate = StateEstimate(0.0, float(speed), 0.0, Instant(at), number + 1)
        answer = controller.output(context)
        assert isinstance(answer, TorqueSetPoint)
        asked.append(answer.torque_nm)
        sent = max(-most_nm, min(most_nm, answer.torque_nm))
        controller.update(context, Command(1, sent, Instant(at), Instant(at + PERIOD)))
    return asked


@pytest.mark.parametrize("answer_periods", [0.3, 1.0, 1.6, 4.25])
def test_it_is_the_matrices_with_the_command_that_was_sent(answer_periods: float) -> None:
    profile = ReferenceProfile([Ramp(0.0, 10.0, 0.05)])
    speeds = np.random.default_rng(15).normal(0.0, 1.0, 120)
    controller = feedback(answer_periods)
    asked = drive(controller, speeds, 0.5, profile)
    a, b, sent_in, c = map(np.array, (A, B, L, C))
    x, expected = np.zeros(3), []
    for number, speed in enumerate(speeds):
        now, following = (profile.value(1e-3 * (number + ahead)) for ahead in (0, 1))
        error = profile.value(max(0.0, 1e-3 * (number - answer_periods))) - speed
        forward = 1.85e-3 * now + 8e-4 * (following - now) / 1e-3
        u = c @ x + D * error + forward
        x = a @ x + b * error + sent_in * (np.clip(u, -0.5, 0.5) - forward)
        expected.append(u)
    assert np.max(np.abs(expected)) > 0.6  # else no limit has cut anything off
    assert asked == pytest.approx(expected, abs=1e-9)


def test_reset_forgets_all() -> None:
    controller, speeds = feedback(), np.linspace(0.0, 3.0, 20)
    first = drive(controller, speeds, 0.5, ReferenceProfile([]))
    controller.reset()
    assert drive(controller, speeds, 0.5, ReferenceProfile([])) == first


def setup(period: Duration) -> Setup:
    return Setup("axis1", period, LING2012.parameters, 6.0, 300.0, 1.0, "bench.toml")


def test_a_period_that_is_not_its_own_is_refused() -> None:
    table = load_controller(FILE)
    assert isinstance(table, HinfSection)
    assert isinstance(table.build(setup(PERIOD)), HinfFeedback)
    with pytest.raises(BadInput, match=r"drive\.axis1\.controller\.period_us"):
        table.build(setup(Duration(2 * NS_PER_MS)))


def test_matrices_that_do_not_fit_are_refused() -> None:
    table = load_controller(FILE)
    assert isinstance(table, HinfSection)
    tables = table.model_dump(mode="json", exclude_none=True)
    with pytest.raises(ValueError, match="4 rows and columns"):
        HinfSection.model_validate(tables | {"A": tables["A"][:3]})
    with pytest.raises(ValueError, match="4 rows and columns"):
        HinfSection.model_validate(tables | {"L": tables["L"][:3]})
