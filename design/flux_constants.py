"""The constants that define a motor's flux on data sheets, and their conventions.

A sheet gives p phi (pole pairs times flux linkage, the peak of a phase's back-EMF per mechanical rad/s) in
one of nine ways, which differ by sqrt(2), sqrt(3), 3/2 and pi/3 and are seldom distinguished. For a
sinusoidal back-EMF:

    torque per line current, rms      Kt = 3/sqrt(2) p phi        three phases, current in phase with EMF
    torque per line current, peak     Kt = 3/2 p phi
    torque per DC current, six-step   Kt = 3 sqrt(3)/pi p phi     two phases at a time, mean over 60 degrees
    back-EMF between terminals, rms   Ke = sqrt(3/2) p phi        sqrt(3) times the phase's
"""

import math
from collections.abc import Mapping

from servobench.design.motor import RAD_S_PER_KRPM

AGREEING = 0.12
"""Share by which two figures of one sheet may differ. Makers allow their figures 10 %, and give torque per
ampere for a warm motor and back-EMF for a cold one; most wrong conventions are 28 % apart or more."""

_SIX_STEP = 3.0 * math.sqrt(3.0) / math.pi
"""Mean of three phases' rectified voltage, over the peak of one."""

FLUX_FACTORS: Mapping[str, float] = {
    "kt_nm_arms": 3.0 / math.sqrt(2.0),
    "kt_nm_apk": 1.5,
    "kt_nm_adc": _SIX_STEP,
    "ke_line_vrms_krpm": math.sqrt(1.5) * RAD_S_PER_KRPM,
    "ke_line_vpk_krpm": math.sqrt(3.0) * RAD_S_PER_KRPM,
    "ke_phase_vrms_krpm": math.sqrt(0.5) * RAD_S_PER_KRPM,
    "ke_phase_vpk_krpm": RAD_S_PER_KRPM,
}
"""The sheet's figures for p phi -> figure per p phi in V s. The first one given defines the flux."""
SPEED_FACTORS: Mapping[str, float] = {
    "kv_rpm_vdc": _SIX_STEP * math.pi / 30.0,
    "kv_rpm_vpk": math.sqrt(3.0) * math.pi / 30.0,
}
"""The same for figures that are inverse to p phi: r/min per volt of a six-step drive's DC, and of the peak
between terminals."""
CONVENTIONS = (*FLUX_FACTORS, *SPEED_FACTORS)


def emf_constant(name: str, value: float) -> float:
    """Return p phi in V s from one figure; ``name``: one of ``CONVENTIONS``."""
    if name in SPEED_FACTORS:
        return 1.0 / (SPEED_FACTORS[name] * value)
    return value / FLUX_FACTORS[name]


def figure(name: str, emf_constant_v_s: float) -> float:
    """Invert :func:`emf_constant`."""
    if name in SPEED_FACTORS:
        return 1.0 / (SPEED_FACTORS[name] * emf_constant_v_s)
    return emf_constant_v_s * FLUX_FACTORS[name]


def agree_within(one: float, other: float, within: float) -> bool:
    """Return True if two figures > 0 differ by no more than a share of ``within``."""
    return abs(math.log(one / other)) <= math.log1p(within)


def kind_of(name: str) -> str:
    """Return kt, ke or kv."""
    return name[:2]


def explained(first: str, one: float, second: str, other: float) -> str:
    """Return readings of one of the two that make them agree, best first; each keeps its kind."""
    sides = ((first, one, emf_constant(second, other)), (second, other, emf_constant(first, one)))
    readings = sorted(
        (abs(math.log(emf_constant(reading, value) / fixed)), f"{reading} = {value:g}")
        for name, value, fixed in sides
        for reading in CONVENTIONS
        if reading != name and kind_of(reading) == kind_of(name)
        if agree_within(emf_constant(reading, value), fixed, AGREEING)
    )
    return f"they agree if {' or '.join(text for _, text in readings)} is meant" if readings else ""
