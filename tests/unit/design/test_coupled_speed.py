"""A speed feedback that knows its coupling, beside the response of two masses and a rebuilt loop."""

import math
import tomllib
from dataclasses import replace
from decimal import Decimal
from itertools import product

import numpy as np
import pytest

from servobench import Bench
from servobench.design.delay.certificate import certified_gain_auto
from servobench.design.delay.delay_loop import Array, Feedback, speed_model
from servobench.design.delay.delay_norm import hinf_norm
from servobench.design.mechanism import Coupling, Friction, Mechanism, Side, speed_responses
from servobench.design.motor import PmsmParameters
from servobench.design.speed.coupled_design import couplings_off, least_gain_over
from servobench.design.verify.loops import state_feedback
from servobench.hil.execution.coupling_premise import flexible
from servobench.hil.studies.speed.controller_text import controller_of, controller_text
from servobench.hil.studies.speed.synthesis import DesignRequest, Way, design_speed
from tests.draws import few_of
from tests.motors import LING
from tests.scenario.processes import EXAMPLES

HZ, DELAY_S = 800.0, 0.002


def motor_with(ratio: float, antiresonance_hz: float, encoder: Side, friction: Side) -> PmsmParameters:
    load_kg_m2 = LING.inertia_kg_m2 * ratio / (1.0 + ratio)
    stiffness = load_kg_m2 * (math.tau * antiresonance_hz) ** 2
    shaft = Coupling(LING.inertia_kg_m2 - load_kg_m2, load_kg_m2, stiffness, 0.02, 0.0, encoder)
    return replace(LING, mechanism=Mechanism(shaft, Friction(0.1, 1.0, 0.0, friction)))


def response(motor: PmsmParameters, K: Array, omega: Array) -> Array:
    """|e/d| of the closed loop, of the two masses' own responses; without viscous friction."""
    assert motor.mechanism is not None
    shaft = motor.mechanism.coupling
    assert shaft is not None
    on_motor, on_load = speed_responses(shaft, omega / math.tau)
    s = 1j * omega
    told = on_load if shaft.encoder is Side.LOAD else on_motor
    # the load torque moves the encoder's side; by reciprocity the motor as the motor's torque the load
    spring = shaft.stiffness_nm_rad + shaft.damping_nm_s * s
    below = (shaft.motor_kg_m2 * s**2 + spring) * (shaft.load_kg_m2 * s**2 + spring) - spring**2
    by_load = s * (shaft.motor_kg_m2 * s**2 + spring) / below if shaft.encoder is Side.LOAD else on_load
    a, Kt = math.tau * HZ, motor.torque_constant_nm_a
    fed = K[1] + (K[2] / s if len(K) > 2 else 0.0)
    made = Kt * a / (s + a * (1.0 - K[0] * np.exp(-s * DELAY_S)))
    loop = made * told * fed * np.exp(-s * DELAY_S)
    return np.asarray(np.abs(by_load / (1.0 - loop)))


SHAFTS = [
    (1.0, 150.0, Side.MOTOR),
    (4.0, 60.0, Side.LOAD),
    (1.0, 150.0, Side.LOAD),
    (4.0, 60.0, Side.MOTOR),
]


@pytest.mark.parametrize(("ratio", "antiresonance_hz", "encoder"), few_of(SHAFTS, 2))
def test_the_norm_of_a_design_is_that_of_two_masses_and_holds_a_tenth_off(
    ratio: float, antiresonance_hz: float, encoder: Side
) -> None:
    """The design for a rigid shaft is no better over them."""
    motor = replace(motor_with(ratio, antiresonance_hz, encoder, Side.MOTOR), viscous_friction_nm_s=0.0)
    motors = (motor, *couplings_off(motor).values())
    models = [speed_model(each, True, HZ) for each in motors]
    design = least_gain_over(models, DELAY_S, Feedback.SPEED)
    K = design.K[:3]
    omega = np.geomspace(1.0, 1e4, 100_000)
    assert design.gain == pytest.approx(float(response(motor, K, omega).max()), rel=1e-4)
    for other, model in zip(motors[1:], models[1:], strict=True):
        norm = hinf_norm(model.loop(K, DELAY_S))
        assert norm == pytest.approx(float(response(other, K, omega).max()), rel=1e-4)
        assert norm < 1.5 * design.gain
    rigid = least_gain_over([speed_model(replace(motor, mechanism=None), True, HZ)], DELAY_S, Feedback.SPEED)
    worst = max(hinf_norm(model.loop(K, DELAY_S)) for model in models)
    assert max(hinf_norm(model.loop(rigid.K, DELAY_S)) for model in models) > 0.999 * worst
    proved = certified_gain_auto(models[0], models[0].loop(K, DELAY_S))
    assert design.gain <= proved.gain < 1.05 * design.gain


SIDES = [*product(Side, Side, [False, True])]


@pytest.mark.parametrize(
    ("encoder", "friction", "integral"), few_of(SIDES[1::3] + SIDES[::3] + SIDES[2::3], 2)
)
def test_a_file_names_the_coupling_and_is_rebuilt_of_it(
    encoder: Side, friction: Side, integral: bool
) -> None:
    motor = motor_with(2.0, 80.0, encoder, friction)
    way = Way("exact", Feedback.SPEED, integral, None, for_sampled=False)
    request = DesignRequest(motor, None, DELAY_S, None, way, 0.6, 157.0, HZ)
    result = design_speed(request)
    table = tomllib.loads(controller_text(controller_of(result)), parse_float=Decimal)["controller"]
    assert len(table["gain"]) == 2 + integral
    sampled = {"period_us": 1000, "delay_max_us": 900, "losses_in_a_row_max": 0, "strategy": "arrival"}
    table["made_for"] |= sampled
    rebuilt, model = state_feedback(table), speed_model(motor, integral, HZ)
    n = len(model.A)
    F, E, C = (
        np.array([[float(entry.mid()) for entry in row] for row in each.tolist()])
        for each in (rebuilt.F, rebuilt.E, rebuilt.C)
    )
    assert F[:n, :n] == pytest.approx(model.A, rel=1e-12)
    for found, expected in ((F[:n, n], model.B1), (E[:n, 0], model.B2), (C[:n, 0], model.C)):
        assert found == pytest.approx(expected, rel=1e-12)


def test_a_certificate_for_a_coupling_is_left_by_another_one_by_name() -> None:
    motor = motor_with(1.0, 80.0, Side.MOTOR, Side.MOTOR)
    way = Way("exact", Feedback.SPEED, True, None, for_sampled=False)
    result = design_speed(DesignRequest(motor, None, DELAY_S, None, way, 0.6, 157.0, HZ))
    controller = controller_of(result).model_dump(mode="json", exclude_none=True)
    known = {"inertia_ratio": 1.0, "antiresonance_hz": 80.0, "damping_ratio": 0.02}
    for coupling, left in (
        (known, []),
        (known | {"antiresonance_hz": 70.0}, ["stiffness_nm_rad", "damping_nm_s"]),
        (known | {"backlash_rad": 0.001}, ["backlash_rad"]),
        (known | {"encoder": "load"}, ["encoder"]),
        (None, ["a rigid shaft"]),
    ):
        changes = {"drive.axis1.controller": controller}
        if coupling is not None:
            changes["drive.axis1.motor.coupling"] = coupling
        drive = Bench.load(EXAMPLES / "ling2012.toml").changed(changes).config.drive["axis1"]
        told = list(flexible("axis1", drive, simulated=True))
        assert len(told) == len(left)
        assert all(word in text for word, text in zip(left, told, strict=True)), told
