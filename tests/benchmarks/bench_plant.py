"""The plant's step beside motulator's and gym-electric-motor's: same motor, same step, same voltage, one run.

The peers live in an environment of their own (``make bench`` makes it from requirements-bench.lock); what is
not installed is left out. The speeds at the end tell that all computed the same thing: a voltage that is held
in the stator's frame over a period lags the rotor by half a period, one held in the rotor's frame does not.
"""

import json
import os
import subprocess
import timeit
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from servobench.design.motor import PmsmParameters
from servobench.hil.configuration.motor_file import load_motor
from tests.plant import Plant

ROOT = Path(__file__).parents[2]
PEERS = Path(os.environ.get("SERVOBENCH_PEERS", ROOT / ".venv-bench" / "bin" / "python"))
PERIOD_S = 1.0 / 16_000
VOLTAGE_V = 20.0
STEPS, BATCH = 3_000, 100
PEERS_LIMIT_S = 300


def main() -> None:
    """Print a table."""
    motor = load_motor(ROOT / "examples" / "motors" / "azaiz2007.toml").parameters
    results = {"servobench, a call a step": by_call(motor, stator_fixed=True)}
    results["servobench, rotor's frame"] = by_call(motor, stator_fixed=False)
    results["servobench, within the firmware"] = in_one_call(motor)
    results |= peers(motor)
    base = float(np.percentile(results["servobench, a call a step"]["us"], 50))
    print(f"{'plant step of 62.5 us, us':34} {'p50':>8} {'p99':>8} {'max':>8} {'x':>7}   speed after {STEPS}")
    for title, found in results.items():
        p50, p99 = np.percentile(found["us"], [50, 99])
        held = f"{found['speed_rad_s']:.4f} rad/s, {found['hold']}-fixed"
        print(f"{title:34} {p50:8.2f} {p99:8.2f} {max(found['us']):8.2f} {p50 / base:7.2f}   {held}")


def by_call(motor: PmsmParameters, *, stator_fixed: bool) -> dict[str, Any]:
    """A call from Python for each step, as the peers are used."""
    plant = Plant(motor)

    def steps(count: int) -> None:
        for _ in range(count):
            plant.advance(0.0, VOLTAGE_V, stator_fixed=stator_fixed)

    return result(steps, lambda: plant.speed_rad_s, "stator" if stator_fixed else "rotor")


def in_one_call(motor: PmsmParameters) -> dict[str, Any]:
    """Many steps in a call: what a step costs the simulated drive, whose firmware is in the core too."""
    plant = Plant(motor)

    def steps(count: int) -> None:
        plant.advance(0.0, VOLTAGE_V, periods=count)

    return result(steps, lambda: plant.speed_rad_s, "stator")


def result(steps: Callable[[int], None], speed: Callable[[], float], hold: str) -> dict[str, Any]:
    """As a peer prints it."""
    us = [timeit.timeit(lambda: steps(BATCH), number=1) / BATCH * 1e6 for _ in range(STEPS // BATCH)]
    return {"us": us, "speed_rad_s": speed(), "hold": hold}


def peers(motor: PmsmParameters) -> dict[str, dict[str, Any]]:
    """What the peers measured in their environment; {} if there is none."""
    if not PEERS.exists():
        print("motulator and gym-electric-motor are not installed here: no comparison")
        return {}
    task = {
        "motor": asdict(motor) | {"transform": motor.transform.value},
        "period_s": PERIOD_S,
        "voltage_v": VOLTAGE_V,
        "steps": STEPS,
        "batch": BATCH,
    }
    command = [str(PEERS), str(Path(__file__).with_name("peer_plants.py")), json.dumps(task)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=PEERS_LIMIT_S, check=False)
    except subprocess.TimeoutExpired:
        print(f"the peers took more than {PEERS_LIMIT_S} s: no comparison")
        return {}
    if done.returncode:
        print(f"the peers cannot be measured: {done.stderr.strip().splitlines()[-1]}")
        return {}
    found: dict[str, dict[str, Any]] = json.loads(done.stdout)
    return {f"{title} {one['version']}": one for title, one in found.items()}


if __name__ == "__main__":
    main()
