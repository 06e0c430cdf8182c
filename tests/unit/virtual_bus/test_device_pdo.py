"""PDOs: transmission types, inhibit and event timers, deadline (CiA 301, 7.2.2)."""

import pytest

from servobench.drivers.canopen.cob_ids import NO_RTR, NOT_VALID
from servobench.drivers.canopen.objects301 import mapping_word
from servobench.virtual_bus.device.device_options import DeviceOptions, PdoDefault
from servobench.virtual_bus.device.station import CommunicationLoss
from servobench.virtual_bus.frame import Frame
from tests.unit.virtual_bus.device_bench import (
    LEVEL,
    NODE,
    PRE_OPERATIONAL,
    START,
    Bench,
    operational,
)

RPDO1, RPDO2, TPDO1, TPDO2 = 0x200 + NODE, 0x300 + NODE, 0x180 + NODE, 0x280 + NODE
LEVEL_WORD = mapping_word(LEVEL, 0, 32)
MS = 1_000_000


def tpdo2(kind: int, *, inhibit: int = 0, event_ms: int = 0, start: int = 0, rtr: bool = False) -> Bench:
    """A bench whose TPDO2 maps LEVEL with transmission type ``kind``; OPERATIONAL."""
    bench = Bench()
    bench.write(0x1801, 3, inhibit, 2)
    bench.write(0x1801, 5, event_ms, 2)
    bench.write(0x1801, 6, start, 1)
    bench.write(0x1800, 1, NOT_VALID | NO_RTR | TPDO1, 4)
    bench.remap(0x1801, 0x1A01, TPDO2 | (0 if rtr else NO_RTR), kind, [LEVEL_WORD])
    return bench


def change_level(bench: Bench, value: int) -> list[Frame]:
    """The application changes LEVEL; frames that this sends."""
    before = len(bench.sent)
    bench.act()
    bench.application.level.value = value
    bench.act()
    return [frame for _, frame in bench.sent[before:]]


def level_frame(value: int) -> Frame:
    return Frame(TPDO2, value.to_bytes(4, "little", signed=True))


def test_rpdo_acts_at_once_and_stores_all_before_the_first_hook() -> None:
    bench = operational()
    seen: list[int] = []
    bench.application.target.on_write = lambda _value: seen.append(bench.application.level.value)
    bench.put(RPDO1, b"\x10\x00\x2a\x00\x00\x00")
    assert (bench.application.target.value, bench.application.level.value) == (16, 42)
    assert seen == [42]


def test_rpdo_beyond_the_limits_leaves_that_variable() -> None:
    bench = operational()
    bench.put(RPDO1, b"\xff\x7f\x2a\x00\x00\x00")
    assert (bench.application.target.value, bench.application.level.value) == (0, 42)


@pytest.mark.parametrize("kind", [0, 1, 7, 240])
def test_synchronous_rpdo_waits_for_the_next_sync_and_the_last_one_counts(kind: int) -> None:
    bench = operational()
    bench.write(0x1400, 2, kind, 1)
    bench.put(RPDO1, b"\x01\x00\x00\x00\x00\x00")
    bench.put(RPDO1, b"\x02\x00\x00\x00\x00\x00")
    assert bench.application.target.value == 0
    bench.application.calls.clear()
    bench.sync()
    assert [call[0] for call in bench.application.calls] == ["target", "sync"]
    assert bench.application.target.value == 2
    bench.application.target.value = 0
    bench.sync()
    assert bench.application.target.value == 0


def test_synchronous_rpdo_is_forgotten_when_operational_ends() -> None:
    bench = operational()
    bench.write(0x1400, 2, 1, 1)
    bench.put(RPDO1, b"\x01\x00\x00\x00\x00\x00")
    bench.nmt(PRE_OPERATIONAL)
    bench.nmt(START)
    bench.sync()
    assert bench.application.target.value == 0


def test_tpdo_is_sampled_before_the_set_point_acts() -> None:
    bench = operational()
    bench.write(0x1400, 2, 1, 1)
    bench.put(RPDO1, b"\x00\x00\x2a\x00\x00\x00")
    (first,) = bench.sync()
    (second,) = bench.sync()
    assert (first.data[2], second.data[2]) == (7, 42)


def test_short_rpdo_is_not_processed_and_long_one_is() -> None:
    bench = operational()
    (emergency,) = bench.put(RPDO1, bytes(5))
    assert (emergency.can_id, emergency.data[:3]) == (0x80 + NODE, b"\x10\x82\x11")
    assert bench.application.level.value == 7
    assert bench.put(RPDO1, bytes(5)) == []
    cleared, too_long = bench.put(RPDO1, bytes(8))
    assert (cleared.data[:3], too_long.data[:2]) == (b"\x00\x00\x00", b"\x20\x82")
    assert bench.application.level.value == 0
    (cleared,) = bench.put(RPDO1, bytes(6))
    assert cleared.data[:3] == b"\x00\x00\x00"


def test_rpdo_deadline_runs_from_the_first_reception() -> None:
    bench = operational()
    bench.write(0x1400, 5, 20, 2)
    assert bench.run_until_ms(100) == []
    bench.put(RPDO1, bytes(6))
    ((at, emergency),) = bench.run_until_ms(200)
    assert (at, emergency.data[:2]) == (120 * MS, b"\x50\x82")
    assert bench.application.calls[-1] == ("loss", CommunicationLoss.RPDO_DEADLINE, 0, 120 * MS)
    (cleared,) = bench.put(RPDO1, bytes(6))
    assert cleared.data[:2] == b"\x00\x00"


@pytest.mark.parametrize("kind", [1, 2, 3, 240])
def test_cyclic_tpdo_goes_with_every_nth_sync(kind: int) -> None:
    bench = tpdo2(kind)
    bench.nmt(START)
    sent = [number for number in range(1, 3 * kind + 1) if bench.sync()]
    assert sent == [kind, 2 * kind, 3 * kind]


def test_sync_start_value() -> None:
    bench = tpdo2(2, start=3)
    bench.write(0x1019, 0, 10, 1)
    bench.nmt(START)
    counters = [*range(1, 11), *range(1, 11)]
    sent = [number for number, counter in enumerate(counters, 1) if bench.sync(counter)]
    assert sent == list(range(3, 21, 2))


def test_acyclic_synchronous_tpdo_waits_for_a_sync_after_the_event() -> None:
    bench = tpdo2(0)
    bench.nmt(START)
    assert bench.sync() == [level_frame(7)]
    assert bench.sync() == []
    assert change_level(bench, 8) == []
    assert bench.sync() == [level_frame(8)]
    assert bench.sync() == []


def test_type_252_sends_on_request_what_was_sampled_at_the_sync() -> None:
    bench = tpdo2(252, rtr=True)
    bench.nmt(START)
    assert bench.sync() == []
    bench.application.level.value = 99
    assert bench.put(TPDO2, remote=True) == [level_frame(7)]
    bench.sync()
    assert bench.put(TPDO2, remote=True) == [level_frame(99)]


def test_type_253_samples_on_request() -> None:
    bench = tpdo2(253, rtr=True)
    bench.nmt(START)
    bench.application.level.value = 99
    assert bench.put(TPDO2, remote=True) == [level_frame(99)]


def test_request_is_ignored_where_it_is_not_allowed() -> None:
    bench = tpdo2(253)
    bench.nmt(START)
    assert bench.put(TPDO2, remote=True) == []
    assert tpdo2(253, rtr=True).put(TPDO2, remote=True) == []


@pytest.mark.parametrize("kind", [254, 255])
def test_event_driven_tpdo(kind: int) -> None:
    bench = tpdo2(kind)
    assert change_level(bench, 1) == []
    assert bench.nmt(START) == [level_frame(1)]
    assert change_level(bench, 2) == [level_frame(2)]
    bench.application.count.value += 1
    bench.act()
    assert bench.run_until_ms(10) == []


def test_write_over_sdo_is_an_event() -> None:
    bench = tpdo2(255)
    bench.nmt(START)
    bench.write(LEVEL, 0, 5, 4)
    assert level_frame(5) in [frame for _, frame in bench.sent]


def test_inhibit_time_holds_back_and_sends_the_latest() -> None:
    bench = tpdo2(255, inhibit=50)
    bench.nmt(START)
    assert change_level(bench, 1) == []
    assert change_level(bench, 2) == []
    assert bench.run_until_ms(20) == [(5 * MS, level_frame(2))]
    assert change_level(bench, 3) == [level_frame(3)]


def test_event_timer_repeats_from_the_last_transmission() -> None:
    bench = tpdo2(255, event_ms=10)
    bench.nmt(START)
    bench.run_until_ms(4)
    change_level(bench, 1)
    assert [at for at, _ in bench.run_until_ms(40)] == [14 * MS, 24 * MS, 34 * MS]


def test_event_timer_shorter_than_the_inhibit_time() -> None:
    bench = tpdo2(255, event_ms=2, inhibit=100)
    bench.nmt(START)
    assert [at for at, _ in bench.run_until_ms(35)] == [10 * MS, 20 * MS, 30 * MS]


def test_synchronous_window_discards_late_rpdos() -> None:
    bench = operational()
    bench.write(0x1400, 2, 1, 1)
    bench.write(0x1007, 0, 500, 4)
    bench.sync()
    bench.run_until_ms(0.4)
    bench.put(RPDO1, b"\x01\x00\x00\x00\x00\x00")
    bench.run_until_ms(0.6)
    bench.put(RPDO1, b"\x02\x00\x00\x00\x00\x00")
    bench.sync()
    assert bench.application.target.value == 1


def test_device_clock_is_mapped_and_drifts() -> None:
    options = DeviceOptions(
        tpdos=(PdoDefault(NO_RTR | 0x180, 1, (mapping_word(0x1013, 0, 32),)),),
        clock_offset_ns=(1 << 32) * 1000 - 5_000_000,
        clock_drift_ppb=100_000,
    )
    bench = operational(options)
    stamps = []
    for milliseconds in (0, 10, 1000):
        bench.run_until_ms(milliseconds)
        stamps.append(int.from_bytes(bench.sync()[0].data, "little"))
    assert stamps == [(1 << 32) - 5000, 5001, 995_100]
    bench.write(0x1013, 0, 77, 4)
    assert bench.read(0x1013) == 77


def test_changed_event_timer_of_a_live_pdo_starts_again_without_a_frame() -> None:
    bench = tpdo2(255, event_ms=10)
    bench.nmt(START)
    bench.run_until_ms(4)
    before = len(bench.sent)
    bench.write(0x1801, 5, 20, 2)
    assert [frame.can_id for _, frame in bench.sent[before:]] == [0x580 + NODE]
    assert [at for at, _ in bench.run_until_ms(50)] == [24 * MS, 44 * MS]


def test_pdo_that_is_switched_on_in_operational_is_alive_at_once() -> None:
    bench = tpdo2(255, rtr=True)
    bench.nmt(START)
    bench.write(0x1801, 1, NOT_VALID | TPDO2, 4)
    assert bench.put(TPDO2, remote=True) == []
    before = len(bench.sent)
    bench.write(0x1801, 1, TPDO2, 4)
    assert level_frame(7) in [frame for _, frame in bench.sent[before:]]
    assert bench.put(TPDO2, remote=True) == [level_frame(7)]
