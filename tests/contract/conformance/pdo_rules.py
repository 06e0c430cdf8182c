"""PDO, SYNC, EMCY, stored parameters (CiA 301, 7.2.2, 7.2.5, 7.2.7, 7.5.2) and LSS (CiA 305)."""

import pytest

from servobench.drivers.canopen.nmt_states import NmtState
from servobench.virtual_bus.frame import Frame
from tests.contract.conformance.rig import NODE, RESET_NODE, Rig
from tests.contract.conformance.rule import Rules

RULES = Rules()
rule = RULES.of
NOT_VALID, NO_RTR, EXTENDED = 1 << 31, 1 << 30, 1 << 29
TPDO3 = 0x380 + NODE
STATUSWORD = 0x6041_0010
MODE_WORD, MODE_DISPLAY = 0x6060_0008, 0x6061_0008
CONTROLWORD, TARGET_TORQUE, TARGET_WORD = 0x6040, 0x6071, 0x6071_0010
SYNC, EMCY = 0x080, 0x080 + NODE
SAVE, LOAD = int.from_bytes(b"save", "little"), int.from_bytes(b"load", "little")


def quiet(rig: Rig) -> None:
    """Only TPDO3 is left to be tried."""
    for number in (1, 2):
        rig.write(0x1800 + number - 1, 1, NOT_VALID | rig.number(0x1800 + number - 1, 1), 4)


@rule("CiA 301, 7.2.2.2, types 1..240")
def a_cyclic_tpdo_comes_with_every_nth_sync(rig: Rig) -> None:
    quiet(rig)
    rig.remap(3, TPDO3, 3, (STATUSWORD,), transmit=True)
    rig.enter(NmtState.OPERATIONAL)
    came = [len(rig.ask(SYNC)) for _ in range(6)]
    assert came == [0, 0, 1, 0, 0, 1]


@rule("CiA 301, 7.5.2.37, type 253")
def a_tpdo_on_request_comes_on_a_remote_frame_only(rig: Rig) -> None:
    quiet(rig)
    for kind in (252, 253):
        rig.remap(3, TPDO3, kind, (STATUSWORD,), transmit=True)
        rig.enter(NmtState.OPERATIONAL)
        assert rig.ask(SYNC) == []
        assert [frame.can_id for frame in rig.ask(TPDO3, remote=True)] == [TPDO3]
        rig.enter(NmtState.PRE_OPERATIONAL)
        assert rig.ask(TPDO3, remote=True) == []


@rule("CiA 301, 7.5.2.37, bit 30")
def bit_30_forbids_the_remote_request(rig: Rig) -> None:
    quiet(rig)
    rig.remap(3, NO_RTR | TPDO3, 253, (STATUSWORD,), transmit=True)
    rig.enter(NmtState.OPERATIONAL)
    assert rig.ask(TPDO3, remote=True) == []


@rule("CiA 301, 7.2.2.3 and 7.5.2.37, types 254 and 255; CiA 402-2, 6061h")
def an_event_driven_tpdo_tells_a_mode_that_a_pdo_brought(rig: Rig) -> None:
    quiet(rig)
    rig.remap(2, 0x300 + NODE, 255, (CONTROLWORD << 16 | 16, MODE_WORD), transmit=False)
    for kind in (254, 255):
        rig.remap(3, NO_RTR | TPDO3, kind, (STATUSWORD, MODE_DISPLAY), transmit=True)
        rig.enter(NmtState.OPERATIONAL)
        for mode, told in ((1, [1]), (3, [3]), (3, []), (10, [10])):
            answers = rig.ask(0x300 + NODE, b"\x00\x00" + bytes([mode]))
            assert [frame.data[2] for frame in answers if frame.can_id == TPDO3] == told
        rig.enter(NmtState.PRE_OPERATIONAL)


@rule("CiA 301, 7.2.2.2 and 7.5.2.37, type 0; CiA 402-2, 6061h")
def an_acyclic_synchronous_tpdo_tells_a_mode_with_the_next_sync(rig: Rig) -> None:
    quiet(rig)
    rig.remap(2, 0x300 + NODE, 255, (MODE_WORD,), transmit=False)
    rig.remap(3, NO_RTR | TPDO3, 0, (MODE_DISPLAY,), transmit=True)
    rig.enter(NmtState.OPERATIONAL)
    rig.ask(SYNC)
    for mode in (1, 3, 10):
        assert rig.ask(SYNC) == []
        assert rig.ask(0x300 + NODE, bytes([mode])) == []
        assert rig.ask(SYNC) == [Frame(TPDO3, bytes([mode]))]


@rule("CiA 301, 7.5.2.37, sub-index 5")
def an_event_driven_tpdo_follows_its_event_timer(rig: Rig) -> None:
    quiet(rig)
    rig.remap(3, TPDO3, 254, (STATUSWORD,), transmit=True)
    rig.write(0x1802, 5, 40, 2)
    rig.send(0x000, bytes([1, NODE]))
    stamps = [rig.wait_for(TPDO3)[1] for _ in range(4)]
    assert stamps[-1] - stamps[0] == pytest.approx(0.12, abs=0.08)


@rule("CiA 301, 7.5.2.37, sub-index 3")
def the_inhibit_time_is_changed_only_while_the_pdo_is_not_valid(rig: Rig) -> None:
    assert rig.refusal(0x1800, 3, 100, 2) == 0x0800_0022
    rig.write(0x1802, 3, 100, 2)


@rule("CiA 301, 7.5.2.35 and 7.5.2.37")
def reserved_transmission_types_are_refused(rig: Rig) -> None:
    for kind in range(241, 252):
        assert rig.refusal(0x1802, 2, kind, 1) == 0x0609_0030
    for kind in (241, 252, 253):
        assert rig.refusal(0x1402, 2, kind, 1) == 0x0609_0030


@rule("CiA 301, 7.5.2.35 and 7.5.2.37")
def an_existing_pdo_keeps_its_cob_id_and_a_restricted_one_is_refused(rig: Rig) -> None:
    assert rig.refusal(0x1800, 1, NO_RTR | 0x1A0 + NODE, 4) == 0x0609_0030
    assert rig.refusal(0x1802, 1, EXTENDED | TPDO3, 4) == 0x0609_0030
    for can_id in (0x000, 0x001, 0x07F, 0x101, 0x180, 0x581, 0x601, 0x6E0, 0x701, 0x7FF):
        assert rig.refusal(0x1802, 1, can_id, 4) == 0x0609_0030


@rule("CiA 301, 7.5.2.36 and 7.5.2.38")
def a_pdo_is_remapped_in_the_standard_order_only(rig: Rig) -> None:
    assert rig.refusal(0x1A00, 0, 0, 1) == 0x0800_0022
    assert rig.refusal(0x1A00, 1, STATUSWORD, 4) == 0x0800_0022
    assert rig.refusal(0x1A02, 1, 0x5F00_0010, 4) == 0x0602_0000
    assert rig.refusal(0x1A02, 1, 0x6041_0008, 4) == 0x0604_0041
    assert rig.refusal(0x1A02, 1, 0x1000_0020, 4) == 0x0604_0041
    assert rig.refusal(0x1602, 1, STATUSWORD, 4) == 0x0604_0041
    for subindex in (1, 2, 3):
        rig.write(0x1A02, subindex, 0x6064_0020, 4)
    assert rig.refusal(0x1A02, 0, 3, 1) == 0x0604_0042
    rig.write(0x1A02, 0, 2, 1)
    assert rig.refusal(0x1A02, 1, STATUSWORD, 4) == 0x0800_0022


@rule("CiA 301, 7.2.2.2")
def an_rpdo_acts_at_once_or_with_the_next_sync(rig: Rig) -> None:
    quiet(rig)
    for kind, sooner in ((255, 77), (1, 0)):
        rig.remap(2, 0x300 + NODE, kind, (TARGET_WORD,), transmit=False)
        rig.write(TARGET_TORQUE, 0, 0, 2)
        rig.enter(NmtState.OPERATIONAL)
        rig.send(0x300 + NODE, b"\x4d\x00")
        assert rig.number(TARGET_TORQUE) == sooner
        rig.send(SYNC)
        assert rig.number(TARGET_TORQUE) == 77


@rule("CiA 301, 7.2.2 and table 26")
def an_rpdo_of_wrong_length_is_told_by_emcy(rig: Rig) -> None:
    rig.remap(2, 0x300 + NODE, 255, (TARGET_WORD,), transmit=False)
    rig.enter(NmtState.OPERATIONAL)
    short = rig.ask(0x300 + NODE, b"\x4d")
    assert [frame.data[:3] for frame in short if frame.can_id == EMCY] == [b"\x10\x82\x11"]
    assert rig.number(TARGET_TORQUE) == 0
    rig.ask(0x300 + NODE, b"\x4d\x00")
    long = rig.ask(0x300 + NODE, b"\x4e\x00\x00")
    assert b"\x20\x82\x11" in [frame.data[:3] for frame in long if frame.can_id == EMCY]
    assert rig.number(TARGET_TORQUE) == 78


@rule("CiA 301, 7.5.2.35, sub-index 5")
def an_rpdo_that_misses_its_deadline_is_told_by_emcy(rig: Rig) -> None:
    rig.remap(2, 0x300 + NODE, 255, (TARGET_WORD,), transmit=False)
    rig.write(0x1401, 5, 50, 2)
    rig.enter(NmtState.OPERATIONAL)
    rig.send(0x300 + NODE, b"\x01\x00")
    assert rig.wait_for(EMCY)[0].data[:2] == b"\x50\x82"


@rule("CiA 301, 7.5.2.5")
def sync_cob_id_bits_30_and_29_are_refused(rig: Rig) -> None:
    for value in (1 << 30 | SYNC, EXTENDED | SYNC):
        assert rig.refusal(0x1005, 0, value, 4) == 0x0609_0030


@rule("CiA 301, 7.5.2.22")
def the_sync_counter_is_checked_and_its_length_told_by_emcy(rig: Rig) -> None:
    for value in (1, 241, 255):
        assert rig.refusal(0x1019, 0, value, 1) == 0x0609_0030
    rig.write(0x1006, 0, 1000, 4)
    assert rig.refusal(0x1019, 0, 10, 1) == 0x0800_0022
    rig.write(0x1006, 0, 0, 4)
    rig.write(0x1019, 0, 10, 1)
    rig.enter(NmtState.OPERATIONAL)
    assert [frame.data[:2] for frame in rig.ask(SYNC)] == [b"\x40\x82"]
    assert 0x180 + NODE in [frame.can_id for frame in rig.ask(SYNC, b"\x01")]


@rule("CiA 301, 7.5.2.22")
def a_sync_with_a_counter_that_is_not_expected_is_told_and_taken(rig: Rig) -> None:
    rig.enter(NmtState.OPERATIONAL)
    came = rig.ask(SYNC, b"\x05")
    assert [frame.data[:2] for frame in came if frame.can_id == EMCY] == [b"\x40\x82"]
    assert 0x180 + NODE in [frame.can_id for frame in came]
    again = [frame.can_id for frame in rig.ask(SYNC, b"\x06")]
    assert (EMCY in again, 0x180 + NODE in again) == (False, True)


@rule("CiA 301, 7.4.7.3 and 7.5.2.38")
def what_cannot_be_mapped_is_refused_for_its_reason(rig: Rig) -> None:
    rig.write(0x1802, 1, NOT_VALID | TPDO3, 4)
    rig.write(0x1A02, 0, 0, 1)
    dummy, unknown_sub, unknown = 0x0006_0010, 0x6041_0110, 0x5FFF_0008
    assert rig.refusal(0x1A02, 1, dummy, 4) == 0x0604_0041
    assert rig.refusal(0x1A02, 1, unknown_sub, 4) == 0x0609_0011
    assert rig.refusal(0x1A02, 1, unknown, 4) == 0x0602_0000


@rule("CiA 301, 7.5.2.37, sub-index 6")
def a_tpdo_waits_for_its_sync_start_value(rig: Rig) -> None:
    quiet(rig)
    rig.write(0x1019, 0, 8, 1)
    rig.write(0x1802, 6, 3, 1)
    rig.remap(3, TPDO3, 2, (STATUSWORD,), transmit=True)
    rig.enter(NmtState.OPERATIONAL)
    came = [counter for counter in range(1, 9) if rig.ask(SYNC, bytes([counter]))]
    assert came == [3, 5, 7]


@rule("CiA 301, 7.5.2.4")
def the_history_keeps_errors_and_is_cleared_by_writing_0_only(rig: Rig) -> None:
    rig.remap(2, 0x300 + NODE, 255, (TARGET_WORD,), transmit=False)
    rig.enter(NmtState.OPERATIONAL)
    rig.ask(0x300 + NODE, b"\x4d")
    assert (rig.number(0x1003, 0), rig.number(0x1003, 1) & 0xFFFF) == (1, 0x8210)
    assert rig.number(0x1001) == 0x11
    assert rig.refusal(0x1003, 0, 1, 1) == 0x0609_0030
    rig.write(0x1003, 0, 0, 1)
    assert rig.number(0x1003, 0) == 0
    assert rig.refusal(0x1003, 1, 0, 4) == 0x0601_0002


@rule("CiA 301, 7.5.2.17")
def an_emcy_that_exists_keeps_its_cob_id(rig: Rig) -> None:
    assert rig.number(0x1014) == EMCY
    assert rig.refusal(0x1014, 0, EMCY + 1, 4) == 0x0609_0030
    rig.write(0x1014, 0, NOT_VALID | EMCY, 4)
    rig.write(0x1014, 0, EMCY + 1, 4)


@rule("CiA 301, 7.5.2.13 and 7.5.2.14")
def parameters_are_stored_and_restored_by_signature_only(rig: Rig) -> None:
    for index in (0x1010, 0x1011):
        for subindex in range(1, 5):
            assert rig.refusal(index, subindex, 0x1234_5678, 4) == 0x0800_0020
    rig.write(0x1015, 0, 9, 2)
    rig.write(0x1010, 2, SAVE, 4)
    rig.write(0x1015, 0, 10, 2)
    rig.nmt(RESET_NODE)
    assert rig.number(0x1015) == 9
    rig.write(0x1011, 1, LOAD, 4)
    assert rig.number(0x1015) == 9
    rig.nmt(RESET_NODE)
    assert rig.number(0x1015) == 0


@rule("CiA 402-2, table of transitions")
def controlwords_without_a_transition_leave_the_drive_as_it_was(rig: Rig) -> None:
    for controlword in (0x00, 0x02, 0x07, 0x0F, 0x0B, 0x80):
        rig.write(CONTROLWORD, 0, controlword, 2)
        assert rig.number(0x6041) & 0x4F == 0x40
    for controlword in (0x06, 0x0F, 0x06):
        rig.write(CONTROLWORD, 0, 0x06, 2)
        assert rig.number(0x6041) & 0x6F == 0x21
        rig.write(CONTROLWORD, 0, 0x80 & controlword, 2)


def lss(command: int, data: bytes = b"") -> bytes:
    return (bytes([command]) + data).ljust(8, b"\x00")


@rule("CiA 305, switch state and inquire")
def lss_answers_in_configuration_only(rig: Rig) -> None:
    assert rig.ask(0x7E5, lss(0x5E)) == []
    rig.send(0x7E5, lss(0x04, b"\x01"))
    assert rig.ask(0x7E5, lss(0x5E)) == [Frame(0x7E4, lss(0x5E, bytes([NODE])))]
    for part in range(4):
        number = rig.read(0x1018, part + 1)
        assert rig.ask(0x7E5, lss(0x5A + part)) == [Frame(0x7E4, lss(0x5A + part, number))]
    rig.send(0x7E5, lss(0x04))
    assert rig.ask(0x7E5, lss(0x11, b"\x09")) == []


@rule("CiA 305, configure")
def lss_refuses_what_it_cannot_be(rig: Rig) -> None:
    rig.send(0x7E5, lss(0x04, b"\x01"))
    for node_id in (0, 128, 254):
        assert rig.ask(0x7E5, lss(0x11, bytes([node_id])))[0].data[:2] == b"\x11\x01"
    for table, rate in ((1, 0), (0, 5), (0, 10)):
        assert rig.ask(0x7E5, lss(0x13, bytes([table, rate])))[0].data[:2] == b"\x13\x01"
    rig.send(0x7E5, lss(0x04))


@rule("CiA 305, activate bit timing")
def lss_activates_no_bit_rate_that_was_not_configured(rig: Rig) -> None:
    rig.send(0x7E5, lss(0x15, b"\x01"))
    rig.send(0x7E5, lss(0x04, b"\x01"))
    rig.send(0x7E5, lss(0x15, b"\x01"))
    assert rig.pause(0.05) == []
    assert rig.ask(0x7E5, lss(0x5E)) == [Frame(0x7E4, lss(0x5E, bytes([NODE])))]
    rig.send(0x7E5, lss(0x04))


@rule("CiA 305, switch state selective")
def lss_selects_by_the_whole_identity(rig: Rig) -> None:
    identity = [rig.read(0x1018, part) for part in range(1, 5)]
    for wrong in range(4):
        for part, number in enumerate(identity):
            other = bytes([number[0] ^ 1]) + number[1:]
            rig.send(0x7E5, lss(0x40 + part, other if part == wrong else number))
        assert rig.fence()[0] == []
    for part, number in enumerate(identity):
        rig.send(0x7E5, lss(0x40 + part, number))
    assert rig.fence()[0] == [Frame(0x7E4, lss(0x44))]
    rig.send(0x7E5, lss(0x04))


@rule("CiA 305, fast scan")
def a_configured_device_keeps_out_of_the_fast_scan(rig: Rig) -> None:
    assert rig.ask(0x7E5, lss(0x51, bytes([0, 0, 0, 0, 0x80, 0, 0]))) == []
    assert rig.ask(0x7E5, lss(0x4C)) == []
