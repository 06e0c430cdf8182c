"""The simulated servo drive: a CiA 402 device with firmware and motor inside.

CanopenDevice (CiA 301)  --  ServoApplication  --  PowerStateMachine   (when may torque flow)
                                    |           --  OperationMode       (which torque)
                                    +---------- --  Firmware            (inner loops, motor)
"""

import math
from collections.abc import Callable
from typing import Final, cast

from design.motor import PmsmParameters
from drivers.objects402 import Object
from drivers.profile402 import (
    STATUS_PATTERNS,
    AbortConnectionOption,
    DriveCommand,
    Event,
    State,
    Status,
)
from drivers.timebase import NS_PER_MS, Instant
from virtual_bus.canopen_device.application import (
    Application,
    CommunicationLoss,
    DeviceServices,
    ErrorRegister,
    NmtState,
)
from virtual_bus.canopen_device.object_dictionary import ObjectDictionary
from virtual_bus.canopen_device.parameter_store import ParameterStore
from virtual_bus.device import CanopenDevice
from virtual_bus.servo_drive.firmware import Firmware, InnerControl
from virtual_bus.servo_drive.motor_kernel import (
    D_CURRENT_MAX,
    D_LOAD,
    D_SPEED_MAX,
    D_TORQUE_MAX,
    S_COUNT,
    S_LIMITED,
    S_Q_MEASURED,
    S_SPEED_MEASURED,
    S_TORQUE_DEMAND,
    S_TORQUE_MEASURED,
)
from virtual_bus.servo_drive.operation_modes import MODES, OperationMode
from virtual_bus.servo_drive.power_state import Motion, PowerStateMachine
from virtual_bus.servo_drive.servo_objects import RPM, VELOCITY_UNIT_RAD_S, ServoObjects
from virtual_bus.servo_drive.servo_parameters import (
    HIGH_RESOLUTION_TIME_STAMP,
    DriveParameters,
    device_options,
)

COMMUNICATION_ERROR: Final = 0x8100
HEARTBEAT_ERROR: Final = 0x8130
LOSS_CODES: dict[CommunicationLoss, int] = {
    CommunicationLoss.HEARTBEAT: HEARTBEAT_ERROR,
    CommunicationLoss.LIFE_GUARDING: HEARTBEAT_ERROR,
    CommunicationLoss.RPDO_DEADLINE: 0x8250,
    CommunicationLoss.BUS_OFF: 0x8140,
}
"""Error code 603Fh by what was lost; the EMCY of it is the device engine's."""

REST_S: Final = 0.005
"""The shaft has come to rest when it has rested for that long at the end of a ramp."""
_WAKE_WHILE_STOPPING_NS: Final = NS_PER_MS
_WAKE_NS: Final = 20 * NS_PER_MS
"""Without frames the motor is still carried along, so that none finds a long way to go."""

_VELOCITY_RAW_PER_RAD_S: Final = 1.0 / VELOCITY_UNIT_RAD_S
_LOAD_NM: Final = 1e-3
"""Unit of 2100h."""

INTERNAL_LIMIT_ACTIVE: Final = int(Status.INTERNAL_LIMIT_ACTIVE)

_COUNT: Final = int(S_COUNT)
_SPEED: Final = int(S_SPEED_MEASURED)
_TORQUE: Final = int(S_TORQUE_MEASURED)
_LIMITED: Final = int(S_LIMITED)
_INT32_MAX: Final = 2147483647.0
_round: Final = round
"""As constants of this module: found without a look-up where it is compiled."""

_BASE_STATUS: dict[State, int] = {
    state: STATUS_PATTERNS[state].value | Status.VOLTAGE_ENABLED | Status.REMOTE for state in State
}


class ServoApplication(Application):
    """The drive behind the device engine."""

    def __init__(self, motor: PmsmParameters, drive: DriveParameters) -> None:
        self.motor = motor
        self.drive = drive
        self.firmware = Firmware(motor, drive)
        # gives plain floats, which an array does not; numpy's stubs call every buffer one of integers
        self._state = cast("memoryview[float]", self.firmware.state.data)
        self._demand = self.firmware.demand
        self.wake_at = Instant(0)
        self._powered = False
        self._motion = Motion.OFF
        self._revision = -1
        self._base_status = 0
        self._failures: set[int] = set()

    def attach(self, services: DeviceServices) -> None:
        self._services = services
        self.objects = objects = ServoObjects(services.dictionary, self.motor, self.drive, frozenset(MODES))
        self.power = PowerStateMachine(objects.option)
        self._modes: dict[int, OperationMode] = {
            int(mode): make(objects, self.firmware) for mode, make in MODES.items()
        }
        self._mode = self._modes[objects.mode.value]
        self._cyclic = objects.position, objects.velocity, objects.torque, objects.statusword
        self._torque_unit_nm = objects.rated_torque.default * 1e-6
        objects.controlword.on_write = self._on_controlword
        objects.mode.on_write = self._on_mode
        for variable in (objects.target_torque, objects.torque_offset):
            variable.on_write = self._on_set_point
        for variable in (objects.max_torque, objects.max_current, objects.max_motor_speed):
            variable.on_write = lambda _value: self._take_limits()
        objects.load_torque.on_write = self._on_load
        self._provide_slow_values()

    def _provide_slow_values(self) -> None:
        """Values that are seldom asked for are computed when they are."""
        objects, state = self.objects, self._state
        current_unit_a = self.motor.rated_current_a / 1000.0
        objects.position_internal.provider = lambda: objects.position.value
        objects.torque_demand.provider = lambda: _int16(state[S_TORQUE_DEMAND] / self._torque_unit_nm)
        objects.current.provider = lambda: _int16(state[S_Q_MEASURED] / current_unit_a)
        objects.load_torque.provider = objects.load_actual.provider = lambda: round(
            float(self._demand[D_LOAD]) / _LOAD_NM
        )

    def on_reset(self, now: Instant) -> None:
        """Power-on, or reset of the node: the power stage goes off; shaft, encoder and load stay."""
        if not self._powered:
            self._powered = True
            self.firmware.start(now)
        self.wake_at = Instant(now + _WAKE_NS)
        self._failures.clear()
        self.power.restart()
        self._mode = self._modes[self.objects.mode.value]
        self._take_limits()
        self._act()
        self._refresh()

    def advance(self, now: Instant) -> None:
        if not self.firmware.advance_to(now):
            due = self.wake_at
            if due is not None and due <= now:
                self.wake_at = Instant(now + _WAKE_WHILE_STOPPING_NS)
            return
        power = self.power
        if power.stopping:
            if self.firmware.rested_for_s() >= REST_S:
                power.rested()
                self._act()
            self.wake_at = Instant(now + _WAKE_WHILE_STOPPING_NS)
        else:
            self.wake_at = Instant(now + _WAKE_NS)
        self._refresh()

    def _refresh(self) -> None:
        """The cyclic values as of the last inner tick."""
        state = self._state
        position, velocity, torque, statusword = self._cyclic
        position.value = (int(state[_COUNT]) + 0x8000_0000 & 0xFFFF_FFFF) - 0x8000_0000
        speed = state[_SPEED] * _VELOCITY_RAW_PER_RAD_S
        velocity.value = _round(speed) if -_INT32_MAX < speed < _INT32_MAX else _int32(speed)
        torque.value = _int16(state[_TORQUE] / self._torque_unit_nm)
        status = self._base_status
        if state[_LIMITED] != 0.0:
            status |= INTERNAL_LIMIT_ACTIVE
        if status != statusword.value:
            statusword.value = status
            self._services.notify(statusword)

    def _act(self) -> None:
        """Let the inner loops and the statusword follow the state machine."""
        power = self.power
        if power.revision == self._revision:
            return
        self._revision = power.revision
        if power.motion is not self._motion:
            self._motion = power.motion
            self._move(power.motion)
        status = _BASE_STATUS[power.state]
        if power.motion is Motion.FOLLOW:
            status |= self._mode.status_bits()
        if power.at_rest:
            status |= Status.TARGET_REACHED
        self._base_status = status
        if power.stopping:
            self.wake_at = Instant(self._services.now + _WAKE_WHILE_STOPPING_NS)

    def _move(self, motion: Motion) -> None:
        if motion is Motion.OFF:
            self.firmware.control(InnerControl.OFF)
        elif motion is Motion.FOLLOW:
            self._mode.begin()
        else:
            self.firmware.ramp_to_speed(0.0, self._deceleration_rad_s2(motion))

    def _deceleration_rad_s2(self, motion: Motion) -> float:
        if motion is Motion.CURRENT_LIMIT:
            return math.inf
        index = Object.PROFILE_DECELERATION
        if motion is Motion.QUICK_STOP_RAMP:
            index = Object.QUICK_STOP_DECELERATION
        return self.objects.option(index) * RPM

    def _on_controlword(self, controlword: int) -> None:
        self.power.receive(controlword)
        if self.power.revision != self._revision:
            self._leave_fault()
            self._act()
            self._refresh()

    def _leave_fault(self) -> None:
        if self.objects.error_code.value and self.power.state is State.SWITCH_ON_DISABLED:
            self.objects.error_code.value = 0
            for code in sorted(self._failures):
                self._services.clear_error(code)
            self._failures.clear()

    def _on_mode(self, mode: int) -> None:
        self._mode = self._modes[mode]
        self.objects.mode_display.value = mode
        if self._motion is Motion.FOLLOW:
            self._mode.begin()

    def _on_set_point(self, _value: int) -> None:
        self._mode.take_set_points()

    def _on_load(self, raw: int) -> None:
        self._demand[D_LOAD] = raw * _LOAD_NM

    def _take_limits(self) -> None:
        objects, demand = self.objects, self._demand
        demand[D_TORQUE_MAX] = objects.max_torque.value * self._torque_unit_nm
        demand[D_CURRENT_MAX] = objects.max_current.value * self.motor.rated_current_a / 1000.0
        demand[D_SPEED_MAX] = objects.max_motor_speed.value * RPM

    def fail(self, code: int, register: ErrorRegister) -> None:
        """A fault of the drive: EMCY, 603Fh, and arrow 13 with the reaction of 605Eh.

        A further fault while one is there adds its EMCY and leaves 603Fh and the state as they are.
        """
        self._failures.add(code)
        self._services.raise_error(code, register)
        self._signal_fault(code)

    def hold_encoder(self, held: bool) -> None:
        """``held``: the encoder's count stands still from the next inner tick on; nothing notices it here."""
        self.firmware.hold_encoder(held)

    def _signal_fault(self, code: int) -> None:
        if self.power.state in (State.FAULT, State.FAULT_REACTION):
            return
        self.objects.error_code.value = code
        self.power.signal(Event.FAULT_DETECTED)
        self._act()
        self._refresh()

    def on_communication_loss(self, cause: CommunicationLoss, _node_id: int, _now: Instant) -> None:
        self._abort_connection(LOSS_CODES[cause])

    def on_nmt(self, state: NmtState, _now: Instant) -> None:
        """NMT stop and both resets abort the connection too, CiA 402-2, object 6007h."""
        if state in (NmtState.STOPPED, NmtState.INITIALISING) and self._powered:
            self._abort_connection(COMMUNICATION_ERROR)

    def _abort_connection(self, code: int) -> None:
        """6007h; it matters only where the power stage is or may be on."""
        if self.power.state not in (State.SWITCHED_ON, State.OPERATION_ENABLED, State.QUICK_STOP):
            return
        option = self.objects.option(Object.ABORT_CONNECTION_OPTION)
        if option == AbortConnectionOption.FAULT_SIGNAL:
            self._signal_fault(code)
        elif option == AbortConnectionOption.DISABLE_VOLTAGE:
            self.power.command(DriveCommand.DISABLE_VOLTAGE)
        elif option == AbortConnectionOption.QUICK_STOP:
            self.power.command(DriveCommand.QUICK_STOP)
        self._act()
        self._refresh()


class SimulatedServo(CanopenDevice):
    """A servo drive on the bus, without I/O; :mod:`virtual_bus.hosting` puts it on one."""

    def __init__(
        self,
        node_id: int,
        motor: PmsmParameters,
        drive: DriveParameters | None = None,
        seed: int = 0,
        store: ParameterStore | None = None,
        vendor: Callable[[ObjectDictionary], None] | None = None,
    ) -> None:
        """``seed``: of everything random in the drive, a stream for each use and node. ``store``,
        ``vendor``: as in :class:`virtual_bus.device.CanopenDevice`."""
        drive = drive or DriveParameters()
        self.drive = ServoApplication(motor, drive)
        super().__init__(node_id, self.drive, device_options(node_id, drive, seed), store, vendor)
        self._stamp_the_samples()

    def _stamp_the_samples(self) -> None:
        """1013h shows when the actual values were sampled, at most one inner period ago."""
        clock, firmware = self.clock, self.drive.firmware
        stamp = self.dictionary.variable(HIGH_RESOLUTION_TIME_STAMP)
        stamp.provider = lambda: clock.stamp_us(firmware.tick_at)

    @property
    def drive_state(self) -> State:
        """State of the CiA 402 state machine."""
        return self.drive.power.state


def _int32(value: float) -> int:
    """``value`` rounded into INTEGER32."""
    return round(min(max(value, -_INT32_MAX), _INT32_MAX))


def _int16(value: float) -> int:
    """``value`` rounded into INTEGER16."""
    return min(max(_round(value), -0x8000), 0x7FFF)
