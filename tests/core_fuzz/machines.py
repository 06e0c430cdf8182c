"""Drawn machines for the core: any coupling, friction, cogging, load and switches, and what senses them."""

import random

from servobench.design.mechanism import (
    Arm,
    CoggingHarmonic,
    Coupling,
    EndStops,
    Friction,
    LoadMap,
    Mechanism,
    PlacedLoad,
    Side,
    Switches,
)
from servobench.design.motor import PmsmParameters
from servobench.virtual_bus.drive.encoder import Encoder, SineErrors
from servobench.virtual_bus.drive.power_stage import CurrentSensors
from servobench.virtual_bus.drive.set_point_path import Notch, SetPointPath


def drawn_encoder(draw: random.Random, rate_hz: int) -> Encoder:
    sines = SineErrors(*(draw.uniform(-0.2, 0.2) for _ in range(4)))
    lines, eccentricity_rad = draw.choice([1, 1000, 1 << 20]), draw.choice([0.0, 0.2])
    delay_s = draw.random() / rate_hz
    return Encoder(lines, draw.choice([None, sines]), eccentricity_rad, draw.uniform(-7.0, 7.0), delay_s)


def drawn_sensors(draw: random.Random) -> CurrentSensors:
    range_a = 10.0 ** draw.uniform(-3.0, 3.0)
    gains, offset_a = (draw.uniform(-0.2, 0.2), draw.uniform(-0.2, 0.2)), range_a * draw.uniform(-0.2, 0.2)
    noise_a = draw.choice([0.0, 0.1 * range_a])
    return CurrentSensors(range_a, draw.choice([None, 4, 24]), *gains, offset_a, 0.0, noise_a)


def drawn_mechanism(draw: random.Random, motor: PmsmParameters) -> Mechanism:
    load_kg_m2 = motor.inertia_kg_m2 * draw.uniform(0.01, 0.99)
    coupling = Coupling(
        motor.inertia_kg_m2 - load_kg_m2,
        load_kg_m2,
        load_kg_m2 * draw.uniform(1.0, 3e3) ** 2,
        draw.choice([0.0, 0.02, 1.0]),
        draw.choice([0.0, 1e-5, 0.01]),
        draw.choice(list(Side)),
    )
    side, share = draw.choice(list(Side)), draw.choice([0.0, 0.3, 1.0])
    friction = Friction(draw.uniform(0.05, 1.0), draw.uniform(0.01, 50.0), 0.1, side, share)
    cogging = (CoggingHarmonic(draw.randrange(1, 100), draw.uniform(0.0, 1.0)),)
    return Mechanism(
        draw.choice([None, coupling]),
        draw.choice([None, friction]),
        draw.choice([(), cogging]),
        draw.choice([None, _placed(draw, motor)]),
        draw.choice([None, _switches(draw)]),
    )


def _placed(draw: random.Random, motor: PmsmParameters) -> PlacedLoad:
    places, speeds = (
        tuple(sorted({draw.uniform(-9.0, 9.0) for _ in range(draw.choice([1, 2, 9]))})) for _ in "ps"
    )
    torques = tuple(tuple(draw.uniform(-1.0, 1.0) for _ in speeds) for _ in places)
    table = LoadMap(places, speeds, torques, len(places) > 1 and draw.random() < 0.5)
    low, high = draw.choice([None, draw.uniform(-9.0, 0.0)]), draw.choice([None, draw.uniform(1e-6, 9.0)])
    stops = EndStops(
        low, high, motor.inertia_kg_m2 * draw.uniform(1.0, 3e3) ** 2, draw.choice([0.0, 0.1, 1.0])
    )
    return PlacedLoad(
        draw.choice([0.0, 0.3]),
        draw.choice(
            [None, Arm(draw.uniform(0.1, 1.0), 10.0 ** draw.uniform(-3.0, 3.0), draw.uniform(-7.0, 7.0))]
        ),
        draw.choice([None, table]),
        draw.choice([None, stops]),
    )


def _switches(draw: random.Random) -> Switches:
    home_from = draw.uniform(-9.0, 9.0)
    return Switches(
        draw.uniform(-9.0, 9.0),
        draw.uniform(-9.0, 9.0),
        (home_from, home_from + draw.uniform(0.0, 9.0)),
        draw.choice([0.0, 0.01]),
        draw.randrange(1, 9),
        draw.choice([0.0, 0.002, 0.1]),
    )


def drawn_path(draw: random.Random, rate_hz: int) -> SetPointPath:
    notch = Notch(rate_hz * draw.uniform(1e-4, 0.39), draw.random(), draw.uniform(0.01, 4.0))
    return SetPointPath(
        torque_filter_hz=draw.choice([None, 10.0 ** draw.uniform(0.0, 4.0)]), notch=draw.choice([None, notch])
    )
