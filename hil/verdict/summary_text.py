"""A run's timing with its basis, and its certificates with the observations: lines for a reader."""

from collections.abc import Iterator, Mapping
from typing import Any, Final

from servobench.hil.verdict.figures import Figures
from servobench.hil.verdict.summary import Summary

_SYNC_TEXTS = {
    "none": "no echo: the instant is that of its hand-over",
    "receipt": "by its echo, stamped when this process had it",
    "kernel": "by its echo, stamped by the kernel",
    "hardware": "by its echo, stamped by the adapter",
    "bus": "by its echo, stamped by the bus",
}
"""By :class:`servobench.drivers.wire.frame_port.EchoBasis`."""
_SYNC_COUNTS = {"surplus": "of others", "crowded": "closer than half a period"}
_AXIS_COUNTS = {
    "uncertain": "uncertain",
    "duplicates": "came twice",
    "unmatched": "answer no SYNC",
    "commands_unexplained": "demands of no command",
    "readbacks_unordered": "read-backs in no order",
}
_CERTIFIED: Final = {
    "action_delay_us": "delay to actuation [us]",
    "losses_together": "lost in a row, together",
    "gain_rad_s_nm": "gain [rad/s per N m]",
}


def loss_text(run: Figures | Summary) -> str:
    """Format consecutive losses of readings and of commands separately."""
    least, most = run.command_losses_in_a_row_least, run.command_losses_in_a_row
    if most is None:
        return f"{run.reading_losses_in_a_row} readings, commands not measured"
    commands = f"{most}" if least == most else f"{least} to {most}"
    return f"{run.reading_losses_in_a_row} readings, {commands} commands"


def computing_note(run: Summary, period_us: float) -> str | None:
    """Return a note on controllers whose computing time (p99) fills the period: in simulated time the loop
    waits for them."""
    taken = run.compute_us.p99
    if taken is None or taken < period_us:
        return None
    return (
        f"computing takes {taken:.0f} us (p99), the period is {period_us:g} us: "
        "simulated time waits for it, a bus in real time does not"
    )


def timing_lines(timing: Mapping[str, Any] | None) -> dict[str, str]:
    """Return by title a line for the SYNC of each segment and one for each axis; empty for a run without
    them."""
    if timing is None:
        return {}
    segments, axes = timing["sync"], timing["axes"]
    lines = {_title("SYNC", name, segments): _sync_line(told) for name, told in segments.items()}
    return lines | {_title("Timing", name, axes): _axis_line(told) for name, told in axes.items()}


def _title(word: str, name: str, among: Mapping[str, Any]) -> str:
    """Return a title, with the name if there are several."""
    return word if len(among) == 1 else f"{word} of {name}"


def _sync_line(told: Mapping[str, Any]) -> str:
    return ", ".join([_SYNC_TEXTS[told["basis"]], *_counts(told, _SYNC_COUNTS)])


def _axis_line(told: Mapping[str, Any]) -> str:
    """Describe accuracy of its samples, clock, and irregularities."""
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
    """Format counts that are neither 0 nor unknown to the recording's version."""
    return [f"{told[key]} {text}" for key, text in words.items() if told.get(key)]


def certificate_lines(certificates: Mapping[str, Any] | None) -> dict[str, str]:
    """Return by title a line for each axis; empty for a run without certified controllers.

    ``certificates``: figures of :class:`servobench.hil.reviewing.certificate_meter.CertificateMeter` by axis.
    """
    by_axis = certificates or {}
    return {
        _title("Certificate", axis, by_axis): _certificate_line(figures) for axis, figures in by_axis.items()
    }


def _certificate_line(figures: Mapping[str, Any]) -> str:
    parts = [f"{words} {certified}, seen {seen}" for words, certified, seen in _certified(figures)]
    if loop := _current_loop(figures):
        parts.append("{} {}, the drive's {}".format(*loop))
    return "; ".join(parts)


def certificate_rows(certificates: Mapping[str, Any] | None) -> list[tuple[str, str, str]]:
    """Return the certified item, its certified value, and the observed one, as in
    :func:`certificate_lines`."""
    by_axis = certificates or {}
    rows = []
    for axis, figures in by_axis.items():
        of = "" if len(by_axis) == 1 else f"{axis}: "
        rows += [(of + words, certified, seen) for words, certified, seen in _certified(figures)]
        if loop := _current_loop(figures):
            words, covered, drive = loop
            rows.append((of + words, covered, f"{drive} (drive)"))
    return rows


def _certified(figures: Mapping[str, Any]) -> Iterator[tuple[str, str, str]]:
    """Yield the certified item, its certified value, and the observed one."""
    for name, words in _CERTIFIED.items():
        seen, most = figures[name]["seen"], figures[name].get("seen_at_most")
        text = _number(seen) if most in (seen, None) else f"{_number(seen)} to {_number(most)}"
        yield words, _number(figures[name]["certified"]), text


def _current_loop(figures: Mapping[str, Any]) -> tuple[str, str, str] | None:
    """Return the same for the drive's current loop; None: there is no certificate for it."""
    loop = figures["current_bandwidth_hz"]
    if loop["certified"] is None:
        return None
    least, most = map(_number, loop["certified"])
    return "current loop [Hz]", least if least == most else f"{least} to {most}", _number(loop["drive"])


def _number(value: float | None) -> str:
    return "not known" if value is None else f"{value:.4g}"
