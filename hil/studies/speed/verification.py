"""The certificate of a controller's file, proved anew from its digits with every rounding enclosed."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from servobench.design.speed.predictor_gains import GainBoxes
from servobench.design.speed.predictor_loop import Walks
from servobench.design.speed.predictor_plant import PredictorPlant, kalman_model, of_state
from servobench.design.verify.digest import digest_of
from servobench.design.verify.file import claims_of, table_of
from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import US_PER_S
from servobench.hil.configuration.bench_file import load_controller
from servobench.hil.configuration.predicting_controllers import PredictorController

_TOLERANCE = 1e-6
"""Relative: gains of a filter that are worked out on another processor differ by its rounding, 1e-12; the box
of the file has a thousandth of room."""
_NEEDED = {"hinf": ("speed_filter_hz", "dead_time_us"), "predictor": ("filter_gains",)}
"""Premises of the proof that older files lack."""
NOT_CHECKED = (
    "gain_certified_all_bandwidths",
    "step_peak_certified_rad_s",
    "decay_certified_all_bandwidths_per_s",
)
"""Figures of a file whose proofs it does not carry."""


def verified(path: Path) -> dict[str, Any]:
    """Return what the file claims, for JSON. Raises BadInput for a file without a certificate to check."""
    controller = load_controller(path)
    certificate = getattr(controller, "certificate", None)
    sequences = getattr(certificate, "sequences", None)
    if sequences is None:
        key = "controller.certificate.sequences"
        raise BadInput(str(path), key, "nothing", "a file of hil design speed that is certified for losses")
    for key in _NEEDED.get(controller.kind, ()):
        if getattr(certificate, key) is None:
            key = f"controller.certificate.{key}"
            raise BadInput(str(path), key, "nothing", "what hil design speed writes today: make it anew")
    table = table_of(path)
    claims = [
        {"key": claim.key, "value": float(claim.figure), "unit": claim.unit, "refused": claim.refused}
        for claim in claims_of(table)
    ]
    premises = _premises(controller)
    digest = table["certificate"]["sequences"].get("digest")
    unchanged = None if digest is None else digest == digest_of(table)
    return {
        "file": str(path),
        "proved": not any(claim["refused"] for claim in claims) and not premises and unchanged is not False,
        "claims": claims,
        "premises_refused": premises,
        "unchanged": unchanged,
        "not_checked": [key for key in NOT_CHECKED if getattr(sequences, key) is not None],
    }


def _premises(controller: Any) -> list[str]:
    """Return what the proof takes from the file and the controller's own model does not bear out."""
    if not isinstance(controller, PredictorController):
        return []
    made, certificate = controller.made_for, controller.certificate
    assert made is not None
    assert made.period_us is not None
    assert certificate is not None
    assert certificate.filter_gains is not None
    plant = PredictorPlant(
        controller.inertia_kg_m2,
        controller.viscous_friction_nm_s,
        math.tau * controller.current_bandwidth_hz,
        math.tau * controller.speed_filter_hz,
    )
    noise = controller.speed_noise_rad_s, controller.torque_noise_nm
    model = kalman_model(plant, made.period_us / US_PER_S, *noise)
    walks = Walks(controller.load_noise_nm_sqrt_s, controller.load_noise_max_nm_sqrt_s)
    boxes = GainBoxes(model, walks, certificate.losses_in_a_row_max)
    refused = []
    for lost, told in enumerate(certificate.filter_gains):
        ends = np.array(boxes.corners(lost))
        own = np.array([of_state(np.array(gain)) for gain in told])
        if own.shape != ends.shape or not np.allclose(own, ends, rtol=_TOLERANCE, atol=_TOLERANCE):
            refused.append(f"filter_gains after {lost} losses are not those of the filter")
    return refused
