"""The CiA 402 tables against the standard's own wording, and against themselves."""

import itertools

import pytest

from servobench.drivers.canopen.error_codes import error_text
from servobench.drivers.cia402.objects402 import Unit, unit_parts, unit_word
from servobench.drivers.cia402.profile import (
    COMMAND_PATTERNS,
    CONTROLWORDS,
    STATUS_PATTERNS,
    TRANSITION_OF,
    TRANSITIONS,
    DriveCommand,
    DriveEvent,
    Mode,
    State,
    command_path,
    commands_in,
    state_of,
    supported_mode_bit,
)


@pytest.mark.parametrize(
    ("statusword", "state"),
    [
        (0x0000, State.NOT_READY),
        (0x0250, State.SWITCH_ON_DISABLED),
        (0x0231, State.READY),
        (0x0233, State.SWITCHED_ON),
        (0x0237, State.OPERATION_ENABLED),
        (0x1637, State.OPERATION_ENABLED),
        (0x0217, State.QUICK_STOP),
        (0x021F, State.FAULT_REACTION),
        (0x0218, State.FAULT),
        (0x0238, State.FAULT),
    ],
)
def test_statuswords_seen_on_real_drives(statusword: int, state: State) -> None:
    assert state_of(statusword) is state


def test_no_statusword_matches_two_states() -> None:
    for word in range(0x80):
        matching = [state for state, pattern in STATUS_PATTERNS.items() if pattern.matches(word)]
        assert len(matching) <= 1
        assert state_of(word | 0xFF80) is (matching[0] if matching else None)


def test_undefined_coding_is_no_state() -> None:
    assert state_of(0x0002) is None


def test_each_controlword_codes_its_command() -> None:
    for command in COMMAND_PATTERNS:
        assert command in commands_in(CONTROLWORDS[command])


def test_commands_are_decoded_as_by_the_patterns() -> None:
    for word in range(0x200):
        expected = {command for command, pattern in COMMAND_PATTERNS.items() if pattern.matches(word)}
        assert set(commands_in(word)) == expected


def test_one_controlword_never_moves_a_state_two_ways() -> None:
    for word, state in itertools.product(range(0x100), State):
        arrows = [command for command in commands_in(word) if (state, command) in TRANSITION_OF]
        assert len(arrows) <= 1, (hex(word), state)


def test_every_cause_has_one_arrow_and_every_number_of_the_standard_occurs() -> None:
    assert len(TRANSITION_OF) == len(TRANSITIONS)
    assert {arrow.number for arrow in TRANSITIONS} == set(range(1, 17))


def test_a_fault_is_possible_wherever_none_is_yet() -> None:
    states = {arrow.source for arrow in TRANSITIONS if arrow.cause is DriveEvent.FAULT_DETECTED}
    assert states == set(State) - {State.FAULT, State.FAULT_REACTION}


def test_path_to_enabled_is_the_usual_three_commands() -> None:
    assert command_path(State.SWITCH_ON_DISABLED, State.OPERATION_ENABLED) == (
        DriveCommand.SHUTDOWN,
        DriveCommand.SWITCH_ON,
        DriveCommand.ENABLE_OPERATION,
    )


def test_paths_lead_where_they_say() -> None:
    for source, target in itertools.product(State, State):
        path = command_path(source, target)
        if path is None:
            continue
        here = source
        for command in path:
            here = TRANSITION_OF[here, command].target
        assert here is target


def test_no_path_resets_a_fault() -> None:
    assert command_path(State.FAULT, State.SWITCH_ON_DISABLED) is None
    assert command_path(State.FAULT, State.FAULT) == ()


@pytest.mark.parametrize(
    ("code", "text"),
    [
        (0x0000, "no error"),
        (0x8130, "life guard or heartbeat error"),
        (0x83FF, "torque control"),
        (0x0001, "unknown error class"),
        (0xFF01, "manufacturer-specific"),
        (0x9999, "external error"),
        (0xA000, "unknown error class"),
    ],
)
def test_error_text_falls_back_to_the_class(code: int, text: str) -> None:
    assert error_text(code) == text


def test_unit_words() -> None:
    assert unit_word(0, Unit.REVOLUTION, Unit.MINUTE) == 0x00B44700
    assert unit_word(-3, Unit.REVOLUTION, Unit.MINUTE) == 0xFDB44700
    assert unit_parts(0xFDB44700) == (-3, Unit.REVOLUTION, Unit.MINUTE)


def test_cyclic_torque_is_bit_9_of_supported_modes() -> None:
    assert supported_mode_bit(Mode.CYCLIC_SYNCHRONOUS_TORQUE) == 0x200
    assert supported_mode_bit(Mode.NONE) == 0
