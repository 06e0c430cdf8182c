"""Speed designs for random motors, run on the simulated drive."""

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from design.speed_design import least_gain
from design.speed_loop import speed_model
from hil.bench import run_bench
from hil.configuration.bench_file import bench_from
from hil.configuration.motor_file import LING2012
from hil.recording.records_file import RECORDS_FILE, read_records
from hil.terminal.progress import no_progress
from hil.terminal.speed_options import CURRENT_BANDWIDTH_HZ

PERIOD_S = 0.001
DURATION_S = 0.8


def steady_torque_rms_nm(draw: np.random.Generator) -> float:
    """Design for a random motor on the simulated drive at 1 kHz; N m rms of its torque about its mean."""
    tables = LING2012.model_dump(mode="json")
    tables["motor"]["resistance_ohm"] *= float(np.exp(draw.uniform(-1.0, 1.0)))
    inductance = tables["motor"]["inductance_q_h"] * float(np.exp(draw.uniform(-1.0, 0.5)))
    tables["motor"] |= {"inductance_q_h": inductance, "inductance_d_h": inductance}
    tables["mechanics"]["inertia_kg_m2"] *= float(np.exp(draw.uniform(-0.7, 1.5)))
    tables["mechanics"]["viscous_friction_nm_s"] *= float(np.exp(draw.uniform(-1.0, 1.0)))
    config = bench_from(_bench(tables, [0.0, 0.0]), "random motor", Path())
    motor = config.drive["axis1"].motor.parameters
    model = speed_model(motor, current_bandwidth_hz=CURRENT_BANDWIDTH_HZ)
    return torque_rms_nm(tables, least_gain(model, 2.0 * PERIOD_S).K.tolist())


def torque_rms_nm(motor: dict[str, Any], gain: list[float]) -> float:
    """Of the last third of a run at half the rated speed."""
    config = bench_from(_bench(motor, gain), "random motor", Path())
    with tempfile.TemporaryDirectory() as folder:
        record = Path(folder) / "run"
        run_bench(
            config, bus_spec=None, time=None, seed=None, record=record, view=False, progress=no_progress
        )
        rows = np.concatenate(list(read_records(record / RECORDS_FILE)))
    return float(np.std(rows["torque_nm"][2 * len(rows) // 3 :]))


def _bench(motor: dict[str, Any], gain: list[float]) -> dict[str, Any]:
    return {
        "bench": {"name": "random-motor", "duration_s": DURATION_S, "seed": 1},
        "loop": {"period_us": round(1e6 * PERIOD_S)},
        "drive": {
            "axis1": {
                "node": 1,
                "motor": motor,
                "limits": {"speed_max_rpm": 2500.0, "torque_max_nm": 5.0},
                "controller": {"kind": "state_feedback", "gain": gain},
            }
        },
        "reference": {"axis1": [{"at_s": 0.0, "kind": "step", "speed_rpm": 750.0}]},
    }
