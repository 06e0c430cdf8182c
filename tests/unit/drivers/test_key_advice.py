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
