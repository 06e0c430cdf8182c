"""Loops under random losses: decay by the Kronecker product, figures beside runs by chance."""

import math
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from servobench.design.delay.delay_loop import model_of
from servobench.design.sampled.held_loop import HeldLoop, PeriodStep, SampledNetwork, Strategy, Switch
from servobench.design.sampled.jump_loop import JumpLoop, LossyLink, exceedance, fates_of
from servobench.design.speed.random_loops import RandomHeld
from servobench.hil.configuration.bench_file import load_controller
from servobench.hil.configuration.predicting_controllers import FusedController
from servobench.hil.studies.speed.random_losses import remembering_of
from tests.benchmarks.bench_random_losses import FILES, Link, beside, fates

MODEL = model_of(math.tau * 800.0, 0.4, 8e-4, 1.85e-3, integral=False)
K = np.array([-0.12, -0.37])


def held(strategy: Strategy = Strategy.ARRIVAL, losses_max: int = 0, agreed_s: float = 0.0) -> HeldLoop:
    return HeldLoop(MODEL, K, SampledNetwork(strategy, 1e-3, losses_max, 0.8e-3, agreed_s))


def test_decay_in_mean_square_is_that_of_the_kronecker_products() -> None:
    loop, lost = held(), 0.3
    came, gone = (
        loop.transition(loop.chain(PeriodStep(0, 0, switches))) for switches in ((Switch(0, 0.8e-3),), ())
    )
    radius = np.abs(np.linalg.eigvals((1.0 - lost) * np.kron(came, came) + lost * np.kron(gone, gone))).max()
    found = JumpLoop(RandomHeld(loop), fates_of(LossyLink(loss_good=lost), LossyLink())).decay_per_s()
    assert found == pytest.approx(-0.5 * math.log(radius) / 1e-3, rel=1e-6)


def test_bursts_are_worse_than_as_many_losses_one_by_one() -> None:
    bursts = LossyLink(0.02, 0.2, 1.0, 0.0)
    alone = LossyLink(loss_good=bursts.loss)
    first, second = (JumpLoop(RandomHeld(held()), fates_of(each, LossyLink())) for each in (alone, bursts))
    assert bursts.loss == pytest.approx(0.02 / 0.22)
    assert second.decay_per_s() < first.decay_per_s()
    assert second.moments().deviation.max() > first.moments().deviation.max()


def test_a_link_in_bursts_loses_as_its_model_says() -> None:
    link = Link(0.05, 0.3, 0.8, 0.02)
    draw = np.random.default_rng(1)
    lost = np.mean(list(islice(fates(link, 4000, draw), 50)))
    assert LossyLink(*link).loss == pytest.approx(lost, abs=0.005)


def test_packets_with_history_make_up_for_as_many_losses_as_they_hold() -> None:
    loop = held(Strategy.HISTORY, losses_max=2, agreed_s=2.8e-3)
    none, some = (
        JumpLoop(RandomHeld(loop), fates_of(losses, LossyLink())).moments().deviation.max()
        for losses in (LossyLink(1.0, 1.0, 1.0, 0.0), LossyLink(0.02, 0.2))
    )
    assert none < 1e-6, "every second is lost"
    assert some > 0.01, "bursts of five"


def test_a_loop_that_grows_in_mean_square_says_so_and_bounds_by_what_it_saw() -> None:
    fast = HeldLoop(MODEL, np.array([-0.3, -1.2]), SampledNetwork(Strategy.ARRIVAL, 1e-3, 0, 0.8e-3))
    loop = JumpLoop(RandomHeld(fast), fates_of(LossyLink(loss_good=0.7), LossyLink()))
    assert loop.decay_per_s() < 0.0
    peak = np.abs(JumpLoop(RandomHeld(fast), fates_of(LossyLink(), LossyLink())).moments().mean).max()
    low, high = exceedance(loop, 1.5 * peak, None)
    assert 0.1 < low < 1.0
    assert high == 1.0


def test_a_threshold_that_is_passed_before_anything_acts_is_passed_for_certain() -> None:
    loop = JumpLoop(RandomHeld(held()), fates_of(LossyLink(loss_good=0.1), LossyLink()))
    assert exceedance(loop, 1.0, None) == (1.0, 1.0)


@pytest.mark.long
@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_figures_agree_with_runs_that_share_nothing_with_them(path: Path) -> None:
    links = Link(0.03, 0.6, 0.8, 0.01), Link(0.02, 0.6, 0.9)
    for figure in beside(path, links, 3000, 7, periods=40, multiples=(1.25,)):
        assert figure.inside, figure


def test_the_fused_predictor_bears_outages_of_ten_periods_on_average() -> None:
    controller = load_controller(Path("examples/controllers/ling2012-fused.toml"))
    assert isinstance(controller, FusedController)
    bursts = fates_of(LossyLink(0.02, 0.1, 1.0, 0.0), LossyLink())
    few = controller.model_copy(update={"gains": controller.gains[:6]})
    whole, short = (
        JumpLoop(remembering_of(each, Path(), 0.6), bursts).decay_per_s() for each in (controller, few)
    )
    assert whole > 5.0
    assert short < -20.0, "gains for five losses, as files had them before, correct too far after more"
