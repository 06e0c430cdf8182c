"""SDO server (CiA 301, 7.2.4) and access to the dictionary (7.4, table 22)."""

from binascii import crc_hqx

import pytest

from tests.contract.conformance.rig import SDO_REQUEST, SDO_RESPONSE, Aborted, Rig, initiate
from tests.contract.conformance.rule import Rules

RULES = Rules()
rule = RULES.of
TEXT = 0x1008
"""A string longer than 4 bytes."""


def code(answer: bytes) -> int:
    assert answer[0] == 0x80
    return int.from_bytes(answer[4:8], "little")


@rule("CiA 301, 7.2.4.3.5")
def a_number_is_uploaded_expedited_with_its_size(rig: Rig) -> None:
    answer = rig.sdo(initiate(0x40, 0x1000, 0))
    assert answer[:4] == initiate(0x43, 0x1000, 0)[:4]
    assert rig.sdo(initiate(0x40, 0x1001, 0))[0] == 0x4F


@rule("CiA 301, 7.2.4.3.3")
def an_expedited_download_may_leave_its_size_out(rig: Rig) -> None:
    assert rig.sdo(initiate(0x22, 0x1017, 0, b"\x00\x00\xaa\xbb"))[0] == 0x60


@rule("CiA 301, 7.2.4.3.6")
def a_string_is_uploaded_by_segments(rig: Rig) -> None:
    assert len(rig.read(TEXT)) > 7


@rule("CiA 301, 7.2.4.3.4")
def a_number_may_be_downloaded_by_segments(rig: Rig) -> None:
    assert rig.sdo(initiate(0x21, 0x1015, 0, b"\x02"))[0] == 0x60
    assert rig.sdo(bytes([0x0B, 0x34, 0x12]) + bytes(5))[0] == 0x20
    assert rig.number(0x1015) == 0x1234


@rule("CiA 301, table 22")
def a_wrong_toggle_is_aborted(rig: Rig) -> None:
    rig.sdo(initiate(0x40, TEXT, 0))
    assert code(rig.sdo(bytes([0x70]) + bytes(7))) == 0x0503_0000
    rig.sdo(initiate(0x21, 0x1015, 0, b"\x02"))
    assert code(rig.sdo(bytes([0x1B, 1, 2]) + bytes(5))) == 0x0503_0000
    assert rig.number(0x1015) == 0


@rule("CiA 301, table 22")
def unknown_commands_are_aborted(rig: Rig) -> None:
    for command in (0x00, 0x10, 0x60, 0x70, 0xA1, 0xA2, 0xA3, 0xC1, 0xE0, 0xFF):
        assert code(rig.sdo(bytes([command]) + bytes(7))) == 0x0504_0001


@rule("CiA 301, 7.2.4.3.17")
def an_abort_ends_the_transfer_without_an_answer(rig: Rig) -> None:
    rig.sdo(initiate(0x40, TEXT, 0))
    assert rig.ask(SDO_REQUEST, initiate(0x80, TEXT, 0)) == []
    assert code(rig.sdo(bytes([0x60]) + bytes(7))) == 0x0504_0001


@rule("CiA 301, 7.2.4.3")
def what_has_not_8_bytes_is_no_sdo(rig: Rig) -> None:
    for length in range(8):
        assert rig.ask(SDO_REQUEST, initiate(0x40, 0x1000, 0)[:length]) == []


@rule("CiA 301, 7.2.4.2")
def a_new_request_takes_the_place_of_a_transfer(rig: Rig) -> None:
    rig.sdo(initiate(0x21, 0x1015, 0, b"\x02"))
    assert rig.number(0x1000)
    assert code(rig.sdo(bytes([0x0B, 1, 2]) + bytes(5))) == 0x0504_0001


@rule("CiA 301, table 22")
def each_wrong_access_has_its_abort_code(rig: Rig) -> None:
    for index, subindex, value, length, wanted in (
        (0x5F00, 0, 0, 1, 0x0602_0000),
        (0x1018, 9, 0, 1, 0x0609_0011),
        (0x1000, 0, 0, 4, 0x0601_0002),
        (0x1017, 0, 0, 4, 0x0607_0012),
        (0x1017, 0, 0, 1, 0x0607_0013),
        (0x6072, 0, 0xFFFF, 2, 0x0609_0031),
        (0x6080, 0, 0, 4, 0x0609_0032),
        (0x6060, 0, 0x7F, 1, 0x0609_0030),
    ):
        assert rig.refusal(index, subindex, value, length) == wanted, f"{index:04X}h"
    with pytest.raises(Aborted) as aborted:
        rig.read(0x5F00)
    assert aborted.value.code == 0x0602_0000


@rule("CiA 301, 7.2.4.3.3")
def an_announced_size_that_cannot_fit_is_refused_before_the_data(rig: Rig) -> None:
    assert code(rig.sdo(initiate(0x21, 0x1015, 0, b"\x03"))) == 0x0607_0012
    assert code(rig.sdo(initiate(0x21, 0x1015, 0, b"\x01"))) == 0x0607_0013


def block_upload(rig: Rig, block_size: int) -> tuple[bytes, bytes]:
    """The segments of the first sub-block of TEXT, after the initiate and start messages."""
    answer = rig.sdo(initiate(0xA4, TEXT, 0, bytes([block_size, 0])))
    assert answer[0] == 0xC6
    frames = rig.ask(SDO_REQUEST, bytes([0xA3]) + bytes(7))
    return answer, b"".join(frame.data for frame in frames if frame.can_id == SDO_RESPONSE)


@rule("CiA 301, 7.2.4.3.12 to 7.2.4.3.16")
def a_block_upload_has_numbered_segments_size_and_crc(rig: Rig) -> None:
    text = rig.read(TEXT)
    answer, segments = block_upload(rig, 127)
    assert int.from_bytes(answer[4:8], "little") == len(text)
    count = len(segments) // 8
    assert [segments[8 * place] for place in range(count)] == [*range(1, count), 0x80 | count]
    data = b"".join(segments[8 * place + 1 : 8 * place + 8] for place in range(count))
    assert data[: len(text)] == text
    end = rig.sdo(bytes([0xA2, count, 127]) + bytes(5))
    assert (end[0] & 0xE3, end[0] >> 2 & 7) == (0xC1, 7 * count - len(text))
    assert int.from_bytes(end[1:3], "little") == crc_hqx(text, 0)
    assert rig.ask(SDO_REQUEST, bytes([0xA1]) + bytes(7)) == []


@rule("CiA 301, 7.2.4.3.14")
def segments_that_were_not_acknowledged_come_again(rig: Rig) -> None:
    _answer, segments = block_upload(rig, 3)
    frames = rig.ask(SDO_REQUEST, bytes([0xA2, 1, 2]) + bytes(5))
    assert [frame.data[0] for frame in frames] == [1, 2]
    assert frames[0].data[1:] == segments[9:16]


@rule("CiA 301, 7.2.4.3.13")
def short_data_goes_by_the_ordinary_upload_below_the_switch_threshold(rig: Rig) -> None:
    assert rig.sdo(initiate(0xA4, TEXT, 0, bytes([10, 0xFF])))[0] == 0x41
    assert rig.sdo(initiate(0xA4, 0x1000, 0, bytes([10, 4])))[0] == 0x43
    assert rig.sdo(initiate(0xA4, 0x1000, 0, bytes([10, 3])))[0] == 0xC6


@rule("CiA 301, table 22")
def block_sizes_beyond_1_to_127_and_wrong_numbers_are_aborted(rig: Rig) -> None:
    for size in (0, 128, 255):
        assert code(rig.sdo(initiate(0xA4, TEXT, 0, bytes([size, 0])))) == 0x0504_0002
    block_upload(rig, 2)
    assert code(rig.sdo(bytes([0xA2, 3, 2]) + bytes(5))) == 0x0504_0003
    assert rig.sdo(initiate(0xC6, 0x1015, 0, b"\x02"))[0] == 0xA4
    assert code(rig.sdo(bytes([0x00]) + bytes(7))) == 0x0504_0003


def block_download(rig: Rig, crc: int) -> bytes:
    assert rig.sdo(initiate(0xC6, 0x1015, 0, b"\x02")) == initiate(0xA4, 0x1015, 0, bytes([127]))
    assert rig.sdo(bytes([0x81, 0x34, 0x12]) + bytes(5)) == bytes([0xA2, 1, 127]) + bytes(5)
    return rig.sdo(bytes([0xC1 | 5 << 2]) + crc.to_bytes(2, "little") + bytes(5))


@rule("CiA 301, 7.2.4.3.9 to 7.2.4.3.11")
def a_block_download_is_checked_by_its_crc(rig: Rig) -> None:
    crc = crc_hqx(b"\x34\x12", 0)
    assert code(block_download(rig, crc ^ 1)) == 0x0504_0004
    assert rig.number(0x1015) == 0
    assert block_download(rig, crc) == bytes([0xA1]) + bytes(7)
    assert rig.number(0x1015) == 0x1234


@rule("CiA 301, 7.5.2.11 and 7.3.5")
def sdo_server_parameter_tells_the_default_identifiers(rig: Rig) -> None:
    assert (rig.number(0x1200, 1), rig.number(0x1200, 2)) == (SDO_REQUEST, SDO_RESPONSE)
    assert rig.refusal(0x1200, 1, 0x610, 4) == 0x0601_0002
