"""What is certified over lost samples of a controller with states of its own: its figures and its file."""

from collections.abc import Sequence
from typing import Any

from design.delay.lmi import SOLVER
from design.sampled.analysis import SampledAnalysis
from hil.configuration.speed_controller_file import LossCertificate
from hil.studies.speed.controller_text import sequence_proof

_COVERS = "samples lost, at the delay and with the plant of the design, every command arriving"


def certified_of(attempts: Sequence[SampledAnalysis]) -> SampledAnalysis | None:
    """That of most losses in a row; ``attempts``: of ever fewer, up to the first that is certified."""
    return attempts[-1] if attempts and attempts[-1].certified else None


def loss_figures(attempts: Sequence[SampledAnalysis]) -> dict[str, Any]:
    """For JSON."""
    certified = certified_of(attempts)
    missed = {
        f"{each.network.losses_max}_in_a_row": each.without_certificate
        for each in attempts
        if not each.certified
    }
    figures: dict[str, Any] = {"covers": _COVERS} | ({"not_certified": missed} if missed else {})
    if certified is None:
        return figures | {"losses_in_a_row": None}
    return figures | {
        "losses_in_a_row": certified.network.losses_max,
        "gain_certified": certified.gain_certified,
        "gain_found": certified.gain_found,
        "decay_certified_per_s": certified.decay_certified_per_s,
        "decay_found_per_s": certified.decay_found_per_s,
    }


def loss_certificate(attempts: Sequence[SampledAnalysis]) -> LossCertificate | None:
    """The table of a controller file."""
    certified = certified_of(attempts)
    sequences = None if certified is None else sequence_proof(certified)
    if certified is None or sequences is None:
        return None
    return LossCertificate(
        losses_in_a_row_max=certified.network.losses_max, solver=SOLVER, sequences=sequences
    )
