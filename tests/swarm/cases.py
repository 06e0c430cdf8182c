"""A bench and what befalls it, drawn from one number.

The draw of a case depends on its number alone: a failure is repeated by that number.
"""

from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any, Final

from servobench.hil.configuration.bench_file import bench_from
from servobench.hil.configuration.config import BenchConfig

EXAMPLES: Final = Path(__file__).resolve().parents[2] / "examples"
DURATION_S: Final = (0.15, 0.6)
"""Long enough for every kind of fault to strike, and for a drive to stop by itself."""
FAULTS_MAX: Final = 3
FAILURES: Final = ("over_current", "over_temperature", "following_error", "encoder_loss", "under_voltage")
CLASSES: Final = ("pdo", "sync", "nmt", "heartbeat", "sdo", "emcy")
RULES: Final = ("on_mode", "on_foreign", "on_boot", "on_bus_errors")
WAYS: Final = ("both", "host_to_drive", "drive_to_host")
BUS_PART: Final = 0.5
"""Of the faults: those of the bus, of clocks and of hosts. The others are OTHERWISE."""
MODES: Final = ("pp", "vl", "pv", "pt", "hm", "ip", "csp", "csv")
LASTING_S: Final = (0.001, 0.004, 0.02, 0.1)
SIGNALS: Final = (
    "velocity_actual_value",
    "velocity_actual_value",
    "position_actual_value",
    "torque_actual_value",
    "target_torque",
)
BIT_SIGNALS: Final = ("statusword", "modes_of_operation_display", "velocity_actual_value")
AMOUNTS: Final[dict[str, dict[str, tuple[float, ...]]]] = {
    "stuck": {},
    "offset": {"offset_raw": (3, -100, 20_000)},
    "drift": {"drift_raw_per_s": (1000, -100_000)},
    "noise": {"noise_raw_rms": (3, 1000)},
    "scale": {"factor": (0.5, 0.95, 2, 0)},
    "sign": {},
    "bits": {"cleared_bits": (0x1000, 0x0004, 0x0001), "set_bits": (0, 0x0008)},
}
"""By the way in which a signal is wrong."""

Table = dict[str, Any]


def case(number: int) -> BenchConfig:
    """Case ``number``: any number, each another bench."""
    return bench_from(tables(number), f"case {number}", EXAMPLES)


def tables(number: int) -> Table:
    """Of a bench file."""
    draw = Random(number)
    axes = draw.choice((1, 1, 1, 2, 3))
    names = [f"axis{place}" for place in range(1, axes + 1)]
    duration_s = round(draw.uniform(*DURATION_S), 3)
    period_us = 2000 if axes > 1 else draw.choice((1000, 1000, 2000, 1003))
    bench: Table = {
        "bench": {"name": f"swarm-{number}", "duration_s": duration_s, "seed": number},
        "loop": {
            "period_us": period_us,
            "deadline_us": 2 * period_us,
            "actuation": draw.choice(("on_arrival", "on_sync")),
            "position_every_cycles": draw.choice((1, 1, 4)),
            "command_readback": draw.choice(("sync", "sync", "event")),
        },
        "drive": {name: _drive(draw, place) for place, name in enumerate(names)},
        "reference": {name: [_reference(draw)] for name in names},
        "recording": {"on_failure": draw.choice(("stop", "continue"))},
    }
    _sync(draw, bench, period_us)
    if draw.random() < 0.3:
        bench["guard"] = {rule: draw.choice(("tell", "stop")) for rule in RULES}
    if draw.random() < 0.5:
        bench["load"] = {name: [_load(draw, duration_s)] for name in names}
    if draw.random() < 0.7:
        bench["verdict"] = {"dropouts_percent_max": 100, "missed_percent_max": draw.choice((0, 5, 100))}
    if faults := _faults(draw, duration_s):
        bench["faults"] = faults
    return bench


def _sync(draw: Random, bench: Table, period_us: int) -> None:
    """Who makes the SYNC; only the bench itself can on two segments."""
    kind = draw.choice(("own",) * 7 + ("kernel", "foreign", "two segments"))
    if kind in ("kernel", "foreign"):
        bench["loop"]["sync"] = kind
    if kind == "foreign":
        jitter_us = draw.choice((0, 0, 100))
        sync = {"can_id": 0x080, "bytes_max": 0, "period_us": period_us, "jitter_us": jitter_us}
        bench["bus"] = {"background": [sync]}
    elif kind == "two segments" and len(bench["drive"]) > 1:
        bench["bus"] = {"segment": [{"name": "second"}]}
        bench["drive"]["axis2"]["segment"] = "second"


def _drive(draw: Random, place: int) -> Table:
    table: Table = {
        "node": place + 1,
        "motor": "motors/ling2012.toml",
        "controller": {"kind": "pid", "proportional_nm_s_rad": 0.02, "integral_nm_rad": 0.2},
        "limits": {
            "speed_max_rpm": 2500,
            "torque_max_nm": 5,
            "dropouts_consecutive_max": draw.choice((3, 20, 200)),
        },
    }
    simulation: Table = {}
    if draw.random() < 0.3:
        simulation["clock_drift_ppm"] = draw.choice((-1000, -50, 50, 1000))
    if draw.random() < 0.3:
        simulation["lacks"] = draw.sample(("1013", "6074", "1400:5"), k=draw.choice((1, 2)))
    return table | ({"simulation": simulation} if simulation else {})


def _reference(draw: Random) -> Table:
    speed_rpm = draw.choice((0, 100, 1000))
    return draw.choice(
        (
            {"at_s": 0.0, "kind": "step", "speed_rpm": speed_rpm},
            {"at_s": 0.02, "kind": "ramp", "speed_rpm": speed_rpm, "over_s": 0.05},
        )
    )


def _load(draw: Random, duration_s: float) -> Table:
    """A run that is cut short does not come to some of them."""
    return {"at_s": round(draw.uniform(0.0, 0.95) * duration_s, 4), "torque_nm": draw.choice((0.1, 0.3))}


def _faults(draw: Random, duration_s: float) -> Table:
    """Some faults of some kinds; None of them in a quarter of the cases."""
    plan: dict[str, list[Table]] = {}
    for _ in range(draw.choice((0, 1, 2, FAULTS_MAX))):
        of = _KINDS if draw.random() < BUS_PART else OTHERWISE
        kind = draw.choice(sorted(of))
        plan.setdefault(kind, []).append(of[kind](draw, duration_s))
    return plan


def _selected(draw: Random, duration_s: float, table: Table) -> Table:
    table["direction"] = draw.choice(WAYS)
    table["frames"] = sorted(set(draw.choices(CLASSES, weights=(6, 3, 1, 1, 1, 1), k=draw.choice((1, 2)))))
    table["from_s"] = round(draw.uniform(0.0, duration_s), 4)
    if draw.random() < 0.5:
        table["side"] = draw.choice(("host", "drive"))
    return table


def _when(draw: Random, duration_s: float, table: Table) -> Table:
    table["at_s"] = round(draw.uniform(0.0, 1.1) * duration_s, 4)
    return table


def _loss(draw: Random, duration_s: float) -> Table:
    return _selected(draw, duration_s, {"probability": draw.choice((0.02, 0.3, 1.0))})


def _blackout(draw: Random, duration_s: float) -> Table:
    return _selected(draw, duration_s, {"duration_s": draw.choice((0.005, 0.05, 1.0))})


def _delay(draw: Random, duration_s: float) -> Table:
    least = draw.choice((0, 300, 1500))
    most = least + draw.choice((0, 500, 4000))
    return _selected(
        draw,
        duration_s,
        {"delay_min_us": least, "delay_max_us": most, "reorder": draw.random() < 0.5},
    )


def _duplicate(draw: Random, duration_s: float) -> Table:
    return _selected(draw, duration_s, {"probability": 0.1, "later_us": draw.choice((0, 700, 3000))})


def _corruption(draw: Random, duration_s: float) -> Table:
    effect = draw.choice(("error_frame", "lost", "data"))
    table = _selected(draw, duration_s, {"probability": draw.choice((0.01, 0.1)), "effect": effect})
    table.pop("side", None)
    return table


def _silence(draw: Random, duration_s: float) -> Table:
    return _when(draw, duration_s, {"duration_s": draw.choice((0.01, 0.3))})


def _bus_off(draw: Random, duration_s: float) -> Table:
    return _when(draw, duration_s, {"recover_after_s": draw.choice((0.01, 0.3))})


def _drive_fault(draw: Random, duration_s: float) -> Table:
    return _when(draw, duration_s, {"fault": draw.choice(FAILURES)})


def _clock_step(draw: Random, duration_s: float) -> Table:
    return _when(draw, duration_s, {"step_us": draw.choice((-2000, -350, 350, 1_000_000))})


def _host_stall(draw: Random, duration_s: float) -> Table:
    return _when(draw, duration_s, {"late_us": draw.choice((300, 1400, 30_000, 500_000))})


def _mode_change(draw: Random, duration_s: float) -> Table:
    return _for_a_while(draw, duration_s, {"mode": draw.choice(MODES)})


def _ignored_commands(draw: Random, duration_s: float) -> Table:
    table = {"holds": draw.choice(("last", "zero")), "bit_12_cleared": draw.random() < 0.6}
    return _for_a_while(draw, duration_s, table)


def _repeated_emergency(draw: Random, duration_s: float) -> Table:
    table = {"code": draw.choice((0x2310, 0x4310, 0x5000, 0x8611, 0xFF01)), "period_ms": draw.choice((1, 10))}
    return _for_a_while(draw, duration_s, table)


def _refused_mapping(draw: Random, duration_s: float) -> Table:  # noqa: ARG001 - all kinds alike
    where = draw.choice(
        ({"mapped": "6061"}, {"mapped": "6074"}, {"parameter": "1A02:1"}, {"parameter": "1A01:0"})
    )
    return where | {"abort": draw.choice((0x06040041, 0x06040042, 0x08000022))}


def _signal(draw: Random, duration_s: float) -> Table:
    how = draw.choice(sorted(AMOUNTS))
    name = draw.choice(BIT_SIGNALS if how == "bits" else SIGNALS)
    table: Table = {"object": name, "how": how, "probability": draw.choice((1.0, 1.0, 0.1))}
    for key, amounts in AMOUNTS[how].items():
        table[key] = draw.choice(amounts)
    table["from_s"] = round(draw.uniform(0.0, duration_s), 4)
    if draw.random() < 0.5:
        table["until_s"] = round(table["from_s"] + draw.choice(LASTING_S), 4)
    if draw.random() < 0.3:
        table["side"] = "drive"
    return table


def _for_a_while(draw: Random, duration_s: float, table: Table) -> Table:
    if draw.random() < 0.7:
        table["duration_s"] = draw.choice(LASTING_S)
    return _when(draw, duration_s, table)


def _slow_drive(draw: Random, duration_s: float) -> Table:  # noqa: ARG001 - all kinds alike
    return {"sdo_delay_us": draw.choice((2000, 20_000)), "tpdo_delay_min_us": 0, "tpdo_delay_max_us": 900}


OTHERWISE: Final[dict[str, Callable[[Random, float], Table]]] = {
    "mode_change": _mode_change,
    "ignored_commands": _ignored_commands,
    "repeated_emergency": _repeated_emergency,
    "refused_mapping": _refused_mapping,
    "signal": _signal,
}
"""Kinds by which a drive does, or seems to do, something else than it is asked for."""
_KINDS: Final[dict[str, Callable[[Random, float], Table]]] = {
    "loss": _loss,
    "blackout": _blackout,
    "delay": _delay,
    "duplicate": _duplicate,
    "corruption": _corruption,
    "silence": _silence,
    "bus_off": _bus_off,
    "drive_fault": _drive_fault,
    "clock_step": _clock_step,
    "host_stall": _host_stall,
    "slow_drive": _slow_drive,
}


def bench_text(number: int) -> str:
    """The case as a bench file, to be run by hand."""
    return case(number).resolved_text()
