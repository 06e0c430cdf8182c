"""Switches that bounce: when an edge is crossed, and what the drive sees of the contact, computed apart."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from servobench.design.mechanism import Coupling, Mechanism, Switches
from servobench.drivers.timebase import NS_PER_S, Instant
from servobench.virtual_bus.drive.firmware import Firmware, FirmwareParameters
from tests.draws import few_of
from tests.motors import LING

RATE_HZ = 16_000
POSITIVE = 1
FREE = replace(LING, viscous_friction_nm_s=0.0, coulomb_friction_nm=0.0)


def shaft(switches: Switches, speed_rad_s: float, acceleration_rad_s2: float, coupled: bool) -> Firmware:
    """A free one under a constant torque; a coupling in whose spring the torque is already."""
    half = 0.5 * FREE.inertia_kg_m2
    coupling = Coupling(half, half, 60.0, 0.0) if coupled else None
    firmware = Firmware(
        replace(FREE, mechanism=Mechanism(coupling, switches=switches)),
        FirmwareParameters(brake_torque_nm=0.0),
    )
    firmware.start(Instant(0))
    inner = firmware.inner
    inner.speed_rad_s = inner.load_speed_rad_s = speed_rad_s
    inner.load_nm = -acceleration_rad_s2 * FREE.inertia_kg_m2
    if coupled:
        inner.twist_rad = -half * acceleration_rad_s2 / 60.0
    assert switches.positive_turns is not None
    inner.set_switch(POSITIVE, switches.positive_turns, math.inf)
    return firmware


def to_tick(firmware: Firmware, tick: int) -> float:
    firmware.advance_to(Instant(math.ceil(tick * NS_PER_S / RATE_HZ)))
    assert firmware.inner.ticks == tick
    return tick / RATE_HZ


@pytest.mark.parametrize("coupled", [False, True])
@pytest.mark.parametrize("seed", few_of(range(8), 3))
def test_an_edge_is_crossed_to_the_ns(seed: int, coupled: bool) -> None:
    """The root of the parabola. Read off by the filter: the longest that still lets the change through."""
    draw = np.random.default_rng([43, seed])
    speed, acceleration = float(draw.uniform(5.0, 300.0)), float(draw.uniform(-400.0, 400.0))
    at_s = float(draw.uniform(0.002, 0.01))
    twist = -0.5 * FREE.inertia_kg_m2 * acceleration / 60.0 if coupled else 0.0
    turns = (speed * at_s + 0.5 * acceleration * at_s**2 - twist) / math.tau
    firmware = shaft(Switches(positive_turns=turns, filter_s=1e-9), speed, acceleration, coupled)
    now_s = to_tick(firmware, math.floor(at_s * RATE_HZ) + 1)
    low, high = 0.0, 2.0 / RATE_HZ
    while high - low > 1e-12:
        firmware.inner.switch_filter_s = middle = 0.5 * (low + high)
        low, high = (middle, high) if firmware.inner.switch_seen(POSITIVE) else (low, middle)
    print(f"{abs(now_s - low - at_s) * 1e9:.4f} ns")
    assert now_s - low == pytest.approx(at_s, abs=1e-9)


def scattered(counter: int) -> int:
    """splitmix64's finaliser, as its author has it."""
    mask = (1 << 64) - 1
    x = counter * 0x9E3779B97F4A7C15 & mask
    x = (x ^ x >> 30) * 0xBF58476D1CE4E5B9 & mask
    x = (x ^ x >> 27) * 0x94D049BB133111EB & mask
    return x ^ x >> 31


def seen_changes(crossed_s: float, crossing: int, switches: Switches, seed: int) -> list[tuple[float, bool]]:
    """When the drive sees the positive switch change, after its first crossing: the contact's changes, and
    of them those that last, pair by pair."""
    parts = 2 * switches.bounces if switches.bounce_s else 0
    changes = [(crossed_s, True)]
    for number in range(1, parts + 1):
        share = (scattered(seed + (3 * crossing + POSITIVE) * 16 + number) >> 32) / 2**32
        changes.append((crossed_s + (number - 1 + share) / parts * switches.bounce_s, number % 2 == 0))
    changes.append((math.inf, False))
    lasting = [
        (at + switches.filter_s, level)
        for (at, level), (until, _) in pairwise(changes)
        if until - at >= switches.filter_s
    ]
    seen = [(0.0, False)]
    seen += [change for change in lasting if change[1] is not seen[-1][1] or len(seen) == 1]
    return seen


@pytest.mark.parametrize("seed", few_of(range(12), 4))
def test_what_is_seen_of_a_contact_that_bounces(seed: int) -> None:
    """At each tick of a passage, for drawn bounces with and without a filter."""
    draw = np.random.default_rng([44, seed])
    speed, bounces = float(draw.uniform(20.0, 200.0)), int(draw.integers(1, 9))
    switches = Switches(
        positive_turns=speed * 0.0031 / math.tau,
        bounce_s=float(draw.uniform(0.5e-3, 5e-3)),
        bounces=bounces,
        filter_s=float(draw.choice([0.0, 0.2e-3, 1e-3, 6e-3])),
    )
    firmware = shaft(switches, speed, 0.0, coupled=False)
    firmware.inner.switch_seed = number = int(draw.integers(1 << 60))
    expected = seen_changes(0.0031, 1, switches, number)
    flips = 0
    before = False
    for tick in range(1, 320):
        now_s = to_tick(firmware, tick)
        seen = firmware.inner.switch_seen(POSITIVE)
        assert seen is [level for at, level in expected if at <= now_s][-1], tick
        flips += seen is not before
        before = seen
    assert before
    assert flips == 1 or switches.filter_s < switches.bounce_s


def test_seeds_bounce_apart() -> None:
    switches = Switches(positive_turns=0.1, bounce_s=0.004)

    def course(seed: int) -> list[bool]:
        firmware = shaft(switches, 100.0, 0.0, coupled=False)
        firmware.inner.switch_seed = seed
        seen = []
        for tick in range(1, 240):
            to_tick(firmware, tick)
            seen.append(firmware.inner.switch_seen(POSITIVE))
        return seen

    assert course(1) == course(1)
    assert course(1) != course(2)
