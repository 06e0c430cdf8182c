"""Bus load from a bounded number of checkpoints."""

import pytest

from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.virtual_bus.core.native import CHECKPOINTS_MAX, BusLoad
from servobench.virtual_bus.frame import Frame


def test_busy_spell_lies_at_the_end_of_its_interval() -> None:
    load = BusLoad()
    load.add(100, Instant(1_000))
    load.add(300, Instant(2_000))
    assert [load.busy_until(Instant(when)) for when in (0, 900, 950, 1_000)] == [0, 0, 50, 100]
    assert [load.busy_until(Instant(when)) for when in (1_700, 1_800, 2_000, 9_000)] == [100, 200, 400, 400]
    assert load.percent(Instant(950), Instant(1_750)) == pytest.approx(100 * 100 / 800)


def test_a_long_run_keeps_its_bound_and_its_accuracy() -> None:
    load = BusLoad()
    frames = 5 * CHECKPOINTS_MAX + 7
    for number in range(1, frames + 1):
        load.add(25, Instant(100 * number))
    end = Instant(100 * frames)
    assert load.busy_ns == 25 * frames
    assert load.percent(Instant(0), end) == pytest.approx(25.0, rel=1e-12)
    between_checkpoints = 8 * 25
    for when in range(0, end, 99_991):
        assert abs(load.busy_until(Instant(when)) - when / 4) <= between_checkpoints


def test_the_load_of_a_bus_is_that_of_the_frames_that_were_seen() -> None:
    """A frame of 8 octets 55h and its stuff bits, with three bits after it, at 100 kbit/s."""
    load = BusLoad(100_000)
    assert load.percent(Instant(0), Instant(10 * NS_PER_MS)) == 0.0
    for at_ms in (2, 4, 6, 8):
        load.show(Frame(0x7FF, b"\x55" * 8), False, Instant(at_ms * NS_PER_MS))
    # 44 + 64 bits, a stuff bit after each five ones of the identifier, and 3 bits of intermission
    whole = load.percent(Instant(0), Instant(10 * NS_PER_MS))
    assert whole == pytest.approx(4 * (44 + 64 + 2 + 3) * 0.01 / 10.0 * 100.0)
    half = load.percent(Instant(0), Instant(5 * NS_PER_MS))
    assert half == pytest.approx((2 * 1.13 + 0.13) / 5.0 * 100.0), "a part of the third lies within it"
    remote = BusLoad(100_000)
    remote.show(Frame(0x7FF, b"", False, True, 8), True, Instant(2 * NS_PER_MS))
    assert remote.busy_ns == pytest.approx((44 + 2 + 3) * 10_000, abs=10_000), (
        "it asks for 8 octets, has none"
    )


def test_frames_that_are_told_late_are_counted_where_the_last_one_was() -> None:
    load = BusLoad(100_000)
    for at_ms in (8, 2):
        load.show(Frame(0x7FF, b""), at_ms == 2, Instant(at_ms * NS_PER_MS))
    assert load.percent(Instant(0), Instant(5 * NS_PER_MS)) == 0.0
    assert load.percent(Instant(5 * NS_PER_MS), Instant(10 * NS_PER_MS)) > 0.0


def test_a_load_counts_no_frames_without_a_bit_rate_and_none_that_no_bus_carries() -> None:
    with pytest.raises(ValueError, match="bit rate"):
        BusLoad().show(Frame(1, b""), False, Instant(0))
    with pytest.raises(ValueError, match="9 octets"):
        BusLoad(1_000_000).show(Frame(1, bytes(9)), False, Instant(0))
    with pytest.raises(ValueError, match="-1 bit/s"):
        BusLoad(-1)
