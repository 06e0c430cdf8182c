"""Tables of other nodes' traffic: the streams that they become, and what does not fit together."""

from pathlib import Path
from typing import Any

import pytest

from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import NS_PER_US, Duration
from servobench.hil.configuration.config import Background, load_background
from servobench.virtual_bus.device.background import Stream

HOUR_US = 3_600_000_000


@pytest.mark.parametrize(
    ("table", "stream"),
    [
        (
            {"can_id": 0, "period_us": 1},
            Stream(0, Duration(1000), False, False, 8, 8, Duration(0), "periodic"),
        ),
        (
            {"can_id": 0x7FF, "period_us": HOUR_US, "bytes_max": 3},
            Stream(0x7FF, Duration(HOUR_US * NS_PER_US), False, False, 3, 3, Duration(0), "periodic"),
        ),
        (
            {"can_id": 0x80, "period_us": 250, "bytes_min": 2, "bytes_max": 5, "jitter_us": 250},
            Stream(0x80, Duration(250_000), False, False, 2, 5, Duration(250_000), "periodic"),
        ),
        (
            {"can_id": 0x1FFF_FFFF, "extended": True, "remote": True, "period_us": 9, "arrivals": "random"},
            Stream(0x1FFF_FFFF, Duration(9_000), True, True, 8, 8, Duration(0), "random"),
        ),
        (
            {"can_id": 0x10, "extended": True, "period_us": 7, "bytes_min": 0},
            Stream(0x10, Duration(7_000), True, False, 0, 8, Duration(0), "periodic"),
        ),
    ],
)
def test_a_table_is_a_stream(table: dict[str, Any], stream: Stream) -> None:
    assert Background.model_validate(table).stream == stream


def written(folder: Path, table: str) -> Path:
    path = folder / "traffic.toml"
    path.write_text(f"[[background]]\n{table}\n")
    return path


@pytest.mark.parametrize(
    ("table", "key", "found", "expected"),
    [
        ("extended = true\ncan_id = 0x2000_0000", ".can_id", 1 << 29, "a value < 536870912"),
        ("can_id = -1", ".can_id", -1, "a value >= 0"),
        ("can_id = 1\nbytes_max = 9", ".bytes_max", 9, "a value <= 8"),
        ("can_id = 1\nbytes_min = -1", ".bytes_min", -1, "a value >= 0"),
        ("can_id = 1\njitter_us = -1", ".jitter_us", -1, "a value >= 0"),
        (
            "can_id = 0x800",
            "",
            {"can_id": 0x800, "period_us": 500},
            "can_id: 11 bits, at most 0x7FF, or extended = true",
        ),
        (
            "can_id = 1\njitter_us = 501",
            "",
            {"can_id": 1, "jitter_us": 501, "period_us": 500},
            "jitter_us: at most period_us = 500",
        ),
        (
            "can_id = 1\nbytes_min = 4\nbytes_max = 3",
            "",
            "a table of 4 keys",
            "bytes_min: at most bytes_max = 3",
        ),
        (
            'can_id = 1\njitter_us = 1\narrivals = "random"',
            "",
            "a table of 4 keys",
            "jitter_us: none, as random arrivals have their own",
        ),
    ],
)
def test_what_does_not_fit_is_the_only_thing_that_is_refused(
    tmp_path: Path, table: str, key: str, found: object, expected: str
) -> None:
    """And not also that there is no table."""
    path = written(tmp_path, f"{table}\nperiod_us = 500")
    with pytest.raises(BadInput) as caught:
        load_background(path)
    error = caught.value
    assert (error.source, error.key, error.value) == (str(path), f"background[0]{key}", found)
    assert error.expected == expected


@pytest.mark.parametrize(
    ("period_us", "expected"), [(0, "a value >= 1"), (HOUR_US + 1, f"a value <= {HOUR_US}")]
)
def test_a_period_is_a_microsecond_to_an_hour(tmp_path: Path, period_us: int, expected: str) -> None:
    with pytest.raises(BadInput) as caught:
        load_background(written(tmp_path, f"can_id = 1\nperiod_us = {period_us}"))
    assert (caught.value.key, caught.value.expected) == ("background[0].period_us", expected)


def test_a_file_has_at_least_one_table_and_all_of_them_are_read(tmp_path: Path) -> None:
    path = written(tmp_path, "can_id = 1\nperiod_us = 500\n[[background]]\ncan_id = 2\nperiod_us = 600")
    assert [(stream.can_id, stream.period) for stream in load_background(path)] == [
        (1, 500_000),
        (2, 600_000),
    ]
    path.write_text("background = []\n")
    with pytest.raises(BadInput) as caught:
        load_background(path)
    error = caught.value
    assert (error.key, error.value, error.expected) == ("background", [], "at least one table [[background]]")
