"""Speed designs for random motors, run on the simulated drive, and the noise that their torque must have."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from servobench.design.delay.delay_loop import speed_model
from servobench.design.sampled.held_loop import HeldLoop, SampledNetwork, Strategy
from servobench.design.speed.speed_design import least_gain
from servobench.design.speed.speed_robustness import noise_gain
from servobench.hil.configuration.bench_file import bench_from
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.configuration.motor_file import LING2012
from servobench.hil.execution.bench import run_bench
from servobench.hil.recording.run_recorder import MemoryRecorder
from servobench.hil.rows.recording_plan import RecordingPlan
from servobench.hil.rows.records import Rows
from servobench.virtual_bus.drive.firmware import FirmwareParameters

PERIOD_S = 0.001
NETWORK = SampledNetwork(Strategy.ARRIVAL, PERIOD_S, 0, PERIOD_S, 0.0)
"""No loss, and a delay of up to a period."""
DURATION_S = 0.8
FINE_ENCODER = 2**24
"""Counts per revolution whose noise is nothing."""


@dataclass(frozen=True, slots=True)
class Designed:
    """A motor and the speed feedback of least gain for it, at 1 kHz."""

    motor: dict[str, Any]
    """Tables of a motor file."""
    gain: list[float]
    noise_nm: float
    """N m rms of torque that the simulated drive's own encoder makes, by the design's noise figure."""


def designed(draw: np.random.Generator) -> Designed:
    """A design for a random motor with the simulated drive's current loop."""
    tables = LING2012.model_dump(mode="json")
    tables["motor"]["resistance_ohm"] *= float(np.exp(draw.uniform(-1.0, 1.0)))
    inductance = tables["motor"]["inductance_q_h"] * float(np.exp(draw.uniform(-1.0, 0.5)))
    tables["motor"] |= {"inductance_q_h": inductance, "inductance_d_h": inductance}
    tables["mechanics"]["inertia_kg_m2"] *= float(np.exp(draw.uniform(-0.7, 1.5)))
    tables["mechanics"]["viscous_friction_nm_s"] *= float(np.exp(draw.uniform(-1.0, 1.0)))
    drive = bench_from(random_bench(tables, [0.0, 0.0]), "random motor", Path()).drive["axis1"]
    motor = drive.motor.parameters
    model = speed_model(motor, current_bandwidth_hz=drive.simulation.current_loop_hz)
    gain = least_gain(model, 2.0 * PERIOD_S).K
    held = HeldLoop(model, gain, NETWORK)
    passed_on = noise_gain(motor, model.loop(gain, 2.0 * PERIOD_S), held)
    return Designed(tables, gain.tolist(), passed_on * speed_noise_rad_s(FirmwareParameters()))


def speed_noise_rad_s(drive: FirmwareParameters) -> float:
    """Rms of what the rounding of the encoder's count adds to the speed, rad/s.

    Each count is off by an even spread of one count; their difference over a tick goes through the filter
    a (1 - z^-1)/(1 - (1 - a) z^-1), whose impulse response has the square sum 2 a^2/(2 - a).
    """
    tick_s = 1.0 / drive.inner_rate_hz
    a = tick_s / (tick_s + 1.0 / (math.tau * (drive.speed.filter_hz or math.inf)))
    rounding_rad = math.tau / drive.encoder_counts_per_revolution / math.sqrt(12.0)
    return rounding_rad / tick_s * a * math.sqrt(2.0 / (2.0 - a))


def torque_rms_nm(motor: dict[str, Any], gain: list[float], **simulation: float) -> float:
    """Of the last third of a run at half the rated speed; ``simulation``: of the bench file."""
    return steady_rms_nm(run(bench_from(random_bench(motor, gain, **simulation), "random motor", Path())))


def run(config: BenchConfig) -> Rows:
    """Every row of a run on the simulated bus, in this process."""
    recorders: list[MemoryRecorder] = []

    def in_memory(plan: RecordingPlan) -> MemoryRecorder:
        recorders.append(MemoryRecorder(plan, keep_all=True))
        return recorders[-1]

    run_bench(
        config,
        recording=in_memory,
    )
    return recorders[0].rows()


def steady_rms_nm(rows: Rows) -> float:
    """N m rms of the torque about its mean, of the last third."""
    return float(np.std(rows["torque_nm"][2 * len(rows) // 3 :]))


def random_bench(motor: dict[str, Any], gain: list[float], **simulation: float) -> dict[str, Any]:
    """A bench of a simulated drive at half the rated speed; ``motor``: tables of a motor file."""
    return {
        "bench": {"name": "random-motor", "duration_s": DURATION_S, "seed": 1},
        "loop": {"period_us": round(1e6 * PERIOD_S)},
        "drive": {
            "axis1": {
                "node": 1,
                "motor": motor,
                "simulation": simulation,
                "limits": {"speed_max_rpm": 2500.0, "torque_max_nm": 5.0},
                "controller": {"kind": "state_feedback", "gain": gain},
            }
        },
        "reference": {"axis1": [{"at_s": 0.0, "kind": "step", "speed_rpm": 750.0}]},
    }
