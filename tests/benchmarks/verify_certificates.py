"""Drawn certificates, verified: ``python -m tests.benchmarks.verify_certificates --loops 50``.

Sampled loops are drawn and certified, and each certificate is checked from its digits alone. The same
matrices must not prove what is false: a gain below the one that a pattern of losses and delays is known to
reach, a decay beyond that of such a pattern.
"""

import argparse
import os
from collections.abc import Iterator
from dataclasses import replace
from decimal import Decimal
from typing import Any

import numpy as np

from servobench.design.sampled.analysis import SampledAnalysis, analyse_loop
from servobench.design.verify.file import claims_of
from tests.benchmarks.attack_peaks import DrawnLoop, drawn_loop
from tests.motors import LING

_PLANT = (
    "resistance_ohm",
    "inductance_q_h",
    "inertia_kg_m2",
    "viscous_friction_nm_s",
    "torque_constant_nm_a",
)


def whole(drawn: DrawnLoop) -> DrawnLoop:
    """Return the loop with times of whole microseconds, as a file has them."""
    times = {key: round(getattr(drawn, key) * 1e6) / 1e6 for key in ("period_s", "delay_max_s", "agreed_s")}
    if drawn.strategy == "history":
        times["agreed_s"] = max(
            times["agreed_s"], times["delay_max_s"] + drawn.losses_max * times["period_s"]
        )
    return replace(drawn, **times)


def table_of_loop(drawn: DrawnLoop, analysis: SampledAnalysis) -> dict[str, Any]:
    """Return the table [controller] of a file, as it is read: numbers by their digits."""
    assert analysis.gain_proof is not None
    assert analysis.decay_proof is not None
    times_s = {
        "period_us": drawn.period_s,
        "delay_max_us": drawn.delay_max_s,
        "agreed_delay_us": drawn.agreed_s,
    }
    table = {
        "kind": "state_feedback",
        "gain": list(drawn.gains),
        "made_for": {
            "strategy": drawn.strategy,
            "losses_in_a_row_max": drawn.losses_max,
            "plant": {key: getattr(LING, key) for key in _PLANT},
            "current_loop": {"bandwidth_hz": drawn.bandwidth_hz},
            **{key: round(value * 1e6) for key, value in times_s.items()},
        },
        "certificate": {
            "sequences": {
                "gain_certified": analysis.gain_proof.figure,
                "decay_certified_per_s": analysis.decay_proof.figure,
                "gain_matrices": [matrix.tolist() for matrix in analysis.gain_proof.P],
                "decay_matrices": [matrix.tolist() for matrix in analysis.decay_proof.P],
            }
        },
    }
    return dict(read_digits(table))


def read_digits(entry: Any) -> Any:
    """Return numbers as a file of them is read: by their digits."""
    if isinstance(entry, dict):
        return {key: read_digits(value) for key, value in entry.items()}
    if isinstance(entry, list):
        return [read_digits(each) for each in entry]
    return Decimal(repr(entry)) if isinstance(entry, float) else entry


def certified_loops(seed: int) -> Iterator[tuple[DrawnLoop, SampledAnalysis]]:
    """Yield drawn loops for which both gain and decay are certified."""
    draw = np.random.default_rng(seed)
    while True:
        drawn = whole(drawn_loop(draw))
        analysis = analyse_loop(drawn.loop())
        if analysis.gain_proof is not None and analysis.decay_proof is not None:
            yield drawn, analysis


def false_claims(table: dict[str, Any], analysis: SampledAnalysis) -> dict[str, Any]:
    """Return the same matrices with a gain and a decay that a known pattern breaks."""
    sequences = table["certificate"]["sequences"]
    found = {
        "gain_certified": Decimal(repr(float(analysis.gain_found) * (1.0 - 1e-6))),
        "decay_certified_per_s": Decimal(repr(float(analysis.decay_found_per_s) * (1.0 + 1e-6))),
    }
    return table | {"certificate": {"sequences": sequences | found}}


def _processor_s() -> float:
    return sum(os.times()[:2])


def main() -> None:
    """Verify certificates of drawn loops, and print what came of them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--loops", type=int, default=50)
    parser.add_argument("--seed", type=int, default=4012)
    parser.add_argument("--seconds", type=float, default=500.0, help="of processor time, certifying included")
    asked = parser.parse_args()
    times_s, proved, believed = [], 0, 0
    for number, (drawn, analysis) in enumerate(certified_loops(asked.seed), 1):
        table = table_of_loop(drawn, analysis)
        begun = _processor_s()
        claims = list(claims_of(table))
        times_s.append(_processor_s() - begun)
        proved += not any(claim.refused for claim in claims)
        for claim in claims:
            if claim.refused:
                print(f"{drawn}: {claim}")
        believed += sum(not claim.refused for claim in claims_of(false_claims(table, analysis)))
        if number == asked.loops or _processor_s() > asked.seconds:
            break
    count = len(times_s)
    print(f"{proved} of {count} certificates verified, {believed} of {2 * count} false claims believed")
    median, p95, most = np.quantile(times_s, [0.5, 0.95, 1.0])
    print(f"seconds of a file: median {median:.2f}, p95 {p95:.2f}, most {most:.2f}")


if __name__ == "__main__":
    main()
