"""Speed designs for random motors, run on the simulated drive."""

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from design.speed_design import least_gain
from design.speed_loop import speed_model
from hil.bench import run_bench
from hil.configuration.bench_file import bench_from
from hil.configuration.config import BenchConfig
from hil.configuration.motor_file import LING2012
from hil.recording.records import Rows
from hil.recording.records_file import RECORDS_FILE, read_records
from hil.terminal.progress import no_progress

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
    config = bench_from(random_bench(tables, [0.0, 0.0]), "random motor", Path())
    motor = config.drive["axis1"].motor.parameters
    model = speed_model(motor, current_bandwidth_hz=config.drive["axis1"].simulation.current_loop_hz)
    return torque_rms_nm(tables, least_gain(model, 2.0 * PERIOD_S).K.tolist())


def torque_rms_nm(motor: dict[str, Any], gain: list[float]) -> float:
    """Of the last third of a run at half the rated speed."""
    with tempfile.TemporaryDirectory() as folder:
        rows = run(bench_from(random_bench(motor, gain), "random motor", Path()), Path(folder) / "run")
    return steady_rms_nm(rows)


def run(config: BenchConfig, record: Path) -> Rows:
    """Every row of a run on the simulated bus."""
    run_bench(config, bus_spec=None, time=None, seed=None, record=record, view=False, progress=no_progress)
    return np.concatenate(list(read_records(record / RECORDS_FILE)))


def steady_rms_nm(rows: Rows) -> float:
    """N m rms of the torque about its mean, of the last third."""
    return float(np.std(rows["torque_nm"][2 * len(rows) // 3 :]))


def random_bench(motor: dict[str, Any], gain: list[float]) -> dict[str, Any]:
    """A bench of a simulated drive at half the rated speed; ``motor``: tables of a motor file."""
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
