"""A frame as levels on the wire, against the same frame written field by field."""

import random

import pytest

from servobench.virtual_bus.bus.frame_image import frame_image, resampled
from servobench.virtual_bus.frame import Frame
from tests.unit.virtual_bus.can_reference import crc_sequence, random_frame, stuff, unstuffed_fields

FRAMES = [random_frame(random.Random(seed)) for seed in range(300)]


def test_levels_fields_and_stuff_bits_are_those_of_iso_11898() -> None:
    for frame in FRAMES:
        image = frame_image(frame)
        fields = unstuffed_fields(frame)
        stuffed = stuff(fields + crc_sequence(fields))
        # CRC delimiter, acknowledge as its sender leaves it, its delimiter, end of frame
        assert "".join(map(str, image.levels)) == stuffed + "1" + "1" + "1" + "1" * 7
        assert image.delimiter == len(stuffed)
        assert image.acknowledge == len(stuffed) + 1
        assert image.last == len(stuffed) + 9
        kept = [level for place, level in enumerate(stuffed) if place not in image.stuff_bits]
        assert "".join(kept) == fields + crc_sequence(fields)
        # identifier and RTR are contested; of 29 bits SRR and IDE, too
        arbitration = fields[: 33 if frame.extended else 13]
        assert image.arbitration_end == len(stuff(arbitration))


@pytest.mark.parametrize("rate", [0.5, 0.8, 1.0, 1.25, 2.0])
def test_at_another_bit_rate_a_node_sees_what_is_there_at_its_sample_points(rate: float) -> None:
    image = frame_image(Frame(0x123, b"\x55\x00"))
    seen = resampled(image, rate)
    assert len(seen.levels) == int(len(image.levels) / rate)
    for bit, level in enumerate(seen.levels):
        assert level == image.levels[min(int((bit + 0.8) * rate), image.last)]
    assert (seen.stuff_bits, seen.delimiter) == (frozenset(), -1)
    assert seen.arbitration_end == int(image.arbitration_end / rate)
