"""A transmit queue without room and an interface that goes down, drawn: what no longer came to the bus is
told of its cycle, a run goes on where the drive does, and no drive is left turning.

Witness: a listener on the wire, and the simulated shaft.
"""

from collections.abc import Sequence
from random import Random
from typing import Any, Final

import numpy as np
import pytest

from drivers.canopen.cob_ids import SYNC
from drivers.errors import BusDown
from drivers.timebase import NS_PER_US, Instant
from hil.rows.records import COMMAND_FATES
from hil.testing.bench_runs import BenchRunner
from tests.scenario.foreign_node import beside_the_bench
from tests.scenario.processes import EXAMPLES
from tests.scenario.test_drive_follows import Shaft
from virtual_bus.drive.servo import SimulatedServo
from virtual_bus.frame import Frame

NOT_SENT: Final = [fate.value for fate in COMMAND_FATES].index("not sent")
RPDO1: Final = 0x201
REST_RPM: Final = 1.0


class Wire:
    """Hears each SYNC and each command, and when it ended."""

    def __init__(self) -> None:
        self.wake_at: Instant | None = None
        self.syncs: list[int] = []
        self.commands: list[int] = []

    def start(self, now: Instant) -> Sequence[Frame]:
        del now
        return ()

    def receive(self, frame: Frame, now: Instant) -> Sequence[Frame]:
        if frame.can_id == SYNC:
            self.syncs.append(now)
        elif frame.can_id == RPDO1:
            self.commands.append(now)
        return ()

    def wake(self, now: Instant) -> Sequence[Frame]:
        del now
        return ()


def drawn(draw: Random, longest_s: float) -> dict[str, Any]:
    """One axis at 500 or 1000 Hz, in torque or speed, with up to four outages."""
    mode, controller = draw.choice(
        [
            ("cst", {"kind": "pid", "proportional_nm_s_rad": 0.12, "integral_nm_rad": 2.0}),
            ("csv", {"kind": "stream"}),
        ]
    )
    outages: dict[str, list[dict[str, Any]]] = {"full_queue": [], "link_down": []}
    for place in range(draw.randrange(1, 5)):
        lasts = draw.choice((0.0005, 0.002, draw.uniform(0.001, longest_s)))
        kind = draw.choice(("full_queue", "link_down"))
        at_s = 0.3 + place * (longest_s + 0.05) + draw.uniform(0.0, 0.04)
        outages[kind].append({"at_s": round(at_s, 6), "duration_s": round(lasts, 6)})
    faults = {kind: tables for kind, tables in outages.items() if tables}
    if draw.random() < 0.3:
        faults["loss"] = [{"probability": 0.01, "direction": "drive_to_host"}]
    return {
        "bench": {"name": "outages", "duration_s": 0.4 + 4 * (longest_s + 0.05), "seed": draw.randrange(99)},
        "loop": {
            "period_us": draw.choice((1000, 2000)),
            "actuation": draw.choice(("on_sync", "on_arrival")),
            "horizon_periods": 20,
        },
        "drive": {
            "axis1": {
                "node": 1,
                "mode": mode,
                "motor": str(EXAMPLES / "motors/ling2012.toml"),
                "controller": controller,
                "simulation": {"lacks": draw.choice(([], ["1013"]))},
                "limits": {"speed_max_rpm": 2500.0, "torque_max_nm": 5.0, "dropouts_consecutive_max": 60},
            }
        },
        "reference": {"axis1": [{"kind": "step", "at_s": 0.05, "speed_rpm": draw.choice((300.0, 900.0))}]},
        "faults": faults,
    }


@pytest.mark.parametrize("seed", range(6))
def test_each_cycle_tells_what_did_not_come_to_the_wire(servo_bench: BenchRunner, seed: int) -> None:
    draw, wire = Random(f"outages {seed}"), Wire()
    with beside_the_bench(wire):
        ran = servo_bench(drawn(draw, 0.03))
    told, handed = ran.column("sync_on_bus_at"), ran.column("sync_handed_at")
    zero = wire.syncs[-1] - int(told[-1])
    assert {zero + int(at) for at in told[~np.isnan(told)]} <= set(wire.syncs)
    first = zero + handed[~np.isnan(handed)][0]
    assert sum(at >= first for at in wire.syncs) == np.count_nonzero(~np.isnan(handed))
    waited = ran.column("received_at") - told
    assert np.nanmin(waited) > 0, "no reading is placed at another SYNC"
    assert np.nanmax(waited) < ran.config.loop.period
    fates, commands = ran.column("command_fate"), ran.column("command_handed_at")
    went = commands[~np.isnan(commands) & (fates != NOT_SENT)]
    on_wire = [at for at in wire.commands if at >= zero + went[0]][: len(went)]
    assert len(went) == len(on_wire)
    late = np.array(on_wire) - zero - went
    assert late.min() > 0
    assert np.median(late) < 500 * NS_PER_US
    assert NOT_SENT not in fates or any("takes no frames" in event.get("text", "") for event in ran.events)


@pytest.mark.parametrize("seed", range(6))
def test_an_outage_that_outlasts_the_drives_patience_ends_at_rest(
    servo_bench: BenchRunner, seed: int
) -> None:
    draw = Random(f"long outages {seed}")
    bench = drawn(draw, 0.03)
    bench["bench"]["duration_s"] = 4.0
    kind = draw.choice(("full_queue", "link_down"))
    bench["faults"] = {kind: [{"at_s": 0.5, "duration_s": draw.choice((0.6, 1.4, 3.0))}]}
    drives: list[SimulatedServo] = []
    shaft = Shaft(drives)
    with beside_the_bench(shaft, seen=drives.append), pytest.raises(Exception) as ended:
        servo_bench(bench)
    assert getattr(ended.value, "exit_status", None) == 3 or isinstance(ended.value, BusDown), ended.value
    assert np.abs(shaft.rpm(0.02)).max() <= REST_RPM
