"""The certificates of a run's controllers beside what was seen, in lines for a reader."""

from collections.abc import Mapping
from typing import Any, Final

_WORDS: Final = {
    "delay_us": "delay [us]",
    "losses_in_a_row": "losses in a row",
    "gain_rad_s_nm": "gain [rad/s per N m]",
}


def certificate_lines(certificates: Mapping[str, Any] | None) -> dict[str, str]:
    """By title a line for each axis; empty for a run without certified controllers.

    ``certificates``: figures of :class:`hil.reviewing.certificate_meter.CertificateMeter` by axis.
    """
    return {
        "Certificate" if len(certificates or {}) == 1 else f"Certificate of {axis}": _line(figures)
        for axis, figures in (certificates or {}).items()
    }


def _line(figures: Mapping[str, Any]) -> str:
    parts = [f"{words} {_pair(figures[name])}" for name, words in _WORDS.items()]
    loop = figures["current_bandwidth_hz"]
    if loop["certified"] is not None:
        least, most = map(_number, loop["certified"])
        covered = least if least == most else f"{least} to {most}"
        parts.append(f"current loop [Hz] {covered}, the drive's {_number(loop['drive'])}")
    return "; ".join(parts)


def _pair(found: Mapping[str, float | None]) -> str:
    seen, most = found["seen"], found.get("seen_at_most")
    text = f"{_number(found['certified'])}, seen {_number(seen)}"
    return text if most == seen else f"{text} to {_number(most)}" if most is not None else text


def _number(value: float | None) -> str:
    return "not known" if value is None else f"{value:.4g}"
