"""Bench files: what a run is held against, and how long the frames of a cycle may be."""

from pathlib import Path

import pytest

from servobench.drivers.canopen.pdo_budget import frame_bits_max
from servobench.hil.configuration.bench_file import load_bench
from servobench.virtual_bus.bus.frame_image import INTERMISSION_BITS, frame_bits
from servobench.virtual_bus.frame import Frame

EXAMPLES = Path(__file__).parents[3] / "examples"
STUFFING_NOT_REACHED_BITS = 5
"""The fields between identifier and data do not take the pattern that would add most bits."""


def test_the_settling_time_of_the_verdict_is_no_limit_of_it(tmp_path: Path) -> None:
    text = (EXAMPLES / "any_bus.toml").read_text().replace('"motors/', f'"{EXAMPLES}/motors/')
    path = tmp_path / "bench.toml"
    path.write_text(text)
    assert load_bench(path).verdict.settling == 250_000_000
    path.write_text(text.replace("[verdict]", "[verdict]\nsettling_ms = 40"))
    verdict = load_bench(path).verdict
    assert verdict.settling == 40_000_000
    assert verdict.limits.speed_error_peak_percent_max == 15.0


@pytest.mark.parametrize("length", range(9))
def test_no_frame_is_longer_than_the_longest_counted(length: int) -> None:
    patterns = [bytes([byte] * length) for byte in (0x00, 0x0F, 0x1E, 0x3C, 0x78, 0xF0, 0xE1, 0xC3, 0x87)]
    longest = max(
        frame_bits(Frame(can_id, data)) + INTERMISSION_BITS
        for can_id in range(0, 0x780, 7)
        for data in patterns
    )
    most = frame_bits_max(length)
    assert most - STUFFING_NOT_REACHED_BITS <= longest <= most
