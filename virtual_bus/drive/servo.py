"""The simulated servo drive: a CiA 402 device with firmware and motor inside.

CanopenDevice (CiA 301)  --  ServoApplication  --  PowerStateMachine   (when may torque flow)
                                    |           --  OperationMode, SimulatedAxis (which motion)
                                    +---------- --  Firmware            (inner loops, motor)
"""

from collections.abc import Callable
from functools import partial
from typing import Final

from servobench.design.motor import PmsmParameters
from servobench.drivers.canopen.error_codes import ErrorRegister
from servobench.drivers.canopen.nmt_states import NmtState
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import (
    AbortConnectionOption,
    DriveCommand,
    DriveEvent,
    Mode,
    State,
    Status,
)
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.drivers.timebase import NS_PER_MS, Duration, Instant
from servobench.virtual_bus.core.native import CyclicDrive
from servobench.virtual_bus.device.canopen_device import CanopenDevice
from servobench.virtual_bus.device.object_dictionary import ObjectDictionary
from servobench.virtual_bus.device.parameter_storage import ParameterStore
from servobench.virtual_bus.device.station import Application, CommunicationLoss, DeviceServices
from servobench.virtual_bus.drive import actual_values
from servobench.virtual_bus.drive.actual_values import INTERNAL_LIMIT_ACTIVE, ActualValues, SimulatedLoad
from servobench.virtual_bus.drive.axis import REST_S, SimulatedAxis
from servobench.virtual_bus.drive.commutation import told_commutation
from servobench.virtual_bus.drive.deaf_mode import DeafMode, set_points
from servobench.virtual_bus.drive.failures import COMMUNICATION_ERROR, LOSS_CODES, Failures
from servobench.virtual_bus.drive.firmware import Firmware, InnerControl
from servobench.virtual_bus.drive.holding_brake import HoldingBrake
from servobench.virtual_bus.drive.lacks import take_away
from servobench.virtual_bus.drive.loop_gains import told_gains
from servobench.virtual_bus.drive.machine import SimulatedMachine
from servobench.virtual_bus.drive.motion_objects import MotionObjects
from servobench.virtual_bus.drive.operation_mode import OperationMode
from servobench.virtual_bus.drive.operation_modes import MODES, modes_for
from servobench.virtual_bus.drive.power_stage import TRIP_CODES, Trip
from servobench.virtual_bus.drive.power_state import BASE_STATUS, MotorAction, PowerStateMachine
from servobench.virtual_bus.drive.servo_objects import ServoObjects
from servobench.virtual_bus.drive.servo_parameters import (
    SENSOR_NOISE,
    SWITCH_BOUNCES,
    DriveParameters,
    device_options,
    seed_of,
)
from servobench.virtual_bus.drive.user_units import UserUnits

_WAKE_WHILE_STOPPING_NS: Final = NS_PER_MS
"""The period of profiles and position loop (drive.firmware); rest is seen within it."""
_WAKE_NS: Final = 20 * NS_PER_MS
"""Without frames the motor is still carried along, so that none finds a long way to go."""


class ServoApplication(Application):
    """The drive behind the device engine."""

    def __init__(self, motor: PmsmParameters, drive: DriveParameters) -> None:
        self.motor = motor
        self.drive = drive
        self.firmware = Firmware(motor, drive)
        self._powered, self._motion = False, MotorAction.OFF
        self._revision, self._controlword = -1, 0
        self.look: Callable[[], None] = lambda: None
        """Called where the cyclic values are told, if something is watched."""
        self._deafen: Callable[[OperationMode], DeafMode] | None = None
        """Makes a mode one that follows no set-points, while that is so."""
        self._task: OperationMode | None = None
        """The mode, if it is followed and runs once per motion period."""

    def attach(self, services: DeviceServices) -> None:
        self._services = services
        dictionary, inner = services.dictionary, self.firmware.inner
        machine = self.firmware.machine
        self.objects = objects = ServoObjects(dictionary, self.motor, self.drive, modes_for(machine))
        motion = MotionObjects(dictionary, self.motor, self.drive)
        self.power = PowerStateMachine(objects.option, self.drive.brake_waits, self._slow)
        self.brake = HoldingBrake(dictionary, inner, self.drive)
        self._failures = Failures(services, objects.error_code, inner)
        counts = self.drive.encoder_counts_per_revolution
        makers = self.drive.makers_units
        self.units = UserUnits(dictionary, counts, lambda: self._motion is MotorAction.OFF, makers)
        self._take_commutation = told_commutation(dictionary, inner, machine, self.units.check_state)
        self.machine = SimulatedMachine(dictionary, counts, inner, self.motor.mechanism, self.units)
        self.axis = SimulatedAxis(self.firmware, objects, motion, self.units, self.machine, self.fail)
        self._take_gains = told_gains(dictionary, self.axis, self.drive.gain_objects)
        self._modes: dict[int, OperationMode] = {int(mode): make(self.axis) for mode, make in MODES.items()}
        self._mode = self._modes[objects.mode.default]
        self._actual = ActualValues(self.firmware, objects, self.units)
        self._cycle = self.cycle = cycle = CyclicDrive(
            inner, objects.statusword, self._run_mode, self._stop_on, self._tell_protection
        )
        cycle.protects = self.drive.protection is not None
        cycle.wake_ns = Duration(_WAKE_WHILE_STOPPING_NS if cycle.protects else _WAKE_NS)
        objects.controlword.on_write = self._on_controlword
        motion.data_record.on_write = lambda _value: self._mode.take_data_record()
        objects.mode.on_write = self._on_mode
        for variable in (objects.target_torque, objects.torque_offset):
            variable.on_write = lambda _value: self._mode.take_torque()
        for variable in (motion.target_velocity, motion.velocity_offset):
            variable.on_write = lambda _value: self._mode.take_velocity()
        for variable in (motion.target_position, motion.position_offset):
            variable.on_write = lambda _value: self._mode.take_position()
        for variable in (*objects.torque_limits, objects.max_current, objects.max_motor_speed):
            variable.on_write = lambda _value: self._take_limits()
        for variable in (objects.rated_torque, objects.rated_current):
            variable.check, variable.on_write = self.units.check_state, lambda _value: self._take_rating()
        self.load = SimulatedLoad(self.firmware, objects, self.drive.load, cycle)
        for variable in (motion.position_min, motion.position_max, motion.home_offset):
            variable.on_write = lambda _value: self._take_guards()
        self.units.changed = self._actual.take_units
        self.machine.changed = self._on_inputs
        actual_values.provide_slow_values(self.axis)
        needed = *objects.torque_limits, objects.max_current, motion.following_window, motion.vl_most
        self._own_defaults = [(variable, variable.default) for variable in needed]
        take_away(dictionary, self.drive.lacks)

    def on_reset(self, now: Instant) -> None:
        """Power-on, or reset of the node: the power stage goes off; shaft, encoder and load stay."""
        if not self._powered:
            self._powered = True
            self.firmware.start(now)
            for variable, default in self._own_defaults:
                if not variable.default:  # left open by a vendor's dictionary; with 0 the drive cannot move
                    variable.default = default
                    variable.restore(self._services.node_id)
        self._cycle.wake_at = Instant(now + self._cycle.wake_ns)
        self._failures.forget()
        self.brake.restart()
        self.hear_again()
        self.power.restart()
        mode = self.objects.mode.value
        if mode in self._modes:
            self._mode = self._modes[mode]
            self.objects.mode_display.value = mode
        self.axis.take_guards()
        self._take_commutation()
        self._take_gains()
        self._controlword = 0
        self.units.origin = 0.0
        self.units.take()
        self._take_rating()
        self._react()

    def advance(self, now: Instant) -> None:
        self._cycle.advance(now)

    def _slow(self) -> bool:
        return self.brake.catches(self._mode.stop_rad_s2(MotorAction.QUICK_STOP_RAMP))

    def _stop_on(self) -> None:
        """The shaft is being brought to rest, and has turned on."""
        power, brake = self.power, self.brake
        rests = self.firmware.rested_for_s() >= REST_S
        if rests and (power.stays or (brake.opens() if power.enabling else brake.closes())):
            power.rested()
            self._act()

    def _run_mode(self, now: Instant) -> bool:
        """Motion period by motion period, as long as the mode is followed; whether it is so at ``now``."""
        inner, axis = self.firmware.inner, self.axis
        ticks = inner.ticks
        while (task := self._task) is not None and inner.advance_to_motion_tick(now):
            axis.limited = False
            task.run()
            self._show_mode()
        if self._task is None:
            return False
        self._cycle.wake_at = Instant(now + _WAKE_WHILE_STOPPING_NS)
        if inner.ticks != ticks:
            self._cycle.refresh()
        return True

    def _show_mode(self) -> None:
        """Let the statusword follow the mode."""
        if self._motion is MotorAction.FOLLOW:
            status = BASE_STATUS[self.power.state] | self._mode.status_bits()
            self._cycle.base_status = status | INTERNAL_LIMIT_ACTIVE if self.axis.limited else status

    def _react(self) -> None:
        """Follow the state machine, with the cyclic values as of the last inner tick."""
        self._act()
        self._cycle.refresh()

    def _tell_protection(self) -> None:
        """A warning, and a trip, which has opened the power stage by itself."""
        self.look()
        if self.firmware.inner.warning:
            self.objects.statusword.value |= Status.WARNING
        if (trip := self._failures.new_trip()) is not Trip.NONE:
            self.fail(*TRIP_CODES[trip])
            if trip.opens:
                self.power.cut_torque()
                self._react()

    def _act(self) -> None:
        """Let the inner loops and the statusword follow the state machine."""
        power = self.power
        if power.revision == self._revision:
            return
        self._revision = power.revision
        self._cycle.stopping = power.stopping
        if power.motion is not self._motion:
            self._motion = power.motion
            self._move(power.motion)
        status = BASE_STATUS[power.state]
        self._choose_task()
        if power.motion is MotorAction.FOLLOW:
            status |= self._mode.status_bits()
        elif self._failures.following and self._mode.has_following_error:
            status |= Status.MODE_13
        if power.torque_off:
            status &= ~Status.VOLTAGE_ENABLED
        if power.at_rest:
            status |= Status.TARGET_REACHED
        self._cycle.base_status = status
        if power.stopping or self._task is not None:
            self._cycle.wake_at = Instant(self._services.now + _WAKE_WHILE_STOPPING_NS)

    def _choose_task(self) -> None:
        mode = self._mode
        follows = self._motion is MotorAction.FOLLOW and (mode.periodic or self.axis.guarded)
        self._task = mode if follows else None
        self._cycle.tasked = follows

    def _move(self, motion: MotorAction) -> None:
        self.brake.decide()
        if motion is MotorAction.OFF:
            self.firmware.control(InnerControl.OFF)
        elif motion is MotorAction.FOLLOW:
            self._mode.begin(self._controlword)
        else:
            self.axis.demand = None
            self.firmware.ramp_to_speed(0.0, self._mode.stop_rad_s2(motion))

    def _on_controlword(self, controlword: int) -> None:
        last, self._controlword = self._controlword, controlword
        self.power.receive(controlword)
        if self.power.revision != self._revision:
            if self.power.state is State.SWITCH_ON_DISABLED:
                self._failures.clear()
            self._react()
        elif controlword != last and self._task is not None:
            self._task.receive(controlword)
            self._show_mode()
            self._cycle.refresh()

    def _on_mode(self, mode: int) -> None:
        """0 is "no change" (CiA 402-2, object 6060h)."""
        if mode not in (Mode.NONE, self.objects.mode_display.value):
            self.take_mode(mode)

    def take_mode(self, mode: int) -> None:
        """The drive is in that mode from now on, whatever 6060h says."""
        own = self._modes[mode]
        self._mode = own if self._deafen is None else self._deafen(own)
        self.objects.mode_display.value = mode
        if self._motion is MotorAction.FOLLOW:
            self._mode.begin(self._controlword)
            self._show_other_mode()

    def tick_after(self, now: Instant) -> Instant:
        return self.firmware.tick_after(now)

    def on_sync(self, _counter: int, now: Instant) -> None:
        self.load.on_sync(now)

    def _take_limits(self) -> None:
        objects, motor = self.objects, self.motor
        up_nm, down_nm = objects.torque_limits_nm(self.firmware.torque_max_nm)
        current_a = min(objects.max_current.value * objects.current_unit_a, motor.current_max_a)
        self.firmware.limit(up_nm, current_a, objects.max_motor_speed.value * RAD_S_PER_RPM, down_nm)

    def _take_rating(self) -> None:
        self.axis.take_rating()
        self._actual.take_units()
        self._take_limits()

    def _take_guards(self) -> None:
        """A mode that acts on its set-points alone runs by periods while the axis has an end."""
        guarded = self.axis.guarded
        self.axis.take_guards()
        if guarded != self.axis.guarded and self._motion is MotorAction.FOLLOW and not self._mode.periodic:
            self._mode.begin(self._controlword)
            self._choose_task()
            self._show_mode()

    def _on_inputs(self) -> None:
        """Safe torque off acts at once; the switches are read when a mode asks for them."""
        self._take_guards()
        power = self.power
        if self.machine.sto != power.torque_off:
            power.torque_off = self.machine.sto
            if power.torque_off:
                power.cut_torque()
            power.revision += 1
            self._react()

    def fail(self, code: int, register: ErrorRegister) -> None:
        """A fault of the drive: EMCY, 603Fh, and arrow 13 with the reaction of 605Eh.

        A further fault while one is there adds its EMCY and leaves 603Fh and the state as they are.
        """
        self._failures.add(code, register)
        self._signal_fault(code)

    def report_again(self, code: int, register: ErrorRegister) -> None:
        """An EMCY, and 603Fh, of something that leaves the drive enabled; nothing while it is not."""
        if self.power.state is State.OPERATION_ENABLED:
            self._failures.repeat(code, register)
            self._failures.show(code)

    def leave_mode(self, mode: int) -> None:
        """Back to the mode of 6060h, unless the drive has left ``mode`` since."""
        if self.objects.mode_display.value == mode:
            self._on_mode(self.objects.mode.value)

    def turn_deaf(self, zero: bool, hides_bit_12: bool) -> None:
        """Set-points are not followed: the last ones go on to act, or where ``zero`` none."""
        self.hear_again()
        self._deafen = partial(DeafMode, set_points(self._services.dictionary, zero), hides_bit_12)
        self._mode = deaf = self._deafen(self._mode)
        if self._motion is MotorAction.FOLLOW:
            deaf.freeze(self._controlword)
        self._show_other_mode()

    def hear_again(self) -> None:
        """Set-points are followed, those that have come meanwhile at once."""
        self._deafen = None
        deaf = self._mode
        if isinstance(deaf, DeafMode):
            self._mode = deaf.inner
            if self._motion is MotorAction.FOLLOW:
                deaf.thaw(self._controlword)
            self._show_other_mode()

    def _show_other_mode(self) -> None:
        self._choose_task()
        self._show_mode()
        self._cycle.refresh()

    def _signal_fault(self, code: int) -> None:
        if self.power.state in (State.FAULT, State.FAULT_REACTION):
            return
        self._failures.show(code)
        self.power.signal(DriveEvent.FAULT_DETECTED)
        self._react()

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
        self._react()


class SimulatedServo(CanopenDevice):
    """A servo drive on the bus, without I/O; :mod:`servobench.virtual_bus.hosting.devices` puts it on one."""

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
        ``vendor``: as in :class:`servobench.virtual_bus.device.canopen_device.CanopenDevice`.
        Error: ValueError for a lack that cannot be."""
        drive = drive or DriveParameters()
        self.drive = ServoApplication(motor, drive)
        inner = self.drive.firmware.inner
        inner.sensor_seed = seed_of(node_id, seed, SENSOR_NOISE)
        inner.switch_seed = seed_of(node_id, seed, SWITCH_BOUNCES)
        super().__init__(node_id, self.drive, device_options(node_id, drive, seed), store, vendor)
