"""PDO parameters: remapping, and what the rules refuse (CiA 301, 7.5.2.33..38)."""

import pytest

from servobench.drivers.canopen.cob_ids import NO_RTR, NOT_VALID
from servobench.drivers.canopen.objects301 import mapping_word
from servobench.virtual_bus.device.sdo_abort import AbortCode
from tests.unit.virtual_bus.device_bench import (
    COUNT,
    DEFAULTS,
    LEVEL,
    NODE,
    NOTE,
    RESET_NODE,
    SECRET,
    START,
    SWITCHES,
    TARGET,
    TRIPLE,
    Bench,
    SdoRefused,
)

RPDO1, RPDO2, TPDO1, TPDO2 = 0x200 + NODE, 0x300 + NODE, 0x180 + NODE, 0x280 + NODE
LEVEL_WORD = mapping_word(LEVEL, 0, 32)


def test_remapping_changes_what_is_on_the_wire() -> None:
    bench = Bench()
    words = [mapping_word(TARGET, 0, 16), mapping_word(0x1001, 0, 8), mapping_word(COUNT, 0, 16)]
    bench.remap(0x1800, 0x1A00, NO_RTR | 0x199, 1, words)
    bench.nmt(START)
    bench.application.target.value = -2
    (frame,) = bench.sync()
    assert (frame.can_id, len(frame.data), frame.data[:3]) == (0x199, 5, b"\xfe\xff\x00")


def test_bits_and_odd_lengths_are_packed_in_order() -> None:
    bench = Bench()
    words = [mapping_word(SWITCHES, number, 1) for number in (1, 2, 3)]
    words += [mapping_word(TRIPLE, 0, 24), mapping_word(SWITCHES, 4, 1)]
    bench.remap(0x1800, 0x1A00, NO_RTR | TPDO1, 1, words)
    bench.remap(0x1401, 0x1601, RPDO2, 255, words)
    bench.nmt(START)
    image = (1 | 1 << 2 | (-2 & 0xFFFFFF) << 3 | 1 << 27).to_bytes(4, "little")
    bench.put(RPDO2, image)
    assert bench.device.dictionary.variable(TRIPLE).value == -2
    values = [bench.device.dictionary.variable(SWITCHES, number).value for number in (1, 2, 3, 4)]
    assert values == [1, 0, 1, 1]
    assert [frame.data for frame in bench.sync()] == [image]


def test_dummy_entries_leave_gaps_in_an_rpdo() -> None:
    bench = Bench()
    bench.remap(0x1401, 0x1601, RPDO2, 255, [0x00050008, 0x00060010, mapping_word(TARGET, 0, 16)])
    bench.nmt(START)
    bench.put(RPDO2, b"\xaa\xbb\xcc\x11\x00")
    assert bench.application.target.value == 0x11


def test_two_rpdos_may_share_a_cob_id() -> None:
    bench = Bench()
    bench.remap(0x1401, 0x1601, RPDO1, 255, [mapping_word(TARGET, 0, 16), mapping_word(TRIPLE, 0, 24)])
    bench.nmt(START)
    bench.put(RPDO1, b"\x05\x00\x06\x00\x00\x00")
    assert bench.application.level.value == 6
    assert bench.device.dictionary.variable(TRIPLE).value == 6


@pytest.mark.parametrize(
    ("communication", "mapping", "cob"), [(0x1400, 0x1600, RPDO1), (0x1800, 0x1A00, TPDO1)]
)
def test_mapping_is_refused_while_the_pdo_exists(communication: int, mapping: int, cob: int) -> None:
    bench = Bench()
    assert bench.refused(mapping, 0, 0, 1) == AbortCode.DEVICE_STATE
    assert bench.refused(mapping, 1, LEVEL_WORD, 4) == AbortCode.DEVICE_STATE
    bench.write(communication, 1, NOT_VALID | cob, 4)
    assert bench.refused(mapping, 1, LEVEL_WORD, 4) == AbortCode.DEVICE_STATE
    bench.write(mapping, 0, 0, 1)
    bench.write(mapping, 1, LEVEL_WORD, 4)


@pytest.mark.parametrize(
    ("word", "code"),
    [
        (mapping_word(0x5FFF, 0, 8), AbortCode.NO_OBJECT),
        (mapping_word(SWITCHES, 9, 1), AbortCode.NO_SUBINDEX),
        (mapping_word(LEVEL, 0, 16), AbortCode.NOT_MAPPABLE),
        (mapping_word(NOTE, 0, 64), AbortCode.NOT_MAPPABLE),
        (mapping_word(SECRET, 0, 8), AbortCode.NOT_MAPPABLE),
        (mapping_word(0x1017, 0, 16), AbortCode.NOT_MAPPABLE),
        (mapping_word(COUNT, 0, 16), AbortCode.NOT_MAPPABLE),
        (mapping_word(5, 0, 16), AbortCode.NOT_MAPPABLE),
    ],
)
def test_what_an_rpdo_cannot_map(word: int, code: AbortCode) -> None:
    assert Bench().refused(0x1601, 1, word, 4) == code


def test_what_a_tpdo_cannot_map() -> None:
    bench = Bench()
    assert bench.refused(0x1A01, 1, mapping_word(SECRET, 0, 8), 4) == AbortCode.NOT_MAPPABLE
    assert bench.refused(0x1A01, 1, mapping_word(5, 0, 8), 4) == AbortCode.NOT_MAPPABLE
    bench.write(0x1A01, 1, mapping_word(COUNT, 0, 16), 4)


def test_mapping_count_is_checked() -> None:
    bench = Bench()
    for subindex in (1, 2):
        bench.write(0x1A01, subindex, LEVEL_WORD, 4)
    bench.write(0x1A01, 3, mapping_word(0x1001, 0, 8), 4)
    assert bench.refused(0x1A01, 0, 3, 1) == AbortCode.PDO_LENGTH
    assert bench.refused(0x1A01, 0, 9, 1) == AbortCode.PDO_LENGTH
    assert bench.refused(0x1A01, 0, 0xFE, 1) == AbortCode.INVALID_VALUE
    bench.write(0x1A01, 0, 2, 1)


def test_count_over_an_empty_entry_is_refused() -> None:
    assert Bench().refused(0x1A01, 0, 1, 1) == AbortCode.NO_OBJECT


@pytest.mark.parametrize(
    ("index", "value"),
    [
        (0x1800, NO_RTR | 0x190),
        (0x1800, TPDO1),
        (0x1400, 0x210),
        (0x1801, 1 << 29 | TPDO2),
        (0x1801, 0x000),
        (0x1801, 0x07F),
        (0x1801, 0x101),
        (0x1801, 0x180),
        (0x1801, 0x581),
        (0x1801, 0x67F),
        (0x1801, 0x6E0),
        (0x1801, 0x705),
        (0x1801, 0x7FF),
    ],
)
def test_forbidden_cob_ids(index: int, value: int) -> None:
    assert Bench().refused(index, 1, value, 4) == AbortCode.INVALID_VALUE


@pytest.mark.parametrize(
    ("index", "reserved", "good"), [(0x1400, range(241, 254), 254), (0x1800, range(241, 252), 252)]
)
def test_reserved_transmission_types(index: int, reserved: range, good: int) -> None:
    bench = Bench()
    for kind in reserved:
        assert bench.refused(index, 2, kind, 1) == AbortCode.INVALID_VALUE
    bench.write(index, 2, good, 1)


@pytest.mark.parametrize(("subindex", "length"), [(3, 2), (6, 1)])
def test_inhibit_time_and_start_value_need_a_pdo_that_is_off(subindex: int, length: int) -> None:
    bench = Bench()
    assert bench.refused(0x1800, subindex, 1, length) == AbortCode.DEVICE_STATE
    bench.write(0x1801, subindex, 1, length)


def test_sync_start_value_beyond_240() -> None:
    assert Bench().refused(0x1801, 6, 241, 1) == AbortCode.INVALID_VALUE


def test_sub_index_4_is_reserved() -> None:
    with pytest.raises(SdoRefused) as error:
        Bench().read(0x1800, 4)
    assert error.value.code == AbortCode.NO_SUBINDEX


def test_reset_of_communication_restores_the_default_mapping() -> None:
    bench = Bench()
    bench.remap(0x1800, 0x1A00, NO_RTR | 0x199, 1, [LEVEL_WORD])
    bench.nmt(130)
    bench.nmt(START)
    assert [(frame.can_id, len(frame.data)) for frame in bench.sync()] == [(TPDO1, 6)]
    assert bench.read(0x1A00, 0) == len(DEFAULTS.tpdos[0].mapping)


def test_sharing_a_cob_id_ends_with_one_of_the_two() -> None:
    bench = Bench()
    bench.remap(0x1401, 0x1601, RPDO1, 255, [mapping_word(TARGET, 0, 16), mapping_word(TRIPLE, 0, 24)])
    bench.write(0x1401, 1, NOT_VALID | RPDO1, 4)
    bench.nmt(START)
    bench.put(RPDO1, b"\x05\x00\x06\x00\x00\x00")
    assert bench.application.level.value == 6
    assert bench.device.dictionary.variable(TRIPLE).value == 0


def test_cob_id_with_bits_beyond_eleven_is_refused() -> None:
    assert Bench().refused(0x1801, 1, 1 << 12 | TPDO2, 4) == AbortCode.INVALID_VALUE


def test_stored_mapping_that_no_longer_resolves_maps_nothing() -> None:
    bench = Bench()
    bench.device.dictionary.variable(0x1A00, 1).power_on = mapping_word(0x5FFF, 0, 8)
    bench.nmt(RESET_NODE)
    bench.nmt(START)
    assert bench.sync() == []
