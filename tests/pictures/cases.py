"""What is drawn, and what has to be seen in it."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from servobench.hil.verdict.metrics import VerdictLimits
from servobench.hil.verdict.verdict import VerdictKind
from servobench.virtual_bus.faults.register import TABLES
from tests.pictures import made

SPEED_LINES: Final = ("speed", "error", "torque", "delay")
_HIDDEN: Final = ("error", "torque", "delay")
"""A position is hidden by its reference."""
_QUIET: Final[Mapping[str, Any]] = {"faults": {}}
_PASSED: Final = {"fault": False, "red": False, "good": True, "limit": True, "gap": False}
"""Of a run without faults; the torque comes to the limit of its command."""
_RAMP: Final = {"kind": "ramp", "at_s": 0.2, "over_s": 0.5, "speed_rpm": 1500.0}
_NO_LIMIT: Final = {**_QUIET, "verdict": {}, "reference.axis1": [_RAMP]}
"""The same with nothing to be held against, nor near its limits."""
_UNASKED: Final = {"fault": False, "red": False, "limit": False}


@dataclass(frozen=True)
class Case:
    """One recording."""

    name: str
    make: made.Make
    lines: tuple[str, ...] = SPEED_LINES
    """Curves that go through the whole page that it opens with."""
    seen: Mapping[str, bool] = field(default_factory=dict)
    """On that page; see :func:`tests.pictures.pixels.complaints`."""
    pages: bool = False
    """All its pages are drawn, not only the one that it opens with."""
    window: bool = False
    """A window of it is looked into: see :mod:`tests.pictures.window`."""
    sizes: bool = False
    """The page that it opens with is drawn for a small screen and a large one, too."""
    light: bool = False
    """The page that it opens with is drawn on light ground, too, if there is a browser."""


def faults_of(kind: str) -> Mapping[str, Any]:
    """One fault of a kind, which a run of two seconds sees."""
    return {"faults": {kind: [FAULTS[kind]]}}


FAULTS: Final[Mapping[str, Mapping[str, Any]]] = {
    "loss": {"probability": 0.02},
    "burst": {"p_good_to_bad": 0.004, "p_bad_to_good": 0.2},
    "periodic_loss": {"lost": 1, "from_s": 0.5, "until_s": 1.5},
    "blackout": {"from_s": 0.7, "duration_s": 0.02},
    "delay": {"direction": "drive_to_host", "delay_min_us": 0, "delay_max_us": 600, "from_s": 0.5},
    "measured_delay": {"edges_us": [80, 120, 400], "counts": [90, 10]},
    "reorder": {"probability": 0.02, "held_us": 1200},
    "duplicate": {"probability": 0.02, "later_us": 40},
    "corruption": {"probability": 0.02},
    "silence": {"at_s": 0.6, "duration_s": 0.03},
    "bus_off": {"at_s": 0.8, "recover_after_s": 0.5},
    "drive_fault": {"fault": "over_temperature", "at_s": 1.5},
    "safe_torque_off": {"at_s": 0.7, "duration_s": 0.2},
    "clock_step": {"at_s": 1.0, "step_us": -350},
    "clock_drift": {"drift_ppm": 80, "from_s": 0.4, "until_s": 1.4},
    "slow_drive": {"tpdo_delay_us": 120},
    "lss_yes_sayer": {},
    "host_stall": {"at_s": 1.5, "late_us": 3400},
    "full_queue": {"at_s": 0.6, "duration_s": 0.02},
    "link_down": {"at_s": 0.8, "duration_s": 0.015},
    "receive_overflow": {"at_s": 1.0, "duration_s": 0.004},
    "signal": {"object": "velocity_actual_value", "how": "noise", "noise_raw_rms": 3000, "from_s": 0.5},
    "mode_change": {"at_s": 1.2, "mode": "pv", "duration_s": 0.1},
    "ignored_commands": {"at_s": 1.2, "duration_s": 0.1, "holds": "last"},
    "refused_mapping": {"mapped": "6074"},
    "supply_sag": {"at_s": 0.8, "duration_s": 0.1, "to_percent": 40.0},
    "chopper_off": {"at_s": 0.8, "duration_s": 0.5},
    "dragging_brake": {"at_s": 0.8, "duration_s": 0.5, "torque_nm": 0.2},
    "loose_coupling": {"at_s": 0.8, "duration_s": 0.5, "stiffness_percent": 50.0},
    "dirty_encoder": {"at_s": 0.8, "duration_s": 0.1, "from_deg": 10.0, "to_deg": 10.5},
    "hot_motor": {"at_s": 0.8, "duration_s": 0.5, "winding_c": 140.0, "magnet_c": 110.0},
    "repeated_emergency": {"at_s": 0.8, "code": 0x2310, "period_ms": 10, "duration_s": 0.2},
}
"""By kind; one for every kind that there is."""
_ENDED_BY: Final = {
    "bus_off": VerdictKind.PEER_FAULT,
    "drive_fault": VerdictKind.PEER_FAULT,
    "safe_torque_off": VerdictKind.PEER_FAULT,
    "mode_change": VerdictKind.PEER_FAULT,
    "ignored_commands": VerdictKind.PEER_FAULT,
    "repeated_emergency": VerdictKind.PEER_FAULT,
    "periodic_loss": VerdictKind.NOT_PASSED,
}
_GAPS: Final = ("blackout", "full_queue")
"""Faults of 20 ms without readings: no curve of what was read crosses them."""
_WINDOWS: Final = ("blackout", "loss")
_BROKEN: Final[Mapping[str, tuple[str, float, Mapping[str, Any]]]] = {
    "speed_error_peak_percent_max": ("ling2012", 2.0, {}),
    "after_load_percent_max": ("ling2012", 2.0, {}),
    "speed_error_rms_rad_s_max": ("ling2012", 0.2, {}),
    "dropouts_percent_max": ("ling2012", 1.0, faults_of("loss")),
    "delay_p99_us_max": ("ling2012", 100.0, {}),
    "bus_load_percent_max": ("ling2012", 20.0, {}),
    "missed_percent_max": ("ling2012", 0.0, faults_of("host_stall")),
    "lateness_us_max": ("ling2012", 100.0, faults_of("host_stall")),
    "torque_rms_nm_max": ("ling2012", 0.001, {}),
    "settling_time_ms_max": ("ling2012", 20.0, {}),
    "overshoot_percent_max": ("ling2012", 1.0, {}),
    "recovery_time_ms_max": ("ling2012", 5.0, {}),
    "losses_in_a_row_max": ("ling2012", 5, faults_of("blackout")),
    "position_error_peak_rad_max": ("position_csp", 0.002, {}),
    "position_error_rms_rad_max": ("position_csp", 0.0001, {}),
    "following_error_peak_rad_max": ("position_csp", 0.0001, {}),
}
"""By limit: the example, a limit that it does not keep, and what is changed besides."""
_STOPPED: Final[Mapping[str, Mapping[str, Any]]] = {
    "speed_max_rpm": {"drive.axis1.limits.speed_max_rpm": 1650.0, "load.axis1.0.torque_nm": -4.9},
    "dropouts_consecutive_max": {
        "drive.axis1.limits.dropouts_consecutive_max": 10,
        **faults_of("blackout"),
    },
}
"""Safety limits that end a run."""


def cases() -> Iterator[Case]:
    """All, those of most use first."""
    yield Case("no-fault", made.run("ling2012.toml", _QUIET), seen=_PASSED, sizes=True, light=True)
    yield Case("no-limit", made.run("ling2012.toml", _NO_LIMIT, VerdictKind.NOTHING_ASKED), seen=_UNASKED)
    for seconds in (2, 59, 61):
        lasts = {"bench.duration_s": float(seconds)}
        opened = made.run("ling2012.toml", lasts)
        yield Case(f"passed-{seconds}s", opened, seen={"fault": True}, pages=True, sizes=seconds == 2)
    yield Case(
        "three-axes",
        made.run("three_axes.toml", {}),
        ("speed", "torque", "error"),
        pages=True,
        sizes=True,
        light=True,
    )
    yield Case("position", made.run("position_csp.toml", {}), _HIDDEN, pages=True)
    yield Case("own-controller", made.run("own_controller/mpc.toml", {}), pages=True)
    yield Case("interrupted", made.interrupted, seen={"red": True})
    yield Case("killed", made.killed, seen={"red": True})
    yield Case("live", made.live, pages=True)
    yield Case("commissioning", made.commissioning, ())
    yield Case("comparison", made.comparison, ("speed", "torque"), pages=True)
    yield Case("campaign", made.campaign, (), pages=True)
    blackout = made.run("blackout.toml", {}, VerdictKind.NOT_PASSED)
    yield Case("blackout", blackout, (), {"red": True, "fault": True, "gap": True}, light=True)
    for kind in TABLES:
        ends = _ENDED_BY.get(kind, VerdictKind.PASSED)
        seen = {"fault": True, **({"gap": True} if kind in _GAPS else {})}
        opened = made.run("ling2012.toml", faults_of(kind), ends)
        yield Case(f"fault-{kind}", opened, (), seen, window=kind in _WINDOWS)
    for limit in VerdictLimits.__dataclass_fields__:
        if limit == "compute_us_max":
            continue  # judged in real time alone
        if limit not in _BROKEN:
            raise LookupError(f"{limit}: write into _BROKEN an example that breaks it")
        example, most, changes = _BROKEN[limit]
        changed = {**_QUIET, **changes, f"verdict.{limit}": most}
        yield Case(
            f"broken-{limit.removesuffix('_max')}",
            made.run(f"{example}.toml", changed, VerdictKind.NOT_PASSED),
            _HIDDEN if example == "position_csp" else SPEED_LINES,
            seen={"red": True},
        )
    for limit, changes in _STOPPED.items():
        changed = {**_QUIET, **changes}
        yield Case(
            f"stopped-{limit.removesuffix('_max')}",
            made.run("ling2012.toml", changed, VerdictKind.PEER_FAULT),
            (),
            seen={"red": True},
        )
