"""A drive drawn by its seed, the bench that records it, and the motor file that somebody has of it."""

import math
import random
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

COUNTS: Final = (4096, 10_000, 65_536, 131_072, 1_048_576)
RATES_HZ: Final = (8_000, 10_000, 16_000, 20_000)


@dataclass(frozen=True, slots=True)
class Hidden:
    """What is fitted, how it is recorded, and what nobody but the test knows."""

    motor: dict[str, Any]
    """Tables of the motor on the shaft."""
    start: dict[str, Any]
    """Tables of the motor file at hand: inertia off by up to two, and no friction at all."""
    bench: dict[str, Any]
    speed_rpm: Callable[[float], float]
    held_out_rpm: Callable[[float], float]

    @property
    def truth(self) -> dict[str, float]:
        """By key; friction that differs by the way and a weight are told as their mean and their offset."""
        mechanics, friction = self.motor["mechanics"], self.motor["friction"]
        like = self.bench["drive"]["axis1"]["simulation"]["like"]
        forward, backward = mechanics["coulomb_friction_nm"], friction["backward_nm"]
        return {
            "mechanics.inertia_kg_m2": mechanics["inertia_kg_m2"],
            "mechanics.viscous_friction_nm_s": mechanics["viscous_friction_nm_s"],
            "mechanics.coulomb_friction_nm": 0.5 * (forward + backward),
            "load.hanging_nm": self.motor["load"]["hanging_nm"] + 0.5 * (forward - backward),
            "twin.speed_filter_hz": like["encoder"]["speed"]["filter_hz"],
        }


def hidden_drive(seed: int, duration_s: float = 10.0) -> Hidden:
    """Draw everything from ``seed``."""
    draw = random.Random(f"hidden drive {seed}")

    def geometric(low: float, high: float) -> float:
        return low * math.exp(math.log(high / low) * draw.random())

    torque, speed_rpm = round(geometric(0.3, 10.0), 3), 100.0 * draw.randint(15, 45)
    speed = speed_rpm * math.pi / 30.0
    inertia = torque * geometric(0.03, 0.3) / speed
    forward, backward = (geometric(0.01, 0.08) * torque for _ in range(2))
    pole_pairs, bus_v = draw.randint(2, 8), draw.choice((48.0, 160.0, 320.0, 560.0))
    volts = bus_v / math.sqrt(3.0)
    flux = draw.uniform(0.45, 0.65) * volts / (pole_pairs * speed)
    current = torque / (1.5 * pole_pairs * flux)
    resistance = draw.uniform(0.03, 0.08) * volts / current
    inductance = resistance * draw.uniform(0.002, 0.008)
    motor: dict[str, Any] = {
        "motor": {
            "name": f"hidden {seed}",
            "resistance_ohm": resistance,
            "inductance_d_h": inductance,
            "inductance_q_h": inductance * draw.uniform(1.0, 1.4),
            "flux_linkage_wb": flux,
            "pole_pairs": pole_pairs,
            "transform": "amplitude_invariant",
        },
        "mechanics": {
            "inertia_kg_m2": inertia,
            "viscous_friction_nm_s": geometric(0.01, 0.08) * torque / speed,
            "coulomb_friction_nm": forward,
        },
        "rating": {
            "torque_nm": torque,
            "speed_rpm": speed_rpm,
            "current_max_a": draw.uniform(2.5, 3.5) * current,
            "dc_bus_voltage_v": bus_v,
        },
        "friction": {"backward_nm": backward},
        "load": {"hanging_nm": draw.uniform(-0.05, 0.05) * torque},
    }
    start = {
        "motor": motor["motor"],
        "mechanics": {"inertia_kg_m2": inertia * geometric(0.5, 2.0)},
        "rating": motor["rating"],
    }
    gain = inertia * draw.uniform(40.0, 120.0)
    lag_us, wait_us = draw.choice((1, 1, 100, 300)), draw.choice((1, 1, 100, 200))
    faults = {
        "loss": [
            {"direction": way, "probability": draw.choice((0.0, 0.003, 0.02))}
            for way in ("host_to_drive", "drive_to_host")
        ],
        "delay": [
            {"direction": way, "frames": ["pdo"], "delay_min_us": 0, "delay_max_us": most_us}
            for way, most_us in (("drive_to_host", lag_us), ("host_to_drive", wait_us))
        ],
    }
    bench = {"faults": faults, **_bench(seed, draw, motor, start, gain, duration_s)}
    share, slow_hz, quick_hz = draw.uniform(0.4, 0.6), draw.uniform(0.3, 0.6), draw.uniform(2.0, 4.0)
    return Hidden(
        motor,
        start,
        bench,
        _sines(speed_rpm, (share, slow_hz), (0.15, quick_hz)),
        _sines(speed_rpm, (0.8 * share, 1.3 * slow_hz), (0.2, 0.7 * quick_hz)),
    )


def _bench(
    seed: int,
    draw: random.Random,
    motor: dict[str, Any],
    start: dict[str, Any],
    gain: float,
    duration_s: float,
) -> dict[str, Any]:
    torque, speed_rpm = motor["rating"]["torque_nm"], motor["rating"]["speed_rpm"]
    counts, rate_hz = draw.choice(COUNTS), draw.choice(RATES_HZ)
    filter_hz = round(150.0 * math.exp(math.log(1000.0 / 150.0) * draw.random()), 1)
    return {
        "bench": {"name": "hidden", "duration_s": duration_s, "seed": seed},
        "drive": {
            "axis1": {
                "node": 1,
                "motor": start,
                "simulation": {
                    "motor": motor,
                    "believes": start,
                    "encoder_counts_per_revolution": counts,
                    "inner_rate_hz": rate_hz,
                    "like": {"encoder": {"speed": {"filter_hz": filter_hz}}},
                },
                "limits": {"speed_max_rpm": 1.5 * speed_rpm, "torque_max_nm": 2.0 * torque},
                "controller": {
                    "kind": "pid",
                    "proportional_nm_s_rad": gain,
                    "integral_nm_rad": 10.0 * gain,
                },
            }
        },
    }


def _sines(rpm: float, *parts: tuple[float, float]) -> Callable[[float], float]:
    def speed(time_s: float) -> float:
        return rpm * sum(share * math.sin(math.tau * hz * time_s) for share, hz in parts)

    return speed
