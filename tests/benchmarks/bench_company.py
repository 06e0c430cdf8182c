"""Commissioning of drawn drives with all effects of docs/realism.md at once: what is told beside the truth.

    python -m tests.benchmarks.bench_company [--seeds 1-12]

Inertia and friction are compared by the torque that the drive tells: hot magnets and current sensors that
are off make it another than the shaft's, and commissioning says what its figures rest on. A step that was not
done is shown with its reason. Some 15 s of processor a drive.
"""

import argparse
import math
import tempfile
from pathlib import Path
from random import Random
from typing import Any

from servobench.design.motor import PmsmParameters
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.hil.commissioning.findings import StepVerdict
from servobench.hil.configuration.drive_model import DriveModel
from servobench.hil.configuration.motor_file import MotorFile
from servobench.virtual_bus.drive.power_stage import current_per_rms
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from servobench.virtual_bus.drive.unknown_drive import unknown_drive
from tests.commissioning import unknown_world

Tables = dict[str, Any]


def machine_tables(motor: PmsmParameters, random: Random) -> Tables:
    """Draw the tables of a motor file beside its ideal motor."""
    coulomb, peak = motor.coulomb_friction_nm, motor.current_max_a
    ratio = math.exp(random.uniform(math.log(0.3), math.log(5.0)))
    resonance_hz = math.exp(random.uniform(math.log(35.0), math.log(260.0)))
    coupling = {
        "inertia_ratio": ratio,
        "antiresonance_hz": resonance_hz / math.sqrt(1.0 + ratio),
        "damping_ratio": random.uniform(0.01, 0.05),
        "backlash_rad": random.choice([0.0, 0.0, 10.0 ** random.uniform(-4.0, -2.5)]),
    }
    backward = coulomb * random.uniform(0.7, 1.3)
    friction: Tables = {
        "breakaway_nm": max(coulomb * random.uniform(1.0, 2.5), backward),
        "backward_nm": backward,
        "stribeck_rpm": random.uniform(3.0, 30.0),
        "side": random.choice(["motor", "load"]),
    }
    if random.random() < 0.3:
        friction["bristle_nm_rad"] = friction["breakaway_nm"] / 10.0 ** random.uniform(-3.0, -2.0)
    cogging_nm = motor.rated_torque_nm * random.uniform(0.002, 0.015)
    return {
        "coupling": coupling,
        "friction": friction,
        "cogging": [{"per_turn": 6 * motor.pole_pairs, "torque_nm": cogging_nm}],
        "saturation": {"linear_to_a": 0.45 * peak, "torque_percent": random.uniform(92.0, 98.0)},
        "temperature": {
            "winding_c": random.uniform(20.0, 100.0),
            "magnet_c": random.uniform(20.0, 80.0),
            "bearing_c": random.uniform(5.0, 40.0),
        },
    }


def drive_tables(motor: PmsmParameters, random: Random) -> Tables:
    """Draw the tables of a drive's file."""
    volts, rms = motor.dc_bus_voltage_v, 1.0 / current_per_rms(motor)
    overload = {
        "continuous_a_rms": 1.05 * rms * motor.rated_current_a,
        "peak_a_rms": rms * motor.current_max_a,
        "peak_time_s": random.uniform(0.5, 10.0),
    }
    errors = ("sine_offset_percent", "cosine_offset_percent", "sine_gain_percent", "quadrature_deg")
    task = random.choice([100.0, 250.0, 400.0])
    sensors = ("gain_error_a_percent", "gain_error_b_percent", "offset_a_percent", "offset_b_percent")
    return {
        "supply": {
            "voltage_v": volts * random.uniform(0.97, 1.0),
            "chopper": {"resistance_ohm": 0.15 * volts, "on_v": 1.25 * volts, "off_v": 1.2 * volts},
        },
        "protection": {"over_voltage_v": 1.4 * volts, "under_voltage_v": 0.6 * volts, "overload": overload},
        "brake": {
            "torque_nm": 2.0 * motor.rated_torque_nm,
            "open_ms": random.uniform(20.0, 100.0),
            "close_ms": random.uniform(50.0, 150.0),
            "drive_waits": random.random() < 0.8,
        },
        "current_sensor": {
            "range_a": 1.4 * motor.current_max_a,
            "bits": 12,
            "noise_percent_rms": random.uniform(0.0, 0.15),
            **{name: random.uniform(-1.0, 1.0) * (2.0 if "gain" in name else 0.3) for name in sensors},
        },
        "encoder": {
            "eccentricity_deg": random.uniform(0.0, 0.08),
            "delay_us": random.uniform(0.0, 20.0),
            "speed": {"method": random.choice(["edges", "difference", "observer"])},
            **{name: random.uniform(-0.5, 0.5) for name in errors},
        },
        "timing": {"rpdo_task_us": task, "tpdo_task_us": task, "locked_to_sync": random.random() < 0.7},
        "set_point": {"torque_filter_hz": random.uniform(800.0, 3000.0)},
        "inverter": {"dead_time_us": random.uniform(0.0, 2.0), "compensated_percent": 80.0},
    }


def commissioned(seed: int) -> list[str]:
    """Commission the drive of a seed; return what is told of it."""
    random = Random(seed)
    motor = unknown_drive(seed)[1].motor
    tables, drive = machine_tables(motor, random), drive_tables(motor, random)
    windings = ("name", "resistance_ohm", "inductance_d_h", "inductance_q_h", "flux_linkage_wb", "pole_pairs")
    shaft = ("inertia_kg_m2", "viscous_friction_nm_s", "coulomb_friction_nm")
    rating = {
        "torque_nm": motor.rated_torque_nm,
        "speed_rpm": motor.rated_speed_rad_s / RAD_S_PER_RPM,
        "current_max_a": motor.current_max_a,
        "dc_bus_voltage_v": motor.dc_bus_voltage_v,
    }
    winding = {name: getattr(motor, name) for name in windings} | {"transform": "amplitude_invariant"}
    mechanics = {name: getattr(motor, name) for name in shaft}
    machine = MotorFile.model_validate(
        {"motor": winding, "mechanics": mechanics, "rating": rating, **tables}
    ).parameters
    parameters = DriveParameters(**DriveModel.model_validate(drive).parameters, machine=machine)
    with tempfile.TemporaryDirectory() as folder:
        _truth, result, _spy = unknown_world(seed, Path(folder), drive=parameters)
    told = [f"{seed:3}"]
    assert machine.heat is not None
    assert machine.mechanism is not None
    assert machine.mechanism.coupling is not None
    sensors = drive["current_sensor"]
    gain = 1.0 + 0.005 * (sensors["gain_error_a_percent"] + sensors["gain_error_b_percent"])
    share = gain / machine.heat.flux_factor
    found = result.findings.mechanics
    if found is not None:
        friction = 0.5 * (motor.coulomb_friction_nm + tables["friction"]["backward_nm"])
        for name, value, error, true in (
            ("inertia", found.inertia_kg_m2, found.inertia_error, motor.inertia_kg_m2),
            ("Coulomb", found.coulomb_friction_nm, found.coulomb_error, friction),
        ):
            off = 100.0 * (value / (share * true) - 1.0)
            told.append(f"{name} {off:+.2f} +-{100.0 * error / true:.2f} %")
    true_hz, play = machine.mechanism.coupling.resonance_hz, machine.mechanism.coupling.backlash_rad
    found_hz = {record.name: record.outcome for record in result.records}["response"].figures.get(
        "resonance_hz"
    )
    off_hz = "not told" if found_hz is None else f"{100.0 * (found_hz / true_hz - 1.0):+.2f} %"
    told.append(f"resonance {true_hz:.1f} Hz {off_hz}, play {1e3 * play:.2g} mrad")
    told += [f"{record.name}: {fault}" for record in result.records for fault in record.outcome.faults]
    told += [
        f"{record.name} {record.verdict.value}: {record.reason}"
        for record in result.records
        if record.verdict is not StepVerdict.DONE
    ]
    return told


def main() -> None:
    """Print a paragraph for each drive."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seeds", default="1-12", help="first-last")
    first, _, last = parser.parse_args().seeds.partition("-")
    for seed in range(int(first), int(last or first) + 1):
        print("\n     ".join(commissioned(seed)), flush=True)


if __name__ == "__main__":
    main()
