"""A run in words, for the terminal, the page beside its plots and its report: figures, limits, timing and
certificates."""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Final

from servobench.drivers.timebase import NS_PER_S
from servobench.hil.verdict.figures import Figures, Percentiles
from servobench.hil.verdict.metrics import metric_title
from servobench.hil.verdict.summary import Summary
from servobench.hil.verdict.verdict import Check

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


def number(value: float | None, none: str = "-") -> str:
    """Format four significant digits, whole numbers in full; ``none`` for an unmeasured value."""
    if value is None:
        return none
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.4g}"


def figure_lines(run: Figures | Summary, axes: int) -> dict[str, str]:
    """Return by title a line for each figure from the rows of ``axes`` axes.

    Position error, step response and recovery have one where they were measured.
    """
    return {
        **dict(_error_lines(run)),
        "Torque": "never steady for long enough to be judged"
        if run.torque_rms_nm is None
        else f"{number(run.torque_rms_nm)} N m rms about its mean in steady state",
        "Reading delay": _percentiles(run.reading_delay_us),
        "Action delay": _percentiles(run.action_delay_us),
        "Lateness": _percentiles(run.lateness_us),
        "Computing": _percentiles(run.compute_us),
        "Dropouts": _dropout_text(run, axes),
        "Lost in a row": _loss_text(run),
    }


def summary_lines(run: Summary, axes: int) -> dict[str, str]:
    """Return :func:`figure_lines`, then what is known of a run that has ended."""
    return {
        **figure_lines(run, axes),
        **timing_lines(run.timing),
        **({"Load machine": _load_machine_text(run.load_machine)} if run.load_machine else {}),
        "Bus load": _measured(run.bus_load_percent, "%"),
        "Pace": _measured(run.realtime_factor, "times real time"),
        "Digest": run.digest,
    }


def limit_rows(checks: Iterable[Check]) -> Iterator[tuple[str, str, str, str, str]]:
    """Yield each requirement in words: title, value, limit, result, and the place of the worst value."""
    for check in checks:
        at = "" if check.at_ns is None else f"at {check.at_ns / NS_PER_S:.3f} s"
        where = " ".join(filter(None, (check.axis, at)))
        yield metric_title(check.metric), number(check.value), f"{check.limit:g}", check.result.value, where


def _error_lines(run: Figures | Summary) -> Iterator[tuple[str, str]]:
    speed, position, steps = run.speed_error, run.position_error, run.step_response
    yield (
        "Tracking error",
        f"peak {number(speed.peak_rad_s)} rad/s ({number(speed.peak_percent)} %), "
        f"rms {number(speed.rms_rad_s)} rad/s",
    )
    yield "After load step", _measured(speed.after_load_percent, "% at most")
    if position.peak_rad is not None:
        yield (
            "Position error",
            f"peak {number(position.peak_rad)} rad, rms {number(position.rms_rad)} rad, "
            f"following {number(position.following_peak_rad)} rad",
        )
    if steps.overshoot_percent is not None:
        settled = (
            "not settled"
            if steps.settling_time_ms is None
            else f"settled after {number(steps.settling_time_ms)} ms"
        )
        yield "Step response", f"{settled}, overshoot {number(steps.overshoot_percent)} %"
    if steps.recovery_time_ms is not None:
        yield "Recovery", f"{number(steps.recovery_time_ms)} ms after a load step"


def _measured(value: float | None, unit: str) -> str:
    return "not measured" if value is None else f"{number(value)} {unit}"


def _percentiles(of: Percentiles) -> str:
    return f"p50 {number(of.p50)} us, p99 {number(of.p99)} us, max {number(of.max)} us"


def _dropout_text(run: Figures | Summary, axes: int) -> str:
    lost, rows = run.dropouts, run.cycles * axes
    share = f" ({100.0 * lost.total / rows:.2f} %)" if rows else ""
    return (
        f"{lost.total}{share}: {lost.lost} lost, {lost.late} late, {lost.stale} stale, {lost.missed} missed"
    )


def _load_machine_text(machine: Mapping[str, Any]) -> str:
    steps = [
        f"{step['asked_nm']:g} N m asked, {number(step['measured_nm'])} measured" for step in machine["steps"]
    ]
    counts = f"{machine['readings']} readings, {machine['late']} late, {machine['spoilt']} spoilt"
    return f"{machine['identity']}: {'; '.join([*steps, counts])}"


def _loss_text(run: Figures | Summary) -> str:
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
        text = number(seen, "not known")
        if most not in (seen, None):
            text += f" to {number(most)}"
        yield words, number(figures[name]["certified"], "not known"), text


def _current_loop(figures: Mapping[str, Any]) -> tuple[str, str, str] | None:
    """Return the same for the drive's current loop; None: there is no certificate for it."""
    loop = figures["current_bandwidth_hz"]
    if loop["certified"] is None:
        return None
    least, most = map(number, loop["certified"])
    return (
        "current loop [Hz]",
        least if least == most else f"{least} to {most}",
        number(loop["drive"], "not known"),
    )
