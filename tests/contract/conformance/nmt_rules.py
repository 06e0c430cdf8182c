"""NMT, boot-up, error control (CiA 301, 7.2.8 and 7.3.2)."""

import pytest

from servobench.drivers.canopen.nmt_states import NmtState
from tests.contract.conformance.rig import (
    BOOT_UP,
    GUARD,
    NODE,
    RESET_COMMUNICATION,
    RESET_NODE,
    SDO_REQUEST,
    START,
    STATE_COMMANDS,
    Rig,
    initiate,
)
from tests.contract.conformance.rule import Rules

RULES = Rules()
rule = RULES.of
COMMANDS = {*STATE_COMMANDS.values(), RESET_NODE, RESET_COMMUNICATION}


@rule("CiA 301, 7.3.2.1")
def every_state_command_leads_to_its_state_from_each_state(rig: Rig) -> None:
    for state in STATE_COMMANDS:
        for target, command in STATE_COMMANDS.items():
            rig.enter(state)
            rig.nmt(command)
            assert rig.state is target


@rule("CiA 301, 7.2.8.3.3")
def both_resets_answer_with_boot_up_and_lead_to_pre_operational(rig: Rig) -> None:
    for state in STATE_COMMANDS:
        for command in (RESET_NODE, RESET_COMMUNICATION):
            rig.enter(state)
            assert rig.nmt(command) == [BOOT_UP]
            assert rig.state is NmtState.PRE_OPERATIONAL


@rule("CiA 301, 7.2.8.3.1")
def unknown_commands_leave_each_state_as_it_was(rig: Rig) -> None:
    for state in STATE_COMMANDS:
        rig.enter(state)
        for command in set(range(256)) - COMMANDS:
            rig.send(0x000, bytes([command, NODE]))
        frames, found = rig.fence()
        assert (frames, found) == ([], state)


@rule("CiA 301, 7.2.8.3.1")
def commands_to_others_or_of_wrong_length_leave_each_state_as_it_was(rig: Rig) -> None:
    for state in STATE_COMMANDS:
        rig.enter(state)
        for command in COMMANDS:
            for data in (bytes([command, NODE + 1]), bytes([command]), bytes([command, NODE, 0]), b""):
                rig.send(0x000, data)
            rig.send(0x000, bytes([command, NODE]), extended=True)
        frames, found = rig.fence()
        assert (frames, found) == ([], state)


@rule("CiA 301, 7.2.8.3.1")
def node_0_means_all(rig: Rig) -> None:
    rig.nmt(START, 0)
    assert rig.state is NmtState.OPERATIONAL


@rule("CiA 301, table 38")
def no_sdo_and_no_pdo_in_stopped(rig: Rig) -> None:
    rig.enter(NmtState.STOPPED)
    assert rig.ask(SDO_REQUEST, initiate(0x40, 0x1000, 0)) == []
    assert rig.ask(0x080) == []


@rule("CiA 301, table 38")
def no_pdo_in_pre_operational(rig: Rig) -> None:
    assert rig.ask(0x080) == []


@rule("CiA 301, 7.2.8.2.2.1")
def guarding_toggles_from_0(rig: Rig) -> None:
    rig.nmt(RESET_COMMUNICATION)
    rig.nmt(RESET_COMMUNICATION)
    seen = []
    for _ in range(4):
        rig.send(GUARD, remote=True)
        seen.append(rig.wait_for(GUARD)[0].data[0])
    # the fence of the last reset was the first request after it
    assert seen == [0xFF, 0x7F, 0xFF, 0x7F]


@rule("CiA 301, 7.2.8.2.2.2")
def heartbeat_starts_when_it_is_set_and_keeps_its_time(rig: Rig) -> None:
    rig.send(SDO_REQUEST, initiate(0x2B, 0x1017, 0, b"\x32\x00"))
    first, began = rig.wait_for(GUARD)
    assert first.data == b"\x7f"
    stamps = [rig.wait_for(GUARD)[1] for _ in range(3)]
    assert stamps[-1] - began == pytest.approx(0.150, abs=0.1)
    rig.send(SDO_REQUEST, initiate(0x2B, 0x1017, 0))


@rule("CiA 301, 7.5.2.19")
def two_consumers_of_one_node_are_refused(rig: Rig) -> None:
    rig.write(0x1016, 1, 10 << 16 | 1000, 4)
    rig.write(0x1016, 2, 11 << 16 | 1000, 4)
    assert rig.refusal(0x1016, 2, 10 << 16 | 500, 4) == 0x0604_0043
    assert rig.refusal(0x1016, 3, 11 << 16 | 500, 4) == 0x0604_0043
    rig.write(0x1016, 3, 10 << 16, 4)


@rule("CiA 301, 7.5.2.19")
def a_node_does_not_watch_itself(rig: Rig) -> None:
    assert rig.refusal(0x1016, 1, NODE << 16 | 500, 4) == 0x0609_0030
    rig.write(0x1016, 1, NODE << 16, 4)


@rule("CiA 301, 7.2.8.2.2.2 and 7.5.2.32")
def a_lost_heartbeat_is_told_and_acts_by_1029h(rig: Rig) -> None:
    for value, left in ((0, NmtState.PRE_OPERATIONAL), (1, NmtState.OPERATIONAL), (2, NmtState.STOPPED)):
        rig.nmt(RESET_NODE)
        rig.write(0x1029, 1, value, 1)
        rig.write(0x1016, 1, 10 << 16 | 60, 4)
        rig.enter(NmtState.OPERATIONAL)
        rig.send(0x70A, b"\x05")
        assert rig.wait_for(0x080 + NODE)[0].data[:3] == b"\x30\x81\x11"
        assert rig.state is left


@rule("CiA 301, 7.5.2.32")
def error_behaviour_beyond_2_is_refused(rig: Rig) -> None:
    assert rig.refusal(0x1029, 1, 3, 1) == 0x0609_0030


@rule("CiA 301, 7.3.2.2")
def reset_of_the_communication_leaves_the_application_alone(rig: Rig) -> None:
    before = rig.number(0x6085)
    rig.write(0x6085, 0, before + 1, 4)
    rig.write(0x1015, 0, 7, 2)
    rig.nmt(RESET_COMMUNICATION)
    assert (rig.number(0x6085), rig.number(0x1015)) == (before + 1, 0)
    rig.nmt(RESET_NODE)
    assert rig.number(0x6085) == before
