"""Error frames, repetition, error counters and bus-off against closed forms (Bosch CAN 2.0 B, 3, 7 and 8)."""

from itertools import pairwise

import can
import pytest

from servobench.drivers.timebase import Instant
from servobench.virtual_bus.bus.controller import ErrorState
from servobench.virtual_bus.bus.disturbance import BusError, ErrorKind
from servobench.virtual_bus.frame import Frame
from tests.unit.virtual_bus.can_reference import wire_bits
from tests.unit.virtual_bus.error_bench import (
    BIT_NS,
    DELIMITER,
    FLAG,
    FRAME,
    INTERMISSION,
    SUSPEND,
    Bench,
    crc_delimiter,
    length,
)


def test_an_error_that_all_see_at_once_costs_six_flag_bits_and_the_delimiter() -> None:
    bench = Bench(3)
    sender, *receivers = bench.nodes
    place = crc_delimiter(FRAME)
    starts = bench.disturb(place, 1)
    sender.port.send(FRAME)
    bench.run()
    attempt = place + 1 + FLAG + DELIMITER
    assert starts == [0, (attempt + INTERMISSION) * BIT_NS]
    (error,) = bench.errors
    assert error == BusError(Instant(attempt * BIT_NS), ErrorKind.BIT, "a", FRAME, place, attempt)
    end = (attempt + INTERMISSION + length(FRAME)) * BIT_NS
    assert sender.sent == [end]
    assert [node.got for node in receivers] == [[(end, FRAME)]] * 2
    assert (sender.port.controller.transmit_errors, sender.port.controller.receive_errors) == (8 - 1, 0)
    assert [node.port.controller.receive_errors for node in receivers] == [1 - 1] * 2
    assert (bench.segment.frames, bench.segment.errors) == (1, 1)
    busy = (attempt + INTERMISSION + length(FRAME) + INTERMISSION) * BIT_NS
    assert bench.segment.busy_ns == busy
    assert bench.segment.load_percent(Instant(0), Instant(2 * busy)) == pytest.approx(50.0)


def test_a_bit_error_in_the_data_is_answered_within_twelve_flag_bits() -> None:
    arbitration = 14
    for place in range(arbitration + 6, crc_delimiter(FRAME)):
        bench = Bench(2)
        starts = bench.disturb(place, 1)
        bench.nodes[0].port.send(FRAME)
        bench.run()
        gap = starts[1] // BIT_NS - place - 1 - DELIMITER - INTERMISSION
        assert FLAG <= gap <= 2 * FLAG, place
        assert [frame for _, frame in bench.nodes[1].got] == [FRAME]
        assert bench.nodes[0].port.controller.transmit_errors == 7, place


def test_one_active_receiver_with_a_wrong_crc_makes_everybody_wait_for_the_repetition() -> None:
    bench = Bench(3)
    starts = bench.disturb(60, 1, ("c",))
    bench.nodes[0].port.send(FRAME)
    bench.run()
    assert len(starts) == 2
    assert [len(node.got) for node in bench.nodes] == [0, 1, 1]
    assert bench.nodes[0].port.controller.transmit_errors == 8 - 1


def test_alone_without_acknowledgement_it_gets_passive_and_tries_for_ever() -> None:
    bench = Bench(1, acknowledged=False)
    (alone,) = bench.nodes
    starts = bench.disturb(0, 0)
    alone.port.send(FRAME)
    bench.run(20_000)
    attempt = length(FRAME) - 8 + FLAG + DELIMITER  # up to and with the ACK slot, then the error frame
    gaps = [(after - before) // BIT_NS for before, after in pairwise(starts)]
    assert gaps[:15] == [attempt + INTERMISSION] * 15
    assert set(gaps[15:]) == {attempt + INTERMISSION + SUSPEND}
    assert len(gaps) > 100
    assert alone.states == [((15 * (attempt + INTERMISSION) + attempt) * BIT_NS, ErrorState.PASSIVE)]
    assert alone.port.controller.transmit_errors == 128
    assert {error.kind for error in bench.errors} == {ErrorKind.ACKNOWLEDGEMENT}
    assert bench.segment.frames == 0


def test_a_second_node_that_is_plugged_in_acknowledges_at_last() -> None:
    bench = Bench(2, acknowledged=False)
    sender, other = bench.nodes
    other.port.unplug()
    sender.port.send(FRAME)
    bench.run(20_000)
    assert sender.port.error_state is ErrorState.PASSIVE
    other.port.plug()
    bench.run(21_000)
    assert [frame for _, frame in other.got] == [FRAME]
    assert (sender.port.controller.transmit_errors, sender.port.error_state) == (127, ErrorState.ACTIVE)


def test_sixteen_errors_to_passive_and_thirty_two_to_bus_off() -> None:
    bench = Bench(2)
    sender, other = bench.nodes
    place = crc_delimiter(FRAME)
    starts = bench.disturb(place, 1_000)
    sender.port.send(FRAME)
    bench.run()
    attempt = place + 1 + FLAG + DELIMITER
    assert len(starts) == 32
    active = (attempt + INTERMISSION) * BIT_NS
    passive = active + SUSPEND * BIT_NS
    assert starts == [n * active if n < 16 else 15 * active + (n - 15) * passive for n in range(32)]
    assert sender.states == [
        (starts[15] + attempt * BIT_NS, ErrorState.PASSIVE),
        (starts[31] + attempt * BIT_NS, ErrorState.BUS_OFF),
    ]
    assert other.port.error_state is ErrorState.ACTIVE
    assert other.port.controller.receive_errors == 32
    assert sender.port.pending == 0
    with pytest.raises(can.CanOperationError, match="bus-off"):
        sender.port.send(FRAME)


def test_recovery_takes_128_times_11_bits_of_an_idle_bus() -> None:
    bench = Bench(2)
    off, other = bench.nodes
    off.port.go_bus_off()
    bench.run(100)
    assert off.port.error_state is ErrorState.BUS_OFF
    other.port.send(FRAME)
    bench.run(1_000)
    assert off.got == []
    off.port.recover()
    bench.run(10_000)
    back = 1_000_000 + 128 * 11 * BIT_NS
    assert off.states == [(0, ErrorState.BUS_OFF), (back, ErrorState.ACTIVE)]
    assert (off.port.controller.transmit_errors, off.port.controller.receive_errors) == (0, 0)
    other.port.send(FRAME)
    off.port.send(FRAME)
    bench.run(20_000)
    assert len(off.got) == len(other.got) == 1


def test_on_a_full_bus_recovery_counts_one_sequence_a_frame() -> None:
    bench = Bench(3)
    off, sender, other = bench.nodes
    off.port.recover_after_ns = 0
    for _ in range(200):
        sender.port.send(FRAME)
    bench.run(50)
    off.port.go_bus_off()
    bench.run()
    frame = (length(FRAME) + INTERMISSION) * BIT_NS
    # the n-th frame's own ACK delimiter, end of frame and the intermission behind it are the n-th sequence
    assert off.states[1:] == [(128 * frame, ErrorState.ACTIVE)]
    assert len(other.got) == 200


def test_a_controller_can_recover_by_itself_after_a_while() -> None:
    bench = Bench(2)
    off = bench.nodes[0]
    off.port.recover_after_ns = 5_000_000
    off.port.go_bus_off()
    bench.run()
    assert off.states[1:] == [(5_000_000 + 128 * 11 * BIT_NS, ErrorState.ACTIVE)]


def test_a_listener_neither_acknowledges_nor_sends_nor_flags() -> None:
    bench = Bench(3, acknowledged=False)
    sender, listener, other = bench.nodes
    listener.port.set_listen_only(True)
    bench.disturb(60, 1, ("b",))
    sender.port.send(FRAME)
    listener.port.send(FRAME)
    bench.run(5_000)
    assert bench.segment.errors == 0
    assert (len(listener.got), len(other.got), listener.port.pending) == (0, 1, 1)
    other.port.unplug()
    sender.port.send(FRAME)
    bench.run(10_000)
    assert {error.kind for error in bench.errors} == {ErrorKind.ACKNOWLEDGEMENT}
    assert sender.port.error_state is ErrorState.PASSIVE
    assert len(listener.got) > 1  # a passive sender's flag cannot tell it that the frame is repeated
    listener.port.set_listen_only(False)
    listener.got.clear()
    bench.run(12_000)
    assert len(listener.got) == 2  # the attempt under way had no acknowledgement; the next one has
    assert (sender.port.pending, listener.port.pending) == (0, 0)


@pytest.mark.parametrize("cut_us", [1, 20, 64, 95])
def test_a_sender_that_is_unplugged_breaks_off_and_repeats_when_it_is_back(cut_us: int) -> None:
    bench = Bench(2)
    sender, other = bench.nodes
    sender.port.send(FRAME)
    bench.run(cut_us)
    sender.port.unplug()
    bench.run(1_000)
    assert other.got == []
    assert [error.kind for error in bench.errors] == [ErrorKind.CUT_OFF]
    sender.port.plug()
    bench.run(2_000)
    assert [at for at, _ in other.got] == sender.sent == [1_000_000 + (11 + length(FRAME)) * BIT_NS]


def test_a_controller_that_is_driven_off_in_any_bit_of_its_frame_forgets_what_it_had_to_send() -> None:
    """In the last instant the frame is over, and has been sent. Receivers take it as soon as it has no more
    dominant bits than their own acknowledgement."""
    recessive_from = wire_bits(FRAME)[:-9].rindex("0") + 1
    for cut in range(length(FRAME) + 1):
        bench = Bench(2)
        sender, other = bench.nodes
        bench.go_off_at(cut * BIT_NS, 0)
        sender.port.send(FRAME)
        sender.port.send(Frame(0x281))
        bench.run(1_000)
        is_over = cut == length(FRAME)
        assert (len(sender.sent), bench.segment.frames, sender.port.pending) == (is_over, is_over, 0), cut
        assert len(other.got) == (cut >= recessive_from), cut
        assert len(bench.errors) == (0 < cut < length(FRAME)), cut


def test_an_unplugged_node_misses_what_is_sent_and_keeps_what_it_has_to_say() -> None:
    bench = Bench(3)
    gone, sender, other = bench.nodes
    gone.port.unplug()
    gone.port.send(FRAME)
    sender.port.send(Frame(0x080))
    bench.run(1_000)
    assert (gone.got, gone.port.pending) == ([], 1)
    assert len(other.got) == 1
    gone.port.plug()
    bench.run(2_000)
    assert [len(node.got) for node in bench.nodes] == [0, 1, 2]


def test_a_slightly_wrong_bit_rate_destroys_frames_until_its_node_is_passive() -> None:
    bench = Bench(3)
    strange, sender, other = bench.nodes
    strange.port.set_bitrate(800_000)
    sender.port.send(FRAME)
    bench.run(200_000)
    assert strange.got == []
    assert strange.port.error_state is ErrorState.PASSIVE
    assert len(other.got) == len(sender.sent) == 1
    assert bench.segment.errors == 15  # its receive counter passes 127 at the latest after 15 times 9


@pytest.mark.parametrize("rate", [10_000, 125_000, 250_000, 500_000])
def test_the_long_error_flags_of_a_slow_node_drive_the_others_off_the_bus(rate: int) -> None:
    bench = Bench(3)
    strange, sender, other = bench.nodes
    strange.port.set_bitrate(rate)
    sender.port.send(FRAME)
    bench.run(200_000)
    assert strange.got == other.got == []
    assert sender.port.error_state is ErrorState.BUS_OFF
    strange.port.set_bitrate(1_000_000)
    sender.port.recover()
    bench.run(210_000)
    sender.port.send(FRAME)
    bench.run(220_000)
    assert len(strange.got) == len(other.got) == 1


@pytest.mark.parametrize("rate", [10_000, 250_000, 500_000, 800_000])
def test_what_is_sent_at_another_bit_rate_is_never_understood(rate: int) -> None:
    bench = Bench(2)
    strange, other = bench.nodes
    strange.port.set_bitrate(rate)
    strange.port.send(FRAME)
    bench.run(150_000)
    assert other.got == []
    assert strange.sent == []
    assert bench.segment.errors > 0
    assert ErrorState.PASSIVE in [state for node in bench.nodes for _, state in node.states]


def test_babbling_starves_the_lower_priorities_and_load_is_full() -> None:
    bench = Bench(3)
    babbler, sender, other = bench.nodes
    babble = Frame(0x000, bytes(8))
    babbler.port.on_sent = lambda _frame, _at: babbler.port.send(babble)
    bench.segment.handled()
    babbler.port.send(babble)
    bench.run(300)
    sender.port.send(FRAME)
    bench.run(50_000)
    assert {frame.can_id for _, frame in other.got} == {0x000}
    assert sender.port.pending == 1
    assert bench.segment.load_percent(Instant(0), Instant(49_000_000)) == pytest.approx(100.0, abs=0.5)
    babbler.port.on_sent = None
    bench.run(51_000)
    assert sender.port.pending == 0


def test_a_passive_sender_waits_eight_bits_longer_and_lets_others_go_first() -> None:
    bench = Bench(3)
    passive, other, _ = bench.nodes
    bench.disturb(crc_delimiter(FRAME), 17)
    passive.port.send(FRAME)
    bench.run()
    assert passive.port.error_state is ErrorState.PASSIVE
    first = len(bench.nodes[2].got)
    begun = 100_000_000
    for _ in range(2):
        passive.port.send(FRAME)
    bench.timeline.post(Instant(begun), lambda _now: other.port.send(Frame(0x7FF)))
    bench.run(101_000)
    ends = [(at - begun) // BIT_NS for at, _ in bench.nodes[2].got[first:]]
    assert [frame.can_id for _, frame in bench.nodes[2].got[first:]] == [0x181, 0x7FF, 0x181]
    assert ends == [
        length(FRAME),
        length(FRAME) + INTERMISSION + length(Frame(0x7FF)),
        2 * length(FRAME) + 2 * INTERMISSION + length(Frame(0x7FF)),
    ]
