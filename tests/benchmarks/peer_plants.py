"""The plant step of motulator and of gym-electric-motor, for bench_plant.py; has an environment of its own.

Reads {"motor": {...}, "period_s", "voltage_v", "steps", "batch"} as JSON from its argument, prints a JSON
object by peer: {"version", "us": [a figure for each batch, us a step], "speed_rad_s", "hold"}.
"""

import json
import sys
import timeit
from collections.abc import Callable
from importlib.metadata import version
from typing import Any


def main() -> None:
    """Measure what is installed."""
    task = json.loads(sys.argv[1])
    found = {}
    for title, peer in (
        ("motulator (RK45)", motulator),
        ("gym-electric-motor (dopri5)", gym_dopri5),
        ("gym-electric-motor (Euler)", gym_euler),
    ):
        try:
            found[title] = peer(task)
        except ImportError as error:
            print(f"{title}: {error}", file=sys.stderr)
    print(json.dumps(found))


def measured(task: dict[str, Any], steps: Callable[[int], None]) -> list[float]:
    """us a step, of each batch of a run of ``steps``."""
    batch = task["batch"]
    return [
        timeit.timeit(lambda: steps(batch), number=1) / batch * 1e6 for _ in range(task["steps"] // batch)
    ]


def motulator(task: dict[str, Any]) -> dict[str, Any]:
    """A whole sampling period of its simulation: converter, machine and mechanics by solve_ivp."""
    import numpy as np
    from motulator.common.utils import complex2abc
    from motulator.drive import model
    from motulator.drive.utils import SynchronousMachinePars

    motor, period_s = task["motor"], task["period_s"]
    pole_pairs, dc_v = motor["pole_pairs"], motor["dc_bus_voltage_v"]
    machine = model.SynchronousMachine(
        SynchronousMachinePars(
            n_p=pole_pairs,
            R_s=motor["resistance_ohm"],
            L_d=motor["inductance_d_h"],
            L_q=motor["inductance_q_h"],
            psi_f=motor["flux_linkage_wb"],
        )
    )
    mechanics = model.StiffMechanicalSystem(J=motor["inertia_kg_m2"], B_L=motor["viscous_friction_nm_s"])
    drive = model.Drive(model.VoltageSourceConverter(u_dc=dc_v), machine, mechanics)
    drive.delay = lambda duty: duty

    class Held:
        """A voltage on the q axis, held in the stator's frame over the period."""

        def __call__(self, _model: Any) -> tuple[float, Any]:
            voltage = 1j * task["voltage_v"] * np.exp(1j * pole_pairs * mechanics.meas_position())
            return period_s, complex2abc(voltage / dc_v) + 0.5

    simulation = model.Simulation(drive, Held())
    done = 0

    def steps(count: int) -> None:
        nonlocal done
        done += count
        simulation._simulation_loop((done - 0.5) * period_s - period_s, np.inf)

    us = measured(task, steps)
    speed = float(np.real(mechanics.state.w_M))
    return {"version": version("motulator"), "us": us, "speed_rad_s": speed, "hold": "stator"}


def gym_dopri5(task: dict[str, Any]) -> dict[str, Any]:
    """Its physical system without the environment around it, by the solver that is its default."""
    from gym_electric_motor.physical_systems.solvers import ScipyOdeSolver

    return _gym(task, ScipyOdeSolver())


def gym_euler(task: dict[str, Any]) -> dict[str, Any]:
    """The same by one explicit Euler step."""
    from gym_electric_motor.physical_systems.solvers import EulerSolver

    return _gym(task, EulerSolver())


def _gym(task: dict[str, Any], solver: Any) -> dict[str, Any]:
    import numpy as np
    from gym_electric_motor.physical_systems.converters import ContB6BridgeConverter
    from gym_electric_motor.physical_systems.electric_motors import PermanentMagnetSynchronousMotor
    from gym_electric_motor.physical_systems.mechanical_loads import PolynomialStaticLoad
    from gym_electric_motor.physical_systems.physical_systems import SynchronousMotorSystem
    from gym_electric_motor.physical_systems.voltage_supplies import IdealVoltageSupply

    motor, period_s, dc_v = task["motor"], task["period_s"], task["motor"]["dc_bus_voltage_v"]
    load_inertia = 1e-3 * motor["inertia_kg_m2"]  # it divides by the load's own
    limits = {"omega": 1e4, "i": 1e3, "u": dc_v, "torque": 1e3}
    system = SynchronousMotorSystem(
        control_space="dq",
        converter=ContB6BridgeConverter(tau=period_s),
        motor=PermanentMagnetSynchronousMotor(
            motor_parameter={
                "p": motor["pole_pairs"],
                "l_d": motor["inductance_d_h"],
                "l_q": motor["inductance_q_h"],
                "j_rotor": motor["inertia_kg_m2"] - load_inertia,
                "r_s": motor["resistance_ohm"],
                "psi_p": motor["flux_linkage_wb"],
            },
            limit_values=limits,
            nominal_values=limits,
        ),
        load=PolynomialStaticLoad(
            {"a": 0.0, "b": motor["viscous_friction_nm_s"], "c": 0.0, "j_load": load_inertia}
        ),
        supply=IdealVoltageSupply(dc_v),
        ode_solver=solver,
        tau=period_s,
    )
    system.reset()
    action = np.array([0.0, 2.0 * task["voltage_v"] / dc_v])

    def steps(count: int) -> None:
        for _ in range(count):
            system.simulate(action)

    us = measured(task, steps)
    speed = float(system._ode_solver.y[0])
    return {"version": version("gym-electric-motor"), "us": us, "speed_rad_s": speed, "hold": "rotor"}


if __name__ == "__main__":
    main()
