"""The loop that is sampled and held: transitions, gains, certificates and chance, each seen another way."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.signal import cont2discrete

from design.delay_norm import hinf_norm
from design.errors import UnsuitableNetwork
from design.held_loop import Delivery, HeldLoop, SampledNetwork, Strategy
from design.lifting import sampled_gain
from design.loss_patterns import chain_of, repeated, worst_pattern
from design.monte_carlo import Chance, Uncertainty, run_many, share
from design.sampled import SampledAnalysis, analyse_sampled
from design.speed_loop import speed_model
from tests.motors import LING

MODEL = speed_model(LING)
K = np.array([0.0, -0.0212])
H = 0.01


def network(
    strategy: Strategy, losses: int = 5, delay: float = 0.004, agreed: float = 0.064
) -> SampledNetwork:
    """The paper's: 10 ms, at most five lost in a row, up to 4 ms, 64 ms agreed."""
    return SampledNetwork(strategy, H, losses, delay, 0.0 if strategy is Strategy.ARRIVAL else agreed)


@pytest.fixture(scope="module")
def analyses() -> dict[Strategy, SampledAnalysis]:
    """Each strategy on the paper's network."""
    return {strategy: analyse_sampled(MODEL, K, network(strategy)) for strategy in Strategy}


def test_without_loss_and_delay_it_is_the_zero_order_hold() -> None:
    loop = HeldLoop(MODEL, K, network(Strategy.ARRIVAL, 0, 0.0))
    A, B, *_ = cont2discrete((MODEL.A, MODEL.B1[:, None], np.eye(2), np.zeros((2, 1))), H)
    expected = np.sort(np.abs(np.linalg.eigvals(A + B @ K[None, :])))
    found = np.sort(np.abs(np.linalg.eigvals(loop.kept_transition(loop.step(Delivery(1, 0.0))))))
    assert found[-2:] == pytest.approx(expected, rel=1e-10)


@given(
    strategy=st.sampled_from(list(Strategy)),
    pattern=st.lists(st.tuples(st.integers(1, 4), st.floats(0.0, 1.0)), min_size=1, max_size=6),
    agreed=st.floats(0.041, 0.075),
)
@settings(derandomize=True, deadline=None, max_examples=60)
def test_steps_are_the_rule_of_each_strategy(
    strategy: Strategy, pattern: list[tuple[int, float]], agreed: float
) -> None:
    """A simulation in plain words: who sampled what when, and which sample is applied at each instant."""
    loop = HeldLoop(MODEL, K, network(strategy, 3, 0.004, agreed))
    always = strategy is Strategy.HISTORY
    deliveries = [Delivery(1 if always else interval, 0.004 * part) for interval, part in pattern]
    xi = np.zeros(loop.size)
    xi[: loop.kept] = np.linspace(1.0, 2.0, loop.kept)
    end = xi.copy()
    for delivery in deliveries:
        end = loop.transition(loop.step(delivery)) @ end
    x, held, waiting = xi[:2], xi[2], list(xi[3 : 3 + loop.kept - 3])
    for delivery in deliveries:
        for k in range(delivery.interval):
            waiting.insert(0, float(K @ x))
            came = k == 0
            if strategy is Strategy.ARRIVAL:
                at, applied = delivery.delay_s, waiting.pop() if came else None
                waiting = waiting if came else []
            else:
                at, applied = agreed % H, waiting.pop()
            x = simulated(x, held, at if came else H)
            if came:
                assert applied is not None
                held = applied
                x = simulated(x, held, H - at)
    assert end[:2] == pytest.approx(x, rel=1e-9)
    assert end[2] == pytest.approx(held, rel=1e-9)


def simulated(x: np.ndarray, u: float, time_s: float) -> np.ndarray:
    """x after ``time_s`` with the input held."""
    M = np.zeros((3, 3))
    M[:2, :2], M[:2, 2] = MODEL.A, MODEL.B1
    return np.asarray((expm(M * time_s) @ np.append(x, u))[:2])


def simulated_with_load(x: np.ndarray, u: float, time_s: float) -> np.ndarray:
    """The same under a load of 1 N m."""
    M = np.zeros((4, 4))
    M[:2, :2], M[:2, 2], M[:2, 3] = MODEL.A, MODEL.B1, MODEL.B2
    return np.asarray((expm(M * time_s) @ np.append(x, [u, 1.0]))[:2])


def test_figures_of_the_published_loop(analyses: dict[Strategy, SampledAnalysis]) -> None:
    """Decay to 1e-4 and gain to 1e-3 of another program's."""
    assert analyses[Strategy.HISTORY].decay_per_s == pytest.approx(7.7502, rel=1e-4)
    assert analyses[Strategy.STAMP].decay_per_s == pytest.approx(3.8641, rel=1e-4)
    assert analyses[Strategy.HISTORY].gain == pytest.approx(136.425, rel=1e-3)
    assert analyses[Strategy.STAMP].gain == pytest.approx(216.12, rel=1e-3)
    assert analyses[Strategy.ARRIVAL].gain == pytest.approx(98.486, rel=1e-3)


def test_certified_and_refuted_embrace_the_truth(analyses: dict[Strategy, SampledAnalysis]) -> None:
    for analysis in analyses.values():
        assert analysis.certificate is not None
        assert 0.0 < analysis.certificate.decay_per_s <= analysis.worst.decay_per_s * (1.0 + 1e-9)
        assert analysis.worst.decay_per_s <= analysis.decay_per_s * (1.0 + 1e-9)
        assert analysis.certificate.min_margin > 0.0
    arrival = analyses[Strategy.ARRIVAL]
    assert arrival.certificate is not None
    assert arrival.worst.decay_per_s / arrival.certificate.decay_per_s < 1.0001


def test_certificate_holds_on_random_sequences(analyses: dict[Strategy, SampledAnalysis]) -> None:
    """The function of the certificate falls as certified, whatever the losses and delays."""
    analysis = analyses[Strategy.ARRIVAL]
    certificate = analysis.certificate
    assert certificate is not None
    loop = HeldLoop(MODEL, K, analysis.network)
    draw = np.random.default_rng(3)
    before = 1
    xi = draw.normal(size=loop.kept)
    for _ in range(400):
        delivery = Delivery(int(draw.integers(1, 7)), float(draw.uniform(0.0, 0.004)))
        after = loop.kept_transition(loop.step(delivery)) @ xi
        nodes = len(certificate.P)
        P0, P1 = (certificate.P[0 if nodes == 1 else which - 1] for which in (before, delivery.interval))
        share_left = math.exp(-2.0 * certificate.decay_per_s * delivery.interval * H)
        assert after @ P1 @ after <= share_left * (xi @ P0 @ xi) * (1.0 + 1e-9)
        before, xi = delivery.interval, after / np.linalg.norm(after)


def test_a_destabilising_sequence_is_found_though_every_regular_one_is_stable() -> None:
    """With a gain three times as large the search refutes what it can repeat."""
    analysis = analyse_sampled(MODEL, 3.4 * K, network(Strategy.STAMP))
    assert analysis.refuted
    assert not analysis.certified
    loop = HeldLoop(MODEL, 3.4 * K, analysis.network)
    assert repeated(loop, analysis.worst.deliveries).decay_per_s == pytest.approx(analysis.worst.decay_per_s)


def test_search_beats_brute_force_on_short_patterns() -> None:
    loop = HeldLoop(MODEL, K, network(Strategy.STAMP, 2, 0.004, 0.03))
    choices = [Delivery(interval, 0.004) for interval in (1, 2, 3)]
    brute = min(
        repeated(loop, chain).decay_per_s
        for length in range(1, 5)
        for chain in itertools.product(choices, repeat=length)
    )
    assert worst_pattern(loop).decay_per_s <= brute + 1e-9


def test_gain_by_lifting_is_that_of_fast_sampling() -> None:
    """The disturbance held on 400 slices of a period, the output read at their middles."""
    loop = HeldLoop(MODEL, K, network(Strategy.ARRIVAL, 0, 0.004))
    slices = 400
    dt = H / slices
    M = np.zeros((4, 4))
    M[:2, :2], M[:2, 2], M[:2, 3] = MODEL.A, MODEL.B1, MODEL.B2
    half = expm(M * 0.5 * dt)
    xi = np.eye(3, 3 + slices)  # x, held, as maps of (xi, d)
    rows = []
    sample = K @ xi[:2]
    for k in range(slices):
        if k == round(0.004 / dt):
            xi[2] = sample
        d = np.zeros((1, 3 + slices))
        d[0, 3 + k] = 1.0 / math.sqrt(dt)
        for part in range(2):
            xi[:2] = half[:2] @ np.vstack([xi, d])
            if part == 0:
                rows.append(xi[1] * math.sqrt(dt))
    A, B = xi[:, :3], xi[:, 3:]
    C, D = np.array(rows)[:, :3], np.array(rows)[:, 3:]
    gains = [
        np.linalg.norm(C @ np.linalg.solve(np.exp(1j * angle) * np.eye(3) - A, B) + D, 2)
        for angle in np.linspace(0.0, math.pi, 24)
    ]
    assert sampled_gain(loop, chain_of(loop, repeated(loop, (Delivery(1, 0.004),)))) == pytest.approx(
        max(gains), rel=1e-4
    )


def test_fast_sampling_comes_to_the_continuous_loop() -> None:
    """History at a short period is nearly a constant delay of eta + h/2."""
    h = 0.0005
    loop = HeldLoop(MODEL, K, SampledNetwork(Strategy.HISTORY, h, 0, 0.0, 0.06))
    gain = sampled_gain(loop, chain_of(loop, repeated(loop, (Delivery(1, 0.0),))))
    assert gain == pytest.approx(hinf_norm(MODEL.loop(K, 0.06 + h / 2)), rel=1e-4)


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ({"period_s": 0.0}, "period"),
        ({"losses_max": -1}, "losses in a row"),
        ({"delay_max_s": math.nan}, "delay"),
        ({"delay_max_s": 0.02}, "stamp or history"),
        ({"strategy": Strategy.HISTORY, "agreed_delay_s": 0.05}, "at least 54 ms"),
        ({"strategy": Strategy.STAMP, "agreed_delay_s": 0.003}, "at least 4 ms"),
    ],
)
def test_networks_that_make_no_sense_are_refused(bad: dict[str, object], message: str) -> None:
    good = {"strategy": Strategy.ARRIVAL, "period_s": H, "losses_max": 5, "delay_max_s": 0.004}
    with pytest.raises(UnsuitableNetwork, match=message):
        SampledNetwork(**{**good, **bad})  # type: ignore[arg-type]


class TestMonteCarlo:
    def test_without_chance_it_is_the_transition(self) -> None:
        """No loss, no delay, no uncertainty: the error comes to rest at load over stiffness."""
        chance = Chance(runs=50, seed=1, duration_s=2.0, loss_probability=0.0, load_nm=0.6)
        outcomes = run_many(LING, K, network(Strategy.ARRIVAL, 0, 0.0), chance)
        static = 0.6 / (LING.viscous_friction_nm_s - LING.torque_constant_nm_a * K[1])
        assert outcomes.ends_rad_s == pytest.approx(np.full(50, static), rel=1e-6)
        assert outcomes.diverged.value == 0.0

    def test_the_peak_between_two_samples_is_not_missed(self) -> None:
        """At a long period the error turns inside it: against a simulation in small steps."""
        slow, late = 0.03, []
        net = SampledNetwork(Strategy.ARRIVAL, slow, 0, 0.0)
        chance = Chance(runs=400, seed=4, duration_s=0.3, loss_probability=0.0)
        for phase in np.linspace(0.0, slow, 25):
            x, held, peak = np.zeros(2), 0.0, 0.0
            for k in range(11):
                for _ in range(60):
                    x = simulated_with_load(x, held, slow / 60 if k else (slow - phase) / 60)
                    peak = max(peak, abs(x[1]))
                held = float(K @ x)
            late.append(peak)
        peaks = run_many(LING, K, net, chance).peaks_rad_s
        assert peaks.min() == pytest.approx(min(late), rel=2e-3)
        assert peaks.max() == pytest.approx(max(late), rel=2e-3)

    @pytest.mark.parametrize("strategy", list(Strategy))
    def test_same_seed_same_runs(self, strategy: Strategy) -> None:
        spread = Uncertainty(resistance=0.2, inductance=0.2, inertia=0.3, friction=0.5, torque_constant=0.1)
        chance = Chance(runs=300, seed=5, loss_probability=0.3, uncertainty=spread)
        first, second = (run_many(LING, K, network(strategy), chance) for _ in range(2))
        assert np.array_equal(first.peaks_rad_s, second.peaks_rad_s)
        other = run_many(LING, K, network(strategy), Chance(300, 6, loss_probability=0.3, uncertainty=spread))
        assert not np.array_equal(first.peaks_rad_s, other.peaks_rad_s)

    def test_more_loss_is_worse_and_what_is_refuted_diverges(self) -> None:
        def peak(loss: float, gain: float = 1.0) -> float:
            chance = Chance(runs=2000, seed=8, loss_probability=loss)
            return run_many(LING, gain * K, network(Strategy.STAMP), chance).peak_quantile(0.9).value

        assert peak(0.0) < peak(0.3) < peak(0.6)
        chance = Chance(runs=200, seed=8, duration_s=20.0, loss_probability=1.0)
        assert run_many(LING, 3.4 * K, network(Strategy.STAMP), chance).diverged.low > 0.9

    def test_interval_of_a_share_is_clopper_and_pearsons(self) -> None:
        """Textbook: 0 of 10 gives at most 0.3085, 5 of 10 gives 0.1871 to 0.8129."""
        assert share(0, 10).high == pytest.approx(0.3085, abs=1e-4)
        assert (share(5, 10).low, share(5, 10).high) == pytest.approx((0.1871, 0.8129), abs=1e-4)

    def test_chance_out_of_range_is_refused(self) -> None:
        with pytest.raises(ValueError, match="loss probability"):
            Chance(runs=1, seed=0, loss_probability=1.5)
        with pytest.raises(ValueError, match="inertia"):
            Uncertainty(inertia=1.0)
