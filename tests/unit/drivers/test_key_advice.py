"""What is said of a key that nobody knows."""

import pytest

from drivers.key_advice import converted, nearest, same_quantity, split_unit, unknown_key

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
