"""What a bus has to carry: the frames of a cycle, other nodes' frames, and what a drive tells beside them."""

import math
from typing import Any

import pytest

from tests.unit.hil.test_bench_contradictions import ONE, SEGMENTS, Said, changed, said_of


def stuffed_bits(data_bytes: int) -> int:
    """[ISO 11898-1]: 47 bits, those of the data, a stuff bit for the first five and each four after."""
    return 47 + 8 * data_bytes + (34 + 8 * data_bytes - 1) // 4


def test_a_cycle_has_room_for_the_longest_frames_of_its_segment_alone() -> None:
    """SYNC, the command, and the three PDOs of a drive that is asked for the position with every SYNC."""
    raw = {"loop.period_us": 500, "loop.decide_after_us": 400, "loop.deadline_us": 1000}
    ((key, value, expected, remedy),) = said_of(SEGMENTS, raw)
    assert (key, value) == ("loop.period_us", 500)
    least_us = int(expected.split()[2].rstrip(","))
    assert expected == f"at least {least_us}, which 1 drive(s) may take at 500000 bit/s"
    assert remedy == (
        "raise loop.period_us or bus.segment[0].bitrate_bit_s, or set loop.position_every_cycles = 10"
    )
    changed(SEGMENTS, raw | {"loop.period_us": least_us}).config  # noqa: B018 - is accepted
    said = said_of(SEGMENTS, raw | {"loop.period_us": least_us - 1})
    assert said == [("loop.period_us", least_us - 1, expected, remedy)]
    # two PDOs of 8 bytes and the command with each SYNC; a statusword each 25 ms
    bits = stuffed_bits(0) + stuffed_bits(4) + 2 * stuffed_bits(8) + stuffed_bits(2) * least_us / 25_000
    assert least_us == math.ceil(2.0 * bits), "2 us each"


def test_a_position_that_comes_seldom_is_not_advised_again() -> None:
    raw = {
        "loop.period_us": 400,
        "loop.decide_after_us": 300,
        "loop.deadline_us": 1000,
        "loop.position_every_cycles": 2,
    }
    ((key, _, _, remedy),) = said_of(SEGMENTS, raw)
    assert (key, remedy) == ("loop.period_us", "raise loop.period_us or bus.segment[0].bitrate_bit_s")


def background(can_id: int, **more: Any) -> dict[str, Any]:
    return {"can_id": can_id, "period_us": 1000, **more}


NOT_OURS = "an identifier that CiA 301 gives neither to the whole network nor to a node of the bench"
A_PLAIN_SYNC = "0: a SYNC without counter"


@pytest.mark.parametrize(
    ("entry", "more", "said"),
    [
        (background(0x181), {}, ("can_id", "0x181", NOT_OURS, "")),
        (background(0x77F), {}, ("can_id", "0x77F", NOT_OURS, "")),
        (background(0x081), {}, ("can_id", "0x81", NOT_OURS, "")),
        (background(0x080), {}, ("can_id", "0x80", NOT_OURS, "")),
        (background(0x000), {}, ("can_id", "0x0", NOT_OURS, "")),
        (background(0x182), {}, None),
        (background(0x001), {}, None),
        (background(0x181, extended=True), {}, None),
        (background(0x080, extended=True), {"loop.sync": "foreign"}, None),
        (background(0x080, bytes_max=0), {"loop.sync": "foreign"}, None),
        (background(0x080, bytes_max=1), {"loop.sync": "foreign"}, ("bytes_max", 1, A_PLAIN_SYNC, "")),
        (
            background(0x080, bytes_max=0, remote=True),
            {"loop.sync": "foreign"},
            ("bytes_max", 0, A_PLAIN_SYNC, ""),
        ),
        (background(0x181), {"loop.sync": "foreign"}, ("can_id", "0x181", NOT_OURS, "")),
    ],
)
def test_other_nodes_send_nothing_that_is_taken_for_the_benchs(
    entry: dict[str, Any], more: dict[str, Any], said: Said | None
) -> None:
    """The bench is node 127, its drive node 1."""
    traffic = [background(0x3A2), entry]
    if said is None:
        assert changed(ONE, {"bus.background": traffic, **more}).config.axes
        return
    key, value, expected, remedy = said
    assert said_of(ONE, {"bus.background": traffic, **more}) == [
        (f"bus.background[1].{key}", value, expected, remedy)
    ]


def test_traffic_of_another_segment_is_named_with_it() -> None:
    """Node ids are those of the whole bench: who looks for a frame does not ask where it is from."""
    said = said_of(SEGMENTS, {"bus.segment.0.background": [background(0x3A5), background(0x201)]})
    assert said == [("bus.segment[0].background[1].can_id", "0x201", NOT_OURS, "")]


def test_what_is_observed_fits_into_the_pdos_that_the_loop_leaves() -> None:
    """Nine objects of four bytes: two of them a PDO, and the loop needs three of the eight."""
    observed = [{"object": f"2{place:03X}", "type": "uint32"} for place in range(1, 20)]
    ((key, value, expected, remedy),) = said_of(ONE, {"drive.axis1.observe": observed})
    assert (key, value) == ("drive.axis1.observe", "19 objects of 76 bytes")
    left = int(expected.split(", ")[1].split()[0])
    assert expected == f"what the TPDOs that the loop leaves can carry, {left} of 4, 8 bytes each"
    assert remedy == ""
    assert changed(ONE, {"drive.axis1.observe": observed[: 2 * left]}).config.axes
    assert said_of(ONE, {"drive.axis1.observe": observed[: 2 * left + 1]})[0][0] == "drive.axis1.observe"
