"""A model predictive speed controller: a quadratic program in every cycle, solved by OSQP.

The plant is the shaft, J d(omega)/dt = T - B omega - T_load, sampled once a period. The load torque is
observed from what the speed did beside what the sent torques should have made of it; from the newest reading
on, the speed is predicted with the torques that were sent since, up to when the new one will act. From there
the program follows the reference of the next N periods within the torque limit.
"""

import numpy as np
import osqp
from scipy import sparse

from servobench import Command, Context, Controller, Setup, TorqueSetPoint


class Mpc(Controller):
    """min sum (omega_k - omega*_k)^2 + weight (T_k - T_{k-1})^2 with |T_k| <= T_max over N periods."""

    def __init__(
        self, setup: Setup, horizon: int = 20, weight: float = 40.0, load_settles_s: float = 0.02
    ) -> None:
        """``weight``: (rad/s)^2 per (N m)^2; ``load_settles_s``: time constant of the load observer."""
        self.period_s = setup.period_s
        motor = setup.motor
        self.decay = float(np.exp(-motor.viscous_friction_nm_s / motor.inertia_kg_m2 * self.period_s))
        self.gain = (1.0 - self.decay) / motor.viscous_friction_nm_s
        """Of a torque over one period, rad/s per N m."""
        self.correction = (1.0 - np.exp(-self.period_s / load_settles_s)) / self.gain
        self.horizon = horizon
        self.torque_max_nm = setup.torque_max_nm
        self._build(weight)
        self.reset()

    def _build(self, weight: float) -> None:
        """omega = free + response T over the horizon; P and A of the program never change."""
        n = self.horizon
        powers = self.decay ** np.arange(n)
        self.response = self.gain * np.tril(powers[np.maximum(0, np.arange(n)[:, None] - np.arange(n))])
        self.free = self.decay ** np.arange(1, n + 1)
        self.loads = -self.gain * np.cumsum(powers)
        change = np.eye(n) - np.eye(n, k=-1)
        self.first = weight * change.T[:, 0]
        hessian = self.response.T @ self.response + weight * change.T @ change
        limit = np.full(n, self.torque_max_nm)
        self.program = osqp.OSQP()
        self.program.setup(
            sparse.csc_matrix(np.triu(hessian)), np.zeros(n), sparse.eye(n, format="csc"), -limit, limit,
            verbose=False, eps_abs=1e-4, eps_rel=1e-4, max_iter=200, adaptive_rho=False,
        )  # fmt: skip

    def reset(self) -> None:
        """Before the first cycle."""
        self.load_nm = 0.0
        self.speed_rad_s = 0.0
        self.sampled_at = 0
        self.sent: list[Command] = []

    def channels(self) -> tuple[str, ...]:
        """Recorded beside the bench's own columns."""
        return "load_torque_nm", "predicted_speed_rad_s", "iterations"

    def output(self, context: Context) -> TorqueSetPoint:
        """Predict, then solve."""
        self._observe(context)
        self.predicted_rad_s = self._passed(self.speed_rad_s, self.sampled_at, context.acts_at)
        reference = np.array(context.preview(self.horizon)[1:])
        last_nm = self.sent[-1].torque_nm if self.sent else 0.0
        miss = self.free * self.predicted_rad_s + self.loads * self.load_nm - reference
        self.program.update(q=self.response.T @ miss - self.first * last_nm)
        solution = self.program.solve()
        self.iterations = solution.info.iter
        return TorqueSetPoint(float(solution.x[0]))

    def update(self, context: Context, command: Command) -> None:
        """Remember what was really sent, as long as a reading may be older."""
        if context.sent is command:
            self.sent = [*self.sent[-50:], command]

    def telemetry(self) -> tuple[float, ...]:
        """In the order of the channels."""
        return self.load_nm, self.predicted_rad_s, self.iterations

    def _observe(self, context: Context) -> None:
        """Take in the readings in order of sampling; one that is older than the last says nothing new."""
        for sample in sorted(context.samples, key=lambda each: each.sampled_at):
            if sample.sampled_at <= self.sampled_at:
                continue
            if self.sampled_at:
                expected = self._passed(self.speed_rad_s, self.sampled_at, sample.sampled_at)
                self.load_nm -= self.correction * (sample.reading.velocity_rad_s - expected)
            self.speed_rad_s, self.sampled_at = sample.reading.velocity_rad_s, sample.sampled_at

    def _passed(self, speed_rad_s: float, since: int, until: int) -> float:
        """The speed at ``until`` with the torques that acted since."""
        torque_nm = 0.0
        for command in self.sent:
            if command.effective_at <= since:
                torque_nm = command.torque_nm
                continue
            if command.effective_at >= until:
                break
            speed_rad_s = self._step(speed_rad_s, torque_nm, command.effective_at - since)
            since, torque_nm = command.effective_at, command.torque_nm
        return self._step(speed_rad_s, torque_nm, until - since)

    def _step(self, speed_rad_s: float, torque_nm: float, passed_ns: int) -> float:
        part = passed_ns * 1e-9 / self.period_s
        return speed_rad_s * self.decay**part + self.gain * part * (torque_nm - self.load_nm)
