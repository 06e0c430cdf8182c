"""All kinds of faults. A new one is a file in :mod:`servobench.virtual_bus.faults.kinds` and its name
here."""

from typing import Final

from servobench.virtual_bus.faults.fault_table import FaultTable, LogKind
from servobench.virtual_bus.faults.kinds.blackout import Blackout
from servobench.virtual_bus.faults.kinds.burst import Burst
from servobench.virtual_bus.faults.kinds.bus_off import BusOff
from servobench.virtual_bus.faults.kinds.chopper_off import ChopperOff
from servobench.virtual_bus.faults.kinds.clock_drift import ClockDrift
from servobench.virtual_bus.faults.kinds.clock_step import ClockStep
from servobench.virtual_bus.faults.kinds.corruption import Corruption
from servobench.virtual_bus.faults.kinds.delay import Delay
from servobench.virtual_bus.faults.kinds.dirty_encoder import DirtyEncoder
from servobench.virtual_bus.faults.kinds.dragging_brake import DraggingBrake
from servobench.virtual_bus.faults.kinds.drive_fault import DriveFault
from servobench.virtual_bus.faults.kinds.duplicate import Duplicate
from servobench.virtual_bus.faults.kinds.full_queue import FullQueue
from servobench.virtual_bus.faults.kinds.host_stall import HostStall
from servobench.virtual_bus.faults.kinds.hot_motor import HotMotor
from servobench.virtual_bus.faults.kinds.ignored_commands import IgnoredCommands
from servobench.virtual_bus.faults.kinds.link_down import LinkDown
from servobench.virtual_bus.faults.kinds.loose_coupling import LooseCoupling
from servobench.virtual_bus.faults.kinds.loss import Loss
from servobench.virtual_bus.faults.kinds.lss_yes_sayer import LssYesSayer
from servobench.virtual_bus.faults.kinds.measured_delay import MeasuredDelay
from servobench.virtual_bus.faults.kinds.mode_change import ModeChange
from servobench.virtual_bus.faults.kinds.periodic_loss import PeriodicLoss
from servobench.virtual_bus.faults.kinds.receive_overflow import ReceiveOverflow
from servobench.virtual_bus.faults.kinds.refused_mapping import RefusedMapping
from servobench.virtual_bus.faults.kinds.reorder import Reorder
from servobench.virtual_bus.faults.kinds.repeated_emergency import RepeatedEmergency
from servobench.virtual_bus.faults.kinds.safe_torque_off import SafeTorqueOff
from servobench.virtual_bus.faults.kinds.signal import SignalFault
from servobench.virtual_bus.faults.kinds.silence import Silence
from servobench.virtual_bus.faults.kinds.slow_drive import SlowDrive
from servobench.virtual_bus.faults.kinds.supply_sag import SupplySag

_ALL: Final[tuple[type[FaultTable], ...]] = (
    Loss,
    Burst,
    PeriodicLoss,
    Blackout,
    Delay,
    MeasuredDelay,
    Reorder,
    Duplicate,
    Corruption,
    Silence,
    BusOff,
    DriveFault,
    ClockStep,
    ClockDrift,
    SlowDrive,
    HostStall,
    LssYesSayer,
    SafeTorqueOff,
    ModeChange,
    IgnoredCommands,
    RefusedMapping,
    RepeatedEmergency,
    SignalFault,
    FullQueue,
    LinkDown,
    ReceiveOverflow,
    SupplySag,
    ChopperOff,
    DraggingBrake,
    LooseCoupling,
    DirtyEncoder,
    HotMotor,
)
TABLES: Final = {table.kind: table for table in _ALL}
"""By the name of a plan's tables."""
LOG_KINDS: Final[tuple[LogKind, ...]] = tuple(kind for table in _ALL for kind in table.logs)
"""By the code of an entry in the log."""
TABLE_OF: Final = {kind.name: table for table in _ALL for kind in table.logs}
"""By the kind of an entry in the log: what made it."""
