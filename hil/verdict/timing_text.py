"""What a run's timing rests on, in lines for a reader; from the ``timing`` of its summary."""

from collections.abc import Mapping
from typing import Any

_SYNC_TEXTS = {
    "none": "no echo: the instant is that of its hand-over",
    "receipt": "by its echo, stamped when this process had it",
    "kernel": "by its echo, stamped by the kernel",
    "hardware": "by its echo, stamped by the adapter",
    "bus": "by its echo, stamped by the bus",
}
"""By :class:`drivers.wire.frame_port.EchoBasis`."""
_SYNC_COUNTS = {"surplus": "of others", "crowded": "closer than half a period"}
_AXIS_COUNTS = {
    "uncertain": "uncertain",
    "duplicates": "came twice",
    "unmatched": "answer no SYNC",
    "commands_unexplained": "demands of no command",
}


def timing_lines(timing: Mapping[str, Any] | None) -> dict[str, str]:
    """By title: a line for the SYNC of each segment and one for each axis; empty for a run without them."""
    if timing is None:
        return {}
    segments, axes = timing["sync"], timing["axes"]
    lines = {_title("SYNC", name, segments): _sync_line(told) for name, told in segments.items()}
    return lines | {_title("Timing", name, axes): _axis_line(told) for name, told in axes.items()}


def _title(word: str, name: str, among: Mapping[str, Any]) -> str:
    """The name is told where there are several."""
    return word if len(among) == 1 else f"{word} of {name}"


def _sync_line(told: Mapping[str, Any]) -> str:
    return ", ".join([_SYNC_TEXTS[told["basis"]], *_counts(told, _SYNC_COUNTS)])


def _axis_line(told: Mapping[str, Any]) -> str:
    """Accuracy of its samples, clock, and what was not plain."""
    clock = told.get("clock")
    error_us = told["error_us_max"]
    bound = f"{error_us:.0f}" if error_us >= 100 else f"{error_us:.3g}"
    parts = [f"sampled +-{bound} us" if told["placed"] else "no reading placed"]
    if told["by_order"]:
        parts.append("placed by order")
    if clock is not None:
        parts.append(f"clock {clock['drift_ppm']:+.1f} ppm")
    if steps := told["clock_steps"]:
        parts.append(f"set {'once' if steps == 1 else f'{steps} times'}")
    return ", ".join(parts + _counts(told, _AXIS_COUNTS))


def _counts(told: Mapping[str, Any], words: Mapping[str, str]) -> list[str]:
    """Those that are not 0."""
    return [f"{told[key]} {text}" for key, text in words.items() if told[key]]
