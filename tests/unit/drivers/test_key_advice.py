"""What is said of a key that nobody knows."""

import math

import pytest

from servobench.drivers.key_advice import converted, nearest, same_quantity, split_unit, unknown_key

KNOWN = ("delay_us", "probability", "from_s", "speed_max_rpm")


@pytest.mark.parametrize(
    ("key", "value", "meant", "remedy"),
    [
        ("delay_ms", 0.3, "delay_us", "write delay_us = 300"),
        ("delay", 3, "delay_us", "write delay_us and give the value in that unit"),
        ("speed_max_rad_s", 10.0, "speed_max_rpm", "write speed_max_rpm = 95.4929659"),
        ("loss_percent", 2, "probability", "write probability = 0.02"),
        ("loss_percent", "two", "probability", "write probability"),
        ("probabilty", 0.1, "probability", "known here: delay_us, probability, from_s, speed_max_rpm"),
        ("zzz", 1, None, "known here: delay_us, probability, from_s, speed_max_rpm"),
    ],
)
def test_an_unknown_key_is_answered_with_what_was_meant(
    key: str, value: object, meant: str | None, remedy: str
) -> None:
    error = unknown_key("file.toml", f"table[0].{key}", value, KNOWN)
    assert (error.source, error.key, error.value) == ("file.toml", f"table[0].{key}", value)
    assert error.meant == meant
    assert error.remedy == remedy
    assert (meant or "no such key") in error.expected


@pytest.mark.parametrize(
    ("key", "value", "remedy"),
    [
        ("frequency_hz", 1000, "write period_us = 1000"),
        ("rate_khz", 0.5, "write period_us = 2000"),
        ("frequency_hz", 0, "known here: period_us"),
        ("frequency_hz", True, "known here: period_us"),
        ("frequency_hz", "1 kHz", "known here: period_us"),
        ("angle_rad", 1, "known here: period_us"),
    ],
)
def test_a_frequency_is_told_as_the_period_that_it_means(key: str, value: object, remedy: str) -> None:
    assert unknown_key("file.toml", f"loop.{key}", value, ["period_us"]).remedy == remedy


@pytest.mark.parametrize(
    ("elsewhere", "expected", "remedy"),
    [
        (["loop"], "no such key here", "it stands in [loop]"),
        (["host", "drive.NAME"], "no such key here", "it stands in [host] or [drive.NAME]"),
        (["", "host", "drive.NAME"], "no such key here", "it stands in no table or [host]"),
        (["a", "b", "c", "d"], "no such key", "known here: delay_us, probability, from_s, speed_max_rpm"),
    ],
)
def test_a_key_of_another_table_is_told_with_its_table(
    elsewhere: list[str], expected: str, remedy: str
) -> None:
    error = unknown_key("file.toml", "bench.zzz", 1, KNOWN, elsewhere)
    assert (error.expected, error.remedy, error.meant) == (expected, remedy, None)


def test_units_are_the_last_words_of_a_key() -> None:
    assert split_unit("speed_max_rad_s") == ("speed_max", "rad/s")
    assert same_quantity("delay_ms", KNOWN) == "delay_us"
    assert same_quantity("delay_us", KNOWN) is None
    assert nearest("form_s", KNOWN) == "from_s"
    assert converted(True, "delay_ms", "delay_us") is None
    assert converted(1, "delay_ms", "speed_max_rpm") is None


SI = {
    # of one unit, by the SI brochure and the definitions of r/min and degree
    "time_s": {"time_ms": 1e-3, "time_us": 1e-6, "time_ns": 1e-9},
    "rate_hz": {"rate_khz": 1e3},
    "speed_rad_s": {"speed_rpm": math.tau / 60.0, "speed_deg_s": math.tau / 360.0},
    "torque_nm": {"torque_mnm": 1e-3},
    "current_a": {"current_ma": 1e-3},
    "bus_v": {"bus_kv": 1e3},
    "winding_ohm": {"winding_mohm": 1e-3},
    "winding_h": {"winding_mh": 1e-3, "winding_uh": 1e-6},
    "flux_wb": {"flux_mwb": 1e-3},
    "inertia_kg_m2": {"inertia_g_m2": 1e-3, "inertia_kg_cm2": 1e-4, "inertia_g_cm2": 1e-7},
    "share_ratio": {"share_percent": 1e-2, "share_permille": 1e-3, "share_ppm": 1e-6},
    "bus_bit_s": {"bus_kbit_s": 1e3, "bus_mbit_s": 1e6},
}


@pytest.mark.parametrize("expected", SI)
def test_a_value_is_converted_by_its_unit(expected: str) -> None:
    for given, factor in SI[expected].items():
        assert same_quantity(given, [expected]) == expected
        assert float(str(converted(7, given, expected))) == pytest.approx(7 * factor, rel=1e-8)
        assert float(str(converted(7.0, expected, given))) == pytest.approx(7 / factor, rel=1e-8)
