"""``[timing]`` and ``[set_point]`` of the file of a simulated drive: when it acts, and by which way."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from servobench.drivers.timebase import NS_PER_US
from servobench.hil.configuration.config_files import Section
from servobench.virtual_bus.device.device_options import TaskOptions
from servobench.virtual_bus.drive.set_point_path import Interpolation, Notch, SetPointPath

TaskPeriod = Annotated[float, Field(ge=10.0, le=20_000.0)]
TaskPhase = Annotated[float, Field(ge=0.0, le=20_000.0)]


class TimingTable(Section):
    """``[timing]``: tasks of the firmware that take PDOs in and send them, counted from power-on."""

    rpdo_task_us: TaskPeriod | None = None
    """A command is taken in at the next tick of so long a period; absent: when its frame ends."""
    rpdo_phase_us: TaskPhase = 0.0
    """The first tick, after power-on."""
    dead_time_us: float = Field(default=0.0, ge=0.0, le=10_000.0)
    """From that tick until the command acts."""
    tpdo_task_us: TaskPeriod | None = None
    """A SYNC is acted on, and a TPDO sampled and sent, at the next tick of this one; absent: at once."""
    tpdo_phase_us: TaskPhase = 0.0
    locked_to_sync: bool = False
    """Ticks count from the last SYNC that was acted on, once there was one."""

    @model_validator(mode="after")
    def _check_phases(self) -> Self:
        for task in ("rpdo", "tpdo"):
            phase_us, period_us = getattr(self, f"{task}_phase_us"), getattr(self, f"{task}_task_us")
            if phase_us and (period_us is None or phase_us >= period_us):
                raise ValueError(f"{task}_phase_us below {task}_task_us")
        return self

    @property
    def parameters(self) -> TaskOptions:
        """The tasks of the simulated drive."""
        return TaskOptions(
            rpdo_ns=round((self.rpdo_task_us or 0.0) * NS_PER_US),
            rpdo_phase_ns=round(self.rpdo_phase_us * NS_PER_US),
            dead_ns=round(self.dead_time_us * NS_PER_US),
            tpdo_ns=round((self.tpdo_task_us or 0.0) * NS_PER_US),
            tpdo_phase_ns=round(self.tpdo_phase_us * NS_PER_US),
            locked=self.locked_to_sync,
        )


class NotchTable(Section):
    """``[set_point.notch]``: in the torque demand, against a resonance of the machine."""

    frequency_hz: float = Field(ge=1.0, le=5_000.0, description="its middle, Hz")
    depth: float = Field(default=0.1, ge=0.0, le=1.0, description="share of the torque left there")
    width: float = Field(default=0.7, ge=0.01, le=4.0, description="of its middle, to 3 dB on both sides")

    @property
    def notch(self) -> Notch:
        return Notch(self.frequency_hz, self.depth, self.width)


class SetPointTable(Section):
    """``[set_point]``: the way of set-points into the drive's loops."""

    interpolation: Literal["linear", "cubic", "none"] = "linear"
    """How a position is reached within 60C2h: in a straight line, without corners, or at once."""
    filter_hz: float | None = Field(default=None, ge=0.1, le=10_000.0)
    """Corner of a first-order filter of positions and speeds in csp, ip and csv; absent: none."""
    torque_filter_hz: float | None = Field(default=None, ge=1.0, le=20_000.0)
    """Corner of a first-order filter of the torque demand, in every mode; absent: none."""
    notch: NotchTable | None = Field(default=None, description="the table [set_point.notch]")
    torque_slope: bool = False
    """Torques of cst are reached by the slope 6087h, as it is when the drive is enabled, and not at once."""
    holds_stale: bool = False
    """csp begins where the shaft is, and a 607Ah from before is not followed."""

    @property
    def parameters(self) -> SetPointPath:
        """The path of the simulated drive."""
        notch = None if self.notch is None else self.notch.notch
        kind = Interpolation(self.interpolation)
        slope, holds = self.torque_slope, self.holds_stale
        return SetPointPath(kind, self.filter_hz, self.torque_filter_hz, notch, slope, holds)

    @property
    def torque_parts(self) -> list[str]:
        """Filters that the torque demand passes, in words."""
        parts = [] if self.torque_filter_hz is None else [f"filter of {self.torque_filter_hz:g} Hz"]
        parts += [] if self.notch is None else [f"notch at {self.notch.frequency_hz:g} Hz"]
        return parts + (["slope by 6087h"] if self.torque_slope else [])
