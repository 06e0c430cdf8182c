"""All kinds of faults. A new one is a file in :mod:`virtual_bus.faults.kinds` and its name here."""

from typing import Final

from virtual_bus.faults.fault_table import FaultTable
from virtual_bus.faults.kinds.blackout import Blackout
from virtual_bus.faults.kinds.burst import Burst
from virtual_bus.faults.kinds.bus_off import BusOff
from virtual_bus.faults.kinds.clock_drift import ClockDrift
from virtual_bus.faults.kinds.clock_step import ClockStep
from virtual_bus.faults.kinds.corruption import Corruption
from virtual_bus.faults.kinds.delay import Delay
from virtual_bus.faults.kinds.drive_fault import DriveFault
from virtual_bus.faults.kinds.duplicate import Duplicate
from virtual_bus.faults.kinds.full_queue import FullQueue
from virtual_bus.faults.kinds.host_stall import HostStall
from virtual_bus.faults.kinds.ignored_commands import IgnoredCommands
from virtual_bus.faults.kinds.link_down import LinkDown
from virtual_bus.faults.kinds.loss import Loss
from virtual_bus.faults.kinds.lss_yes_sayer import LssYesSayer
from virtual_bus.faults.kinds.measured_delay import MeasuredDelay
from virtual_bus.faults.kinds.mode_change import ModeChange
from virtual_bus.faults.kinds.periodic_loss import PeriodicLoss
from virtual_bus.faults.kinds.receive_overflow import ReceiveOverflow
from virtual_bus.faults.kinds.refused_mapping import RefusedMapping
from virtual_bus.faults.kinds.reorder import Reorder
from virtual_bus.faults.kinds.repeated_emergency import RepeatedEmergency
from virtual_bus.faults.kinds.safe_torque_off import SafeTorqueOff
from virtual_bus.faults.kinds.signal import SignalFault
from virtual_bus.faults.kinds.silence import Silence
from virtual_bus.faults.kinds.slow_drive import SlowDrive
from virtual_bus.faults.log_kind import LogKind

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
)
TABLES: Final = {table.kind: table for table in _ALL}
"""By the name of a plan's tables."""
LOG_KINDS: Final[tuple[LogKind, ...]] = tuple(kind for table in _ALL for kind in table.logs)
"""By the code of an entry in the log."""
TABLE_OF: Final = {kind.name: table for table in _ALL for kind in table.logs}
"""By the kind of an entry in the log: what made it."""
