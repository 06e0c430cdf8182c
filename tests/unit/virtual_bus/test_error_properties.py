"""What holds on a segment whatever disturbs it."""

import random

from hypothesis import given
from hypothesis import strategies as st

from servobench.drivers.record import values_of
from servobench.drivers.timebase import Instant
from servobench.virtual_bus.bus.controller import ErrorState
from servobench.virtual_bus.bus.disturbance import Disturbance
from servobench.virtual_bus.frame import Frame
from tests.draws import examples_of
from tests.unit.virtual_bus.can_reference import random_frame
from tests.unit.virtual_bus.error_bench import Bench, length

EXAMPLES = examples_of(100)


@EXAMPLES
@given(st.lists(st.tuples(st.integers(0, 500), st.integers(0, 3), st.integers(0, 1 << 16)), max_size=20))
def test_handled_and_unhandled_segments_do_the_same_while_nothing_is_wrong(
    plan: list[tuple[int, int, int]],
) -> None:
    seen = []
    for handled in (False, True):
        bench = Bench(4)
        if handled:
            bench.segment.set_disturb(lambda _sender, _frame, _at: None)
        for when_us, port, seed in plan:
            frame = random_frame(random.Random(seed))
            bench.send_at(when_us, port, frame)
        bench.run()
        seen.append(([node.got for node in bench.nodes], bench.segment.busy_ns, bench.segment.frames))
    assert seen[0] == seen[1]


@EXAMPLES
@given(
    st.lists(st.tuples(st.integers(0, 4_000), st.integers(0, 3)), min_size=1, max_size=25),
    st.integers(0, 1 << 32),
    st.floats(0.0, 0.4),
    st.booleans(),
)
def test_each_frame_reaches_each_healthy_receiver_exactly_once(
    plan: list[tuple[int, int]], seed: int, probability: float, everybody: bool
) -> None:
    """Disturbed up to the ACK delimiter: a wrong level in the last two bits of a frame can double it."""
    bench = Bench(4)
    source = random.Random(seed)
    counters: list[tuple[int, int, ErrorState]] = []

    def judge(_sender: str, frame: Frame, _at: Instant) -> Disturbance | None:
        counters.extend(
            (node.port.controller.transmit_errors, node.port.controller.receive_errors, node.port.error_state)
            for node in bench.nodes
        )
        if source.random() >= probability:
            return None
        victims = None if everybody else tuple(source.sample("abcd", source.randint(1, 3)))
        return Disturbance(source.randrange(length(frame) - 8), victims)

    bench.segment.set_disturb(judge)
    sent = []
    for number, (when_us, port) in enumerate(plan):
        frame = Frame(0x100 + number, source.randbytes(source.randint(0, 8)))
        sent.append((port, frame))
        bench.send_at(when_us, port, frame)
    bench.run(200_000)
    for transmit, receive, state in counters:
        assert 0 <= transmit < 256
        assert 0 <= receive <= 255
        assert (state is ErrorState.PASSIVE) == (transmit >= 128 or receive >= 128)
    if any(state is ErrorState.BUS_OFF for node in bench.nodes for _, state in node.states):
        return
    if any(node.states for node in bench.nodes):
        return  # a passive receiver cannot ask for a repetition
    for number, node in enumerate(bench.nodes):
        expected = sorted((frame for port, frame in sent if port != number), key=values_of)
        assert sorted((frame for _, frame in node.got), key=values_of) == expected
        assert len(node.sent) == sum(port == number for port, _ in sent)
