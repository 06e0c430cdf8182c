"""Certificates over an interval of periods: against drawn lengths, and proved from their digits."""

from dataclasses import replace
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from servobench.design.delay.delay_loop import speed_model
from servobench.design.errors import UnsuitableNetwork
from servobench.design.sampled.analysis import SampledAnalysis, analyse_sampled, with_peak
from servobench.design.sampled.held_loop import HeldLoop, PeriodStep, SampledNetwork, Strategy, Switch
from servobench.design.sampled.loss_patterns import pattern_gains, pattern_of
from servobench.design.verify.file import claims_of, table_of
from servobench.hil.cli import app
from tests.attack.uneven import Attacked
from tests.benchmarks.verify_certificates import read_digits
from tests.motors import LING

K = np.array([-0.11722181469202031, -0.36947817689503454])
CONTROLLERS = Path("examples/controllers")
FILES = [CONTROLLERS / f"ling2012-{name}-uneven.toml" for name in ("static", "hinf")]
LATE, EARLY = 1004e-6, 900e-6
"""Delays beyond the shortest period, and below it."""
WITHIN_S = {LATE: 10e-6, EARLY: 20e-6}


@pytest.fixture(scope="module")
def analyses() -> dict[float, SampledAnalysis]:
    model = speed_model(LING, False, 800.0)
    networks = [SampledNetwork(Strategy.ARRIVAL, 1e-3, 0, each, 0.0, WITHIN_S[each]) for each in WITHIN_S]
    return {network.delay_max_s: analyse_sampled(model, K, network) for network in networks}


def test_a_certificate_lies_close_above_the_worst_lengths_that_are_found(
    analyses: dict[float, SampledAnalysis],
) -> None:
    for analysis in analyses.values():
        assert analysis.gain_certified is not None
        assert analysis.decay_certified_per_s is not None
        assert analysis.gain_found < analysis.gain_certified < 1.01 * analysis.gain_found
        assert 0.95 * analysis.decay_found_per_s < analysis.decay_certified_per_s < analysis.decay_found_per_s
        assert any(step.longer_s for step in analysis.worst.pattern.steps)
        assert with_peak(analysis).peak_certified is None, "peaks are of even periods"


@pytest.mark.parametrize("seed", range(8))
def test_no_pattern_of_drawn_lengths_and_delays_exceeds_it(
    seed: int, analyses: dict[float, SampledAnalysis]
) -> None:
    draw = np.random.default_rng(seed)
    for delay_s, analysis in analyses.items():
        loop = analysis.loop
        assert isinstance(loop, HeldLoop)
        longer_s = WITHIN_S[delay_s] * draw.uniform(-1.0, 1.0, 6)
        if seed % 2:
            longer_s = np.sign(longer_s) * WITHIN_S[delay_s]
        # a sample that comes within its period acts there, one that comes later in the next
        steps = []
        carried: list[Switch] = []
        for place in range(6):
            whole_s = 1e-3 + longer_s[place]
            at_s = delay_s * draw.uniform(0.8, 1.0)
            own = [Switch(0, at_s)] if at_s <= whole_s and place < 5 else []
            steps.append(PeriodStep(0 if own else 1, 0, (*carried, *own), longer_s[place]))
            carried = [] if own or place == 5 else [Switch(1, at_s - whole_s)]
        if carried or not steps[-1].switches:
            steps[-1] = replace(steps[-1], switches=(*steps[-1].switches, Switch(0, 0.5e-3)))
        pattern = pattern_of(loop, steps)
        assert pattern.decay_per_s > (analysis.decay_certified_per_s or np.inf)
        assert pattern_gains(loop, [pattern])[0] < (analysis.gain_certified or 0.0)


def table(analysis: SampledAnalysis, **claims: float) -> dict[str, Any]:
    """The table of a file with that certificate, claims in place of its own."""
    assert analysis.gain_proof is not None
    assert analysis.decay_proof is not None
    made = table_of(FILES[0])
    made["made_for"] |= {
        "losses_in_a_row_max": 0,
        "delay_max_us": round(1e6 * analysis.network.delay_max_s),
        "sync_within_us": round(1e6 * analysis.network.uneven_s),
    }
    own = {
        "gain_certified": analysis.gain_proof.figure,
        "decay_certified_per_s": analysis.decay_proof.figure,
        "gain_matrices": [matrix.tolist() for matrix in analysis.gain_proof.P],
        "decay_matrices": [matrix.tolist() for matrix in analysis.decay_proof.P],
    }
    made["certificate"]["sequences"] |= read_digits(own | claims)
    return made


@pytest.mark.parametrize("delay_s", [LATE, EARLY])
def test_the_digits_of_a_file_prove_it_and_nothing_beyond(
    delay_s: float, analyses: dict[float, SampledAnalysis]
) -> None:
    analysis = analyses[delay_s]
    assert [claim.refused for claim in claims_of(table(analysis))] == ["", ""]
    beyond = {
        "gain_certified": 0.999 * analysis.gain_found,
        "decay_certified_per_s": 1.001 * analysis.decay_found_per_s,
    }
    assert all(claim.refused for claim in claims_of(table(analysis, **beyond)))
    wider = table(analysis)
    wider["made_for"]["sync_within_us"] = 60
    assert all(claim.refused for claim in claims_of(wider))


def test_periods_are_longer_than_what_they_are_uneven_by() -> None:
    for uneven_s in (-1e-6, 1e-3):
        with pytest.raises(UnsuitableNetwork, match="uneven"):
            SampledNetwork(Strategy.ARRIVAL, 1e-3, 0, 1e-3, 0.0, uneven_s)


def test_an_attack_apart_from_the_design_reaches_less_than_is_certified() -> None:
    """With the worst pattern that the design's own search found for H-infinity: one lost of two, or three."""
    controller = table_of(FILES[1])
    floats = {key: [float(each) for each in controller[key]] for key in "BLC"}
    controller |= floats | {
        "A": [[float(each) for each in row] for row in controller["A"]],
        "D": float(controller["D"]),
    }
    for part in (controller["made_for"]["plant"], controller["made_for"]["current_loop"]):
        part |= {key: float(each) for key, each in part.items() if isinstance(each, Decimal)}
    for key in ("speed_filter_hz", "dead_time_us"):
        controller["certificate"][key] = float(controller["certificate"][key])
    loop, draw = Attacked(controller), np.random.default_rng(0)
    genes = loop.drawn(draw, 2)
    certified = float(controller["certificate"]["sequences"]["gain_certified"])
    assert all(3.0 < loop.gain(genes, row, draw) < certified for row in range(2))


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (
            ["design", "speed", "--structure", "predictor", "--delay-ms", "2"],
            "--sync-within-us: found 40, expected --structure static or hinf",
        ),
        (["design", "speed", "--delay-ms", "2"], "--sync-within-us: found 40, expected --network"),
        (
            ["analyse", "speed", "--gain", "0,-0.02", "--delay-ms", "2"],
            "--sync-within-us: found '40', expected --period-ms with it",
        ),
    ],
)
def test_the_option_is_refused_where_nothing_is_certified_for_it(options: list[str], told: str) -> None:
    command, kind, *more = options
    asked = [command, kind, "examples/motors/ling2012.toml", *more, "--sync-within-us", "40"]
    done = CliRunner().invoke(app, asked)
    assert done.exit_code == 2
    assert told in done.output
