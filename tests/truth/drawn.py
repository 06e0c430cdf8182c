"""Plans that are drawn by a seed from everything at once.

A plan is a bench and what befalls it, made of features. Each feature is drawn by a stream of its own, so a
feature that is left out, or a new one, changes no other. How many of them come together is drawn too.
"""

from collections.abc import Callable, Collection
from math import exp, log
from random import Random
from typing import Any, Final

from servobench.drivers.wire.frame_port import EchoBasis
from tests.truth.adapter import Adapter
from tests.truth.drawn_bench import PERIOD_US, DrawnPlan
from tests.truth.standstills import Standstills, Waiting

DENSITY: Final = (0.2, 1.0)
"""The chances of all features are scaled by a number between: plans of two features tell what fails, plans of
ten what is left when each holds alone."""
BUS_LOAD_MOST: Final = 0.95
TICK_US: Final = 62.5
"""Of the current loops of the simulated drive."""
CYCLE_BITS: Final = {"sync": 60, "reading": 290, "command": 110, "event": 125}
"""Frames of one cycle on the wire, of each axis but for the SYNC, with stuff bits."""
BACKGROUND_BITS: Final = 130
"""A frame of eight bytes on the wire."""


Draw = Random
Feature = Callable[[Draw, DrawnPlan], str]
"""Puts itself into a plan and says how, in words; it says nothing if it does not fit."""
FEATURES: Final[dict[str, tuple[float, int, Feature]]] = {}
"""By name, the chance at full density, and the first seed that may draw it. Their order matters: later ones
look at what earlier ones chose."""


def _feature(chance: float, first: int = 0) -> Callable[[Feature], Feature]:
    """``first``: plans of seeds before are as they were before the feature was there."""

    def register(make: Feature) -> Feature:
        FEATURES[make.__name__.strip("_").replace("_", " ")] = chance, first, make
        return make

    return register


def drawn_plan(seed: int, without: Collection[str] = (), only: Collection[str] | None = None) -> DrawnPlan:
    """The plan of ``seed``, less the features ``without``, or reduced to ``only`` those."""
    density = Random(f"{seed} density").uniform(*DENSITY)
    plan = DrawnPlan(seed)
    for name, (chance, first, make) in FEATURES.items():
        drawn = Random(f"{seed} {name}")
        if (
            seed < first
            or drawn.random() >= chance * density
            or name in without
            or (only is not None and name not in only)
        ):
            continue
        if words := make(drawn, plan):
            plan.features.append(name)
            plan.words.append(words)
    return plan


def shrunk(plan: DrawnPlan, fails: Callable[[DrawnPlan], bool]) -> DrawnPlan:
    """``plan``, which ``fails``, without the features that it does not need for that, tried one by one."""
    for name in plan.features:
        fewer = drawn_plan(plan.seed, only=[other for other in plan.features if other != name])
        if fails(fewer):
            plan = fewer
    return plan


def _evenly_in_log(draw: Draw, least: float, most: float) -> float:
    return round(exp(draw.uniform(log(least), log(most))), 1)


def _node(draw: Draw, plan: DrawnPlan) -> dict[str, Any]:
    """Now and then one drive only."""
    return {"nodes": [draw.randint(1, plan.axes)]} if plan.axes > 1 and draw.random() < 0.4 else {}


def _side(draw: Draw) -> dict[str, Any]:
    return {"side": "drive"} if draw.random() < 0.5 else {}


def _table(keys: dict[str, Any]) -> str:
    return ", ".join(f"{key} = {value}" for key, value in keys.items())


def _put(plan: DrawnPlan, kind: str, **keys: Any) -> str:
    plan.add(kind, **keys)
    return f"{kind}: {_table(keys)}"


@_feature(0.5)
def _several_axes(draw: Draw, plan: DrawnPlan) -> str:
    plan.axes = draw.choice((2, 3))
    plan.position_every = draw.choice((1, 10))
    if plan.position_every == 1:
        plan.period_us = 2000
    return f"{plan.axes} axes, position_every_cycles = {plan.position_every}, period {plan.period_us} us"


@_feature(0.4)
def _period(draw: Draw, plan: DrawnPlan) -> str:
    if plan.period_us > PERIOD_US:
        return ""
    plan.period_us = draw.choice((997, 1003, 1250, 2000))
    return f"period {plan.period_us} us"


@_feature(0.4)
def _readback_by_event(draw: Draw, plan: DrawnPlan) -> str:
    del draw
    plan.readback = "event"
    if plan.axes > 1:
        plan.period_us = 2000
    return f'command_readback = "event", period {plan.period_us} us'


@_feature(0.3)
def _sync_kernel(draw: Draw, plan: DrawnPlan) -> str:
    del draw
    plan.sync = "kernel"
    return 'sync = "kernel"'


@_feature(0.4)
def _sync_foreign(draw: Draw, plan: DrawnPlan) -> str:
    if plan.heard:
        return ""
    plan.sync = "foreign"
    plan.producer_period_us = plan.period_us + draw.choice((-1, 0, 0, 1))
    plan.producer_jitter_us = draw.choice((0, 20, 100, 400))
    return f'sync = "foreign", every {plan.producer_period_us} us, jitter {plan.producer_jitter_us} us'


@_feature(0.5)
def _on_sync(draw: Draw, plan: DrawnPlan) -> str:
    del draw
    plan.actuation = "on_sync"
    return 'actuation = "on_sync"'


@_feature(0.4)
def _deadline(draw: Draw, plan: DrawnPlan) -> str:
    plan.deadline_us = draw.choice((1, 3, 6)) * plan.period_us
    plan.horizon_periods = draw.choice((8, 20, 50))
    return f"deadline {plan.deadline_us} us, horizon {plan.horizon_periods} periods"


@_feature(0.4)
def _no_stamps(draw: Draw, plan: DrawnPlan) -> str:
    del draw
    plan.has_stamps = False
    return "no 1013h"


@_feature(0.35)
def _coarse_stamps(draw: Draw, plan: DrawnPlan) -> str:
    if not plan.has_stamps:
        return ""
    plan.simulation["stamp_resolution_us"] = resolution_us = draw.choice((2, 10, 62, 100, 250, 400, 1000))
    return f"1013h in steps of {resolution_us} us"


@_feature(0.35)
def _late_stamps(draw: Draw, plan: DrawnPlan) -> str:
    if not plan.has_stamps:
        return ""
    late_us = draw.choice((0.0, _evenly_in_log(draw, 5, 62.5)))
    keys = {"stamp_latched": "tick" if draw.random() < 0.7 else "arrival", "stamp_late_us": late_us}
    plan.simulation |= keys
    return f"1013h: {_table(keys)}"


@_feature(0.7)
def _stamps_are_known(draw: Draw, plan: DrawnPlan) -> str:
    """The bench is told the resolution, as ``hil measure`` finds it, and a tick of the current loops on top
    where they latch the stamp (docs/timing.md)."""
    del draw
    told_us = plan.simulation.get("stamp_resolution_us", 1)
    if plan.simulation.get("stamp_latched") == "tick":
        told_us += TICK_US
    plan.stamp_resolution_us = min(told_us, 1000)
    return f"stamp_resolution_us = {plan.stamp_resolution_us}" if plan.simulation else ""


@_feature(0.4)
def _sync_jitter_at_the_drive(draw: Draw, plan: DrawnPlan) -> str:
    """Of its task, or of a gateway before it."""
    plan.sync_jitter_us = most_us = _evenly_in_log(draw, 5, 500)
    if draw.random() < 0.6:
        plan.simulation["sync_jitter_us"] = most_us
        return f"drives act on a SYNC 0 to {most_us} us after its end"
    keys = {"direction": "host_to_drive", "frames": ["sync"], "side": "drive"}
    return _put(plan, "delay", delay_min_us=0, delay_max_us=most_us, **keys)


@_feature(0.4)
def _clock_drift(draw: Draw, plan: DrawnPlan) -> str:
    plan.drifts_ppm = tuple(round(draw.choice((50, 200, 1000)) * draw.uniform(-1, 1), 1) for _ in range(3))
    return f"clocks drift by {', '.join(f'{drift:g}' for drift in plan.drifts_ppm[: plan.axes])} ppm"


@_feature(0.1)
def _drift_for_a_time(draw: Draw, plan: DrawnPlan) -> str:
    drift_ppm = round(draw.uniform(-100, 100), 1)
    return _put(plan, "clock_drift", drift_ppm=drift_ppm, from_s=0.4, until_s=1.0, **_node(draw, plan))


@_feature(0.2)
def _clock_steps(draw: Draw, plan: DrawnPlan) -> str:
    most_us = int(_evenly_in_log(draw, 100, 1e6))
    keys = {"step_min_us": -most_us, "step_max_us": most_us, **_node(draw, plan)}
    if draw.random() < 0.3:  # by whole periods, which SYNCs at equal distances do not show
        keys["step_min_us"] = keys["step_max_us"] = draw.choice((-3, -1, 1, 2)) * plan.period_us
    return _put(plan, "clock_step", probability_per_s=0.9, **keys)


@_feature(0.1)
def _stamps_wrap(draw: Draw, plan: DrawnPlan) -> str:
    plan.clock_starts_at_us = (1 << 32) - draw.randint(300_000, 1_500_000)
    return f"1013h is {plan.clock_starts_at_us} at power-on"


@_feature(0.45)
def _delay_of_readings(draw: Draw, plan: DrawnPlan) -> str:
    most_us = round(draw.choice((0.3, 0.9, 1.9, 5.0)) * draw.random() * plan.period_us)
    least_us = round(draw.choice((0.0, 0.0, 0.5, 1.0)) * draw.random() * most_us)
    plan.reading_delay_us += most_us
    keys = {"direction": "drive_to_host", **_side(draw), **_node(draw, plan)}
    if draw.random() < 0.4:
        keys["reorder"] = True
    return _put(plan, "delay", delay_min_us=least_us, delay_max_us=most_us, **keys)


@_feature(0.2)
def _gateway_step(draw: Draw, plan: DrawnPlan) -> str:
    delay_us = round(_evenly_in_log(draw, 100, 5000))
    plan.reading_delay_us += delay_us
    keys = {"direction": "drive_to_host", "from_s": 0.6, **_side(draw)}
    if draw.random() < 0.5:
        keys["until_s"] = 1.1
    return _put(plan, "delay", delay_us=delay_us, **keys)


@_feature(0.15)
def _slow_drive(draw: Draw, plan: DrawnPlan) -> str:
    most_us = round(_evenly_in_log(draw, 50, 2500))
    plan.reading_delay_us += most_us
    return _put(plan, "slow_drive", tpdo_delay_min_us=0, tpdo_delay_max_us=most_us, **_node(draw, plan))


@_feature(0.15, first=480_000)
def _standstills(draw: Draw, plan: DrawnPlan) -> str:
    """Of the drives' processes: up to several periods, each for itself."""
    longest_us = round(draw.choice((0.9, 1.9, 5.0)) * plan.period_us)
    every_us = draw.choice((20, 100)) * plan.period_us
    plan.standstills = Standstills(every_us, longest_us, draw.choice(tuple(Waiting)))
    plan.reading_delay_us += longest_us
    return f"drives stand still 0 to {longest_us} us, {every_us} us apart; {plan.standstills.waiting.value}"


@_feature(0.35)
def _loss(draw: Draw, plan: DrawnPlan) -> str:
    direction = draw.choice(("both", "drive_to_host", "host_to_drive"))
    probability = round(_evenly_in_log(draw, 0.5, 20) / 100, 4)
    return _put(
        plan, "loss", probability=probability, direction=direction, **_side(draw), **_node(draw, plan)
    )


@_feature(0.2)
def _bursts_of_losses(draw: Draw, plan: DrawnPlan) -> str:
    keys = {"direction": draw.choice(("both", "drive_to_host")), **_side(draw), **_node(draw, plan)}
    return _put(plan, "burst", p_good_to_bad=0.01, p_bad_to_good=draw.choice((0.2, 0.5)), **keys)


@_feature(0.1)
def _blackout(draw: Draw, plan: DrawnPlan) -> str:
    duration_s = round(draw.uniform(2, 30) * 1e-3, 4)
    return _put(plan, "blackout", from_s=0.5, duration_s=duration_s, **_side(draw))


@_feature(0.25)
def _loss_of_syncs(draw: Draw, plan: DrawnPlan) -> str:
    keys: dict[str, Any] = {"direction": "host_to_drive", **_side(draw)}
    if plan.sync == "foreign":
        keys = draw.choice(({"direction": "drive_to_host"}, {"direction": "host_to_drive", "side": "drive"}))
    probability = round(_evenly_in_log(draw, 0.5, 10) / 100, 4)
    return _put(plan, "loss", probability=probability, frames=["sync"], **keys)


@_feature(0.25)
def _duplicates(draw: Draw, plan: DrawnPlan) -> str:
    probability = round(_evenly_in_log(draw, 0.5, 30) / 100, 4)
    keys = {"direction": draw.choice(("both", "drive_to_host", "host_to_drive")), **_side(draw)}
    later_us = round(draw.uniform(0, 3) * plan.period_us)
    return _put(plan, "duplicate", probability=probability, later_us=later_us, **keys)


@_feature(0.25)
def _held_frames(draw: Draw, plan: DrawnPlan) -> str:
    probability = round(_evenly_in_log(draw, 0.5, 10) / 100, 4)
    most_us = round(draw.uniform(0.5, 3.5) * plan.period_us)
    plan.reading_delay_us += most_us
    keys = {"direction": draw.choice(("both", "drive_to_host")), **_side(draw)}
    return _put(plan, "reorder", probability=probability, held_min_us=300, held_max_us=most_us, **keys)


@_feature(0.3)
def _delay_of_commands(draw: Draw, plan: DrawnPlan) -> str:
    most_us = round(draw.uniform(0, 1.5) * plan.period_us)
    keys = {"direction": "host_to_drive", **_side(draw)}
    if draw.random() < 0.3:
        keys["reorder"] = True
    return _put(plan, "delay", delay_min_us=0, delay_max_us=most_us, **keys)


@_feature(0.2)
def _late_syncs(draw: Draw, plan: DrawnPlan) -> str:
    """In front of the echo."""
    if plan.sync == "foreign":
        return ""
    keys = {"direction": "host_to_drive", "frames": ["sync"]}
    plan.sync_wait_us = draw.choice((30, 100, 300))
    return _put(plan, "delay", delay_min_us=0, delay_max_us=plan.sync_wait_us, **keys)


@_feature(0.25)
def _host_stalls(draw: Draw, plan: DrawnPlan) -> str:
    late_us = round(_evenly_in_log(draw, 200, 20_000))
    return _put(plan, "host_stall", every_s=draw.choice((0.0473, 0.2)), late_min_us=0, late_max_us=late_us)


@_feature(0.35)
def _traffic(draw: Draw, plan: DrawnPlan) -> str:
    """Other nodes' frames, before the bench's own ones in the arbitration or behind them."""
    bits = CYCLE_BITS["sync"] + plan.axes * sum(
        CYCLE_BITS[name] for name in ("reading", "command", *("event",) * (plan.readback == "event"))
    )
    room = BUS_LOAD_MOST - bits / plan.period_us
    share = room * draw.choice((0.3, 0.7, 1.0))
    if share <= 0.0:
        return ""
    can_id = draw.choice((0x050, 0x3A0, 0x7D0))
    period_us = max(BACKGROUND_BITS + 5, round(BACKGROUND_BITS / share))
    arrivals = draw.choice(("periodic", "random"))
    plan.background.append({"can_id": can_id, "period_us": period_us, "arrivals": arrivals})
    return f"traffic {can_id:03X}h every {period_us} us, {arrivals}"


@_feature(0.4)
def _adapter(draw: Draw, plan: DrawnPlan) -> str:
    basis = draw.choice((EchoBasis.HARDWARE, EchoBasis.KERNEL, EchoBasis.RECEIPT, EchoBasis.NONE))
    plan.adapter = Adapter(basis, _evenly_in_log(draw, 5, 900))
    return f"adapter: basis {basis.value}, frames 0 to {plan.adapter.late_us} us late"
