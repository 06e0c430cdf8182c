"""The CiA 402 state machine by itself: every command in every state, option codes, ways to rest."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import (
    CONTROLWORDS,
    TRANSITION_OF,
    Control,
    DriveCommand,
    DriveEvent,
    State,
    command_path,
)
from servobench.virtual_bus.drive.power_state import MotorAction, PowerStateMachine
from tests.draws import examples_of

STANDARD_OPTIONS = {
    Object.QUICK_STOP_OPTION: 2,
    Object.SHUTDOWN_OPTION: 0,
    Object.DISABLE_OPERATION_OPTION: 1,
    Object.FAULT_REACTION_OPTION: 2,
}


def machine_in(state: State, options: dict[Object, int] | None = None) -> PowerStateMachine:
    """A machine brought to ``state`` by the shortest way."""
    options = STANDARD_OPTIONS | (options or {})
    machine = PowerStateMachine(lambda index: options[index])
    if state in (State.FAULT, State.FAULT_REACTION):
        walk(machine, State.OPERATION_ENABLED)
        machine.signal(DriveEvent.FAULT_DETECTED)
        if state is State.FAULT:
            machine.rested()
    else:
        walk(machine, state)
    assert machine.state is state
    return machine


def walk(machine: PowerStateMachine, target: State) -> None:
    path = command_path(machine.state, target)
    assert path is not None
    for command in path:
        machine.receive(CONTROLWORDS[command])


REACHABLE = [state for state in State if state is not State.NOT_READY]


@pytest.mark.parametrize("state", REACHABLE)
@pytest.mark.parametrize("command", list(DriveCommand))
def test_every_command_in_every_state_follows_the_table_or_changes_nothing(
    state: State, command: DriveCommand
) -> None:
    machine = machine_in(state, {Object.DISABLE_OPERATION_OPTION: 0, Object.QUICK_STOP_OPTION: 6})
    motion = machine.motion
    machine.receive(CONTROLWORDS[command])
    arrow = TRANSITION_OF.get((state, command))
    if state is State.READY and command is DriveCommand.ENABLE_OPERATION:
        assert machine.state is State.OPERATION_ENABLED
    elif arrow is None and command is DriveCommand.DISABLE_OPERATION and state is State.READY:
        assert machine.state is State.SWITCHED_ON  # the same controlword as switch on
    elif arrow is None and command is DriveCommand.SWITCH_ON and state is State.OPERATION_ENABLED:
        assert machine.state is State.SWITCHED_ON  # the same controlword as disable operation
    elif arrow is None:
        assert (machine.state, machine.motion) == (state, motion)
    else:
        assert machine.state is arrow.target


def test_power_on_leads_to_switch_on_disabled_without_torque() -> None:
    machine = PowerStateMachine(lambda index: STANDARD_OPTIONS[index])
    assert machine.state is State.SWITCH_ON_DISABLED
    assert machine.motion is MotorAction.OFF


def test_torque_flows_in_operation_enabled_and_nowhere_before() -> None:
    for state in (State.SWITCH_ON_DISABLED, State.READY, State.SWITCHED_ON):
        assert machine_in(state).motion is MotorAction.OFF
    assert machine_in(State.OPERATION_ENABLED).motion is MotorAction.FOLLOW


@pytest.mark.parametrize(
    ("code", "motion"),
    [
        (1, MotorAction.SLOW_DOWN_RAMP),
        (2, MotorAction.QUICK_STOP_RAMP),
        (3, MotorAction.CURRENT_LIMIT),
        (4, MotorAction.CURRENT_LIMIT),
    ],
)
def test_quick_stop_rests_then_switches_on_disabled(code: int, motion: MotorAction) -> None:
    machine = machine_in(State.OPERATION_ENABLED, {Object.QUICK_STOP_OPTION: code})
    machine.receive(CONTROLWORDS[DriveCommand.QUICK_STOP])
    assert (machine.state, machine.motion, machine.stopping) == (State.QUICK_STOP, motion, True)
    machine.receive(CONTROLWORDS[DriveCommand.ENABLE_OPERATION])
    assert machine.state is State.QUICK_STOP, "arrow 16 is closed for 605Ah = 1..4"
    machine.rested()
    assert (machine.state, machine.motion) == (State.SWITCH_ON_DISABLED, MotorAction.OFF)


@pytest.mark.parametrize("code", [5, 6, 7, 8])
def test_quick_stop_that_stays_holds_the_shaft_and_can_resume(code: int) -> None:
    machine = machine_in(State.OPERATION_ENABLED, {Object.QUICK_STOP_OPTION: code})
    machine.receive(CONTROLWORDS[DriveCommand.QUICK_STOP])
    machine.rested()
    assert machine.state is State.QUICK_STOP
    assert machine.at_rest
    assert not machine.stopping
    assert machine.motion is not MotorAction.OFF
    machine.receive(CONTROLWORDS[DriveCommand.ENABLE_OPERATION])
    assert (machine.state, machine.motion) == (State.OPERATION_ENABLED, MotorAction.FOLLOW)


def test_quick_stop_option_0_switches_off_at_once() -> None:
    machine = machine_in(State.OPERATION_ENABLED, {Object.QUICK_STOP_OPTION: 0})
    machine.receive(CONTROLWORDS[DriveCommand.QUICK_STOP])
    assert (machine.state, machine.motion) == (State.SWITCH_ON_DISABLED, MotorAction.OFF)


@pytest.mark.parametrize(
    ("command", "option", "target"),
    [
        (DriveCommand.DISABLE_OPERATION, Object.DISABLE_OPERATION_OPTION, State.SWITCHED_ON),
        (DriveCommand.SHUTDOWN, Object.SHUTDOWN_OPTION, State.READY),
    ],
)
def test_disabling_by_ramp_waits_for_rest(command: DriveCommand, option: Object, target: State) -> None:
    machine = machine_in(State.OPERATION_ENABLED, {option: 1})
    for _ in range(3):  # a cyclic master repeats the word
        machine.receive(CONTROLWORDS[command])
        assert (machine.state, machine.motion) == (State.OPERATION_ENABLED, MotorAction.SLOW_DOWN_RAMP)
    machine.rested()
    assert (machine.state, machine.motion) == (target, MotorAction.OFF)


def test_enable_operation_calls_a_waiting_stop_off() -> None:
    machine = machine_in(State.OPERATION_ENABLED)
    machine.receive(CONTROLWORDS[DriveCommand.DISABLE_OPERATION])
    assert machine.stopping
    machine.receive(CONTROLWORDS[DriveCommand.ENABLE_OPERATION])
    assert (machine.state, machine.motion, machine.stopping) == (
        State.OPERATION_ENABLED,
        MotorAction.FOLLOW,
        False,
    )


def test_disable_voltage_overrides_a_stop_under_way() -> None:
    for command in (DriveCommand.DISABLE_OPERATION, DriveCommand.QUICK_STOP):
        machine = machine_in(State.OPERATION_ENABLED)
        machine.receive(CONTROLWORDS[command])
        machine.receive(CONTROLWORDS[DriveCommand.DISABLE_VOLTAGE])
        assert (machine.state, machine.motion) == (State.SWITCH_ON_DISABLED, MotorAction.OFF)


def test_fault_reaction_runs_to_rest_and_ends_in_fault() -> None:
    machine = machine_in(State.FAULT_REACTION)
    assert machine.motion is MotorAction.QUICK_STOP_RAMP
    machine.rested()
    assert (machine.state, machine.motion) == (State.FAULT, MotorAction.OFF)


def test_a_fault_without_motion_is_a_fault_at_once() -> None:
    for state in (State.SWITCH_ON_DISABLED, State.READY, State.SWITCHED_ON):
        machine = machine_in(state)
        machine.signal(DriveEvent.FAULT_DETECTED)
        assert machine.state is State.FAULT


def test_fault_reset_acts_on_the_rising_edge_only() -> None:
    machine = machine_in(State.OPERATION_ENABLED)
    machine.receive(Control.FAULT_RESET | CONTROLWORDS[DriveCommand.ENABLE_OPERATION])
    machine.signal(DriveEvent.FAULT_DETECTED)
    machine.rested()
    states = []
    for word in (Control.FAULT_RESET, 0, Control.FAULT_RESET):
        machine.receive(word)
        states.append(machine.state)
    assert states == [State.FAULT, State.FAULT, State.SWITCH_ON_DISABLED], "bit 7 was 1 before the fault"


@examples_of(300)
@given(
    words=st.lists(
        st.integers(0, 0xFFFF) | st.sampled_from([0x06, 0x07, 0x0F, 0x02, 0x80, -1, -2]), max_size=60
    ),
    quick_stop=st.integers(0, 8),
    shutdown=st.integers(0, 1),
    disable=st.integers(0, 1),
    fault=st.integers(0, 4),
)
def test_any_sequence_keeps_to_the_table(
    words: list[int], quick_stop: int, shutdown: int, disable: int, fault: int
) -> None:
    """-1: the motor comes to rest if it is being stopped; -2: a fault."""
    options = {
        Object.QUICK_STOP_OPTION: quick_stop,
        Object.SHUTDOWN_OPTION: shutdown,
        Object.DISABLE_OPERATION_OPTION: disable,
        Object.FAULT_REACTION_OPTION: fault,
    }
    machine = PowerStateMachine(lambda index: options[index])
    for word in words:
        before = machine.revision, machine.state, machine.motion, machine.at_rest
        if word == -2:
            machine.signal(DriveEvent.FAULT_DETECTED)
        elif word >= 0:
            machine.receive(word)
        elif machine.stopping:
            machine.rested()
        live = machine.state in (State.OPERATION_ENABLED, State.QUICK_STOP, State.FAULT_REACTION)
        assert live == (machine.motion is not MotorAction.OFF)
        assert not machine.at_rest or machine.state is State.QUICK_STOP
        changed = before[1:] != (machine.state, machine.motion, machine.at_rest)
        assert not changed or machine.revision != before[0]
