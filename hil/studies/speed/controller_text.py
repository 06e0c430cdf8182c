"""The file of a speed controller: its gain, its design conditions, and its proofs."""

import math
import tomllib
from decimal import Decimal
from typing import Any

import numpy as np

from servobench.design.delay.lmi import SOLVER
from servobench.design.motor import PmsmParameters
from servobench.design.sampled.analysis import SampledAnalysis
from servobench.design.sampled.bandwidth_range import BandwidthRange
from servobench.design.sampled.held_loop import SampledNetwork, Strategy
from servobench.design.verify.digest import digest_of
from servobench.drivers.timebase import US_PER_S
from servobench.hil.configuration.config_files import Section, toml_text
from servobench.hil.configuration.controller_files import (
    Certificate,
    CurrentLoop,
    DesignCoupling,
    DesignPlant,
    MadeFor,
    SequenceProof,
)
from servobench.hil.configuration.controller_kinds import StateFeedbackController
from servobench.hil.studies.numbers import finite
from servobench.hil.studies.speed.synthesis import DesignResult


def whole_us(time_s: float) -> int:
    """Round up to the next whole microsecond, except for rounding errors."""
    return math.ceil(time_s * US_PER_S - 1e-6)


def begun_us(time_s: float) -> int:
    """Round down to a whole microsecond, except for rounding errors."""
    return math.floor(time_s * US_PER_S + 1e-6)


def plant_of(motor: PmsmParameters) -> DesignPlant:
    """Return the plant data of a design that knows no coupling."""
    figures = {name: getattr(motor, name) for name in DesignPlant.model_fields if name != "coupling"}
    return DesignPlant.model_validate(figures)


def coupled_plant_of(motor: PmsmParameters) -> DesignPlant:
    """Return the plant data of a design that knows the coupling of its motor."""
    mechanism = motor.mechanism
    if mechanism is None or mechanism.coupling is None:
        return plant_of(motor)
    shaft, friction = mechanism.coupling, mechanism.friction
    coupling = DesignCoupling(
        motor_kg_m2=shaft.motor_kg_m2,
        load_kg_m2=shaft.load_kg_m2,
        stiffness_nm_rad=shaft.stiffness_nm_rad,
        damping_nm_s=shaft.damping_nm_s,
        encoder=shaft.encoder.value,
        friction="motor" if friction is None else friction.side.value,
    )
    return plant_of(motor).model_copy(update={"coupling": coupling})


def controller_of(result: DesignResult) -> StateFeedbackController:
    """Return the table [controller] of a design."""
    return StateFeedbackController(
        kind="state_feedback",
        gain=tuple(result.gains),
        made_for=_made_for(result),
        certificate=Certificate.model_validate(
            {
                "method": result.request.way.method,
                "target": "sampled" if result.request.way.for_sampled else "constant",
                "gamma_exact": finite(result.gamma_exact),
                "sequences": sequence_proof(result.sampled, result.bandwidths),
                **_constant(result),
            }
        ),
    )


def _constant(result: DesignResult) -> dict[str, object]:
    """Return the certificate of the loop with the constant delay."""
    if result.certified is None:
        return {"solver": SOLVER, "status": "see sequences"}
    covered = result.bandwidths if result.sampled is None else None
    return result.certificate() | {"gamma_all_bandwidths": None if covered is None else covered.gain}


def controller_text(controller: Section) -> str:
    """Return the file that a bench names as ``controller``, with the digest of its certificate."""
    table = controller.model_dump(mode="json", exclude_none=True)
    sequences = (table.get("certificate") or {}).get("sequences")
    if sequences is not None:
        text = toml_text({"controller": table})
        sequences["digest"] = digest_of(tomllib.loads(text, parse_float=Decimal)["controller"])
    return toml_text({"controller": table})


def _made_for(result: DesignResult) -> MadeFor:
    network = result.request.network
    return MadeFor(
        delay_us=begun_us(result.design.delay_s),
        plant=coupled_plant_of(result.request.motor),
        current_loop=_current_loop(result),
        **({} if network is None else _network(network)),
    )


def _network(network: SampledNetwork) -> dict[str, Any]:
    waits = network.strategy is not Strategy.ARRIVAL
    return {
        "strategy": network.strategy.value,
        "period_us": whole_us(network.period_s),
        "losses_in_a_row_max": network.losses_max,
        "delay_max_us": begun_us(network.delay_max_s),
        "agreed_delay_us": whole_us(network.agreed_delay_s) if waits else None,
        "sync_within_us": begun_us(network.uneven_s) or None,
    }


def sequence_proof(
    sampled: SampledAnalysis | None, bandwidths: BandwidthRange | None = None
) -> SequenceProof | None:
    """Return the certificate over every sequence, and for all ``bandwidths``; None: not both gain and
    decay."""
    if sampled is None or sampled.gain_proof is None or sampled.decay_proof is None:
        return None
    gain, decay = sampled.gain_proof, sampled.decay_proof
    return SequenceProof(
        gain_certified=gain.figure,
        gain_certified_all_bandwidths=bandwidths.gain if bandwidths else None,
        gain_found=sampled.gain_found,
        step_peak_certified_rad_s=sampled.peak_certified,
        step_peak_found_rad_s=finite(sampled.peak_found),
        decay_certified_per_s=decay.figure,
        decay_certified_all_bandwidths_per_s=bandwidths.decay_per_s if bandwidths else None,
        decay_found_per_s=sampled.decay_found_per_s,
        min_margin=min(gain.min_margin, decay.min_margin),
        gain_matrices=tuple(np.asarray(matrix).tolist() for matrix in gain.P),
        decay_matrices=tuple(np.asarray(matrix).tolist() for matrix in decay.P),
    )


def _current_loop(result: DesignResult) -> CurrentLoop | None:
    bandwidth_hz = result.request.current_bandwidth_hz
    if bandwidth_hz is None:
        return None
    covered = result.bandwidths
    return CurrentLoop(
        bandwidth_hz=bandwidth_hz,
        bandwidth_min_hz=bandwidth_hz if covered is None else covered.min_hz,
        bandwidth_max_hz=bandwidth_hz if covered is None else covered.max_hz,
    )
