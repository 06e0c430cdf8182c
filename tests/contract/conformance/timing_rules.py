"""What happens by time alone: inhibit times, SYNC window, life guarding, SDO time-out; and TIME (CiA 301)."""

from itertools import pairwise

import pytest

from servobench.drivers.canopen.nmt_states import NmtState
from tests.contract.conformance.pdo_rules import (
    EMCY,
    EXTENDED,
    NOT_VALID,
    SYNC,
    TARGET_WORD,
    TPDO3,
    quiet,
)
from tests.contract.conformance.rig import GUARD, NODE, SDO_REQUEST, SDO_RESPONSE, Rig, initiate
from tests.contract.conformance.rule import Rules

RULES = Rules()
rule = RULES.of
RPDO2 = 0x300 + NODE
TARGET_TORQUE, GUARD_TIME, LIFE_TIME_FACTOR = 0x6071, 0x100C, 0x100D
WINDOW, EMCY_INHIBIT, TIME_COB_ID = 0x1007, 0x1015, 0x1012
TIME = 0x100
INHIBIT_S = 0.2


def write_torque(rig: Rig, value: int) -> None:
    """By SDO, without waiting for what comes of it."""
    rig.send(SDO_REQUEST, initiate(0x2B, TARGET_TORQUE, 0, value.to_bytes(2, "little")))


@rule("CiA 301, 7.5.2.37, sub-index 3")
def an_event_driven_tpdo_keeps_its_inhibit_time_and_loses_no_last_value(rig: Rig) -> None:
    quiet(rig)
    rig.write(0x1802, 3, int(INHIBIT_S * 10_000), 2)
    rig.remap(3, TPDO3, 254, (TARGET_WORD,), transmit=True)
    rig.enter(NmtState.OPERATIONAL)
    rig.pause(1.5 * INHIBIT_S)
    for value in (1, 2, 3):
        write_torque(rig, value)
    came = [rig.wait_for(TPDO3) for _ in range(2)]
    assert [frame.data for frame, _ in came] == [b"\x01\x00", b"\x03\x00"]
    assert came[1][1] - came[0][1] == pytest.approx(INHIBIT_S, abs=0.1)
    assert TPDO3 not in [frame.can_id for frame in rig.pause(1.5 * INHIBIT_S)]


@rule("CiA 301, 7.5.2.18")
def emergencies_keep_their_inhibit_time_and_none_is_lost(rig: Rig) -> None:
    rig.write(EMCY_INHIBIT, 0, int(INHIBIT_S * 10_000), 2)
    rig.remap(2, RPDO2, 255, (TARGET_WORD,), transmit=False)
    rig.enter(NmtState.OPERATIONAL)
    for data in (b"\x4d", b"\x4d\x00", b"\x4d\x00\x00"):
        rig.send(RPDO2, data)
    came = [rig.wait_for(EMCY) for _ in range(3)]
    assert [frame.data[:2] for frame, _ in came] == [b"\x10\x82", b"\x00\x00", b"\x20\x82"]
    for (_, before), (_, after) in pairwise(came):
        assert after - before == pytest.approx(INHIBIT_S, abs=0.1)


@rule("CiA 301, 7.5.2.8")
def a_synchronous_rpdo_beyond_the_window_is_discarded(rig: Rig) -> None:
    quiet(rig)
    rig.remap(2, RPDO2, 1, (TARGET_WORD,), transmit=False)
    rig.write(WINDOW, 0, 300_000, 4)
    rig.enter(NmtState.OPERATIONAL)
    rig.send(SYNC)
    rig.send(RPDO2, b"\x11\x00")
    rig.send(SYNC)
    assert rig.number(TARGET_TORQUE) == 0x11
    rig.pause(0.4)
    rig.send(RPDO2, b"\x22\x00")
    rig.send(SYNC)
    assert rig.number(TARGET_TORQUE) == 0x11
    rig.send(RPDO2, b"\x33\x00")
    rig.send(SYNC)
    assert rig.number(TARGET_TORQUE) == 0x33


@rule("CiA 301, 7.2.8.2.2.1, 7.5.2.11 and 7.5.2.12")
def life_guarding_begins_with_the_first_request_and_ends_the_operation(rig: Rig) -> None:
    rig.send(0x000, bytes([1, NODE]))
    for index, data in ((LIFE_TIME_FACTOR, b"\x02"), (GUARD_TIME, b"\x64\x00")):
        rig.send(SDO_REQUEST, initiate(0x23 | (4 - len(data)) << 2, index, 0, data))
        assert rig.wait_for(SDO_RESPONSE)[0].data[0] == 0x60
    assert rig.pause(0.4) == []
    rig.send(GUARD, remote=True)
    asked = rig.wait_for(GUARD)[1]
    emergency, told = rig.wait_for(EMCY)
    assert emergency.data[:3] == b"\x30\x81\x11"
    assert told - asked == pytest.approx(0.2, abs=0.1)
    frames, state = rig.fence()
    assert state is NmtState.PRE_OPERATIONAL
    frames += rig.fence()[0]
    assert b"\x00\x00" in [frame.data[:2] for frame in frames if frame.can_id == EMCY]


@rule("CiA 301, table 22, 05040000h")
def a_client_that_falls_silent_is_told_that_its_time_is_up(rig: Rig) -> None:
    rig.send(SDO_REQUEST, initiate(0x21, EMCY_INHIBIT, 0, b"\x02"))
    assert rig.wait_for(SDO_RESPONSE)[0].data[0] == 0x60
    abort, _ = rig.wait_for(SDO_RESPONSE)
    assert abort.data == initiate(0x80, EMCY_INHIBIT, 0, (0x0504_0000).to_bytes(4, "little"))
    assert rig.number(EMCY_INHIBIT) == 0


@rule("CiA 301, table 22, 05040005h")
def more_than_there_is_memory_for_is_refused_before_the_data(rig: Rig) -> None:
    for command in (0x21, 0xC2):
        answer = rig.sdo(initiate(command, EMCY_INHIBIT, 0, (1 << 31).to_bytes(4, "little")))
        assert answer == initiate(0x80, EMCY_INHIBIT, 0, (0x0504_0005).to_bytes(4, "little"))


@rule("CiA 301, 7.5.2.15")
def a_time_cob_id_that_cannot_be_is_refused(rig: Rig) -> None:
    for value in (1 << 30 | TIME, EXTENDED | TIME, 0x101, NOT_VALID | 0x601):
        assert rig.refusal(TIME_COB_ID, 0, value, 4) == 0x0609_0030
    rig.write(TIME_COB_ID, 0, NOT_VALID | 0x1A0, 4)
    rig.write(TIME_COB_ID, 0, TIME, 4)


@rule("CiA 301, 7.2.6")
def time_is_taken_in_silence_whatever_its_length(rig: Rig) -> None:
    for state in (NmtState.PRE_OPERATIONAL, NmtState.OPERATIONAL, NmtState.STOPPED):
        rig.enter(state)
        for length in range(9):
            rig.send(TIME, bytes(range(length)))
        assert rig.fence() == ([], state)
