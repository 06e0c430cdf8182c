"""Rows of runs on a hub are what a third client heard; and what it heard is judged rightly."""

from pathlib import Path

import numpy as np
import pytest

from servobench.drivers.cia402.pdo_planner import mode_plan
from servobench.drivers.cia402.pdo_plans import PlanWish
from servobench.drivers.timebase import NS_PER_MS, NS_PER_US, Duration
from tests.draws import few_of
from tests.scenario.processes import HIL
from tests.stillness import Untrue
from tests.truth.hub_listener import FRAME_DTYPE, FrameTable
from tests.truth.hub_run import HubOutcome, run_beside_a_listener
from tests.truth.hub_truth import OutOfOrder, Spacings, hub_truth, sync_spacings
from tests.truth.plans import Plan
from tests.truth.rows import LOST, TOLD_DTYPE, USED, Told
from tests.truth.stalls import Stalls
from tests.warm.start import hil

CYCLES = 2_000
UNCERTAIN_MAX, UNCERTAIN_STALLED_MAX = 0.05, 0.15
"""A run that is in doubt everywhere would tell nothing wrong, and nothing at all. Where processes are made to
stand still, what stood still together is in doubt: some 4 % of the rows, and more beside other work."""
USED_LEAST = 0.5
"""On two cores that others use too hosts and producers are late; a machine of its own misses hardly any."""
PERIOD = Duration(NS_PER_MS)
PLAN = mode_plan(1, PlanWish())
NO_COMMANDS: FrameTable = np.empty(0, FRAME_DTYPE)


@pytest.mark.xdist_group("real time")
@pytest.mark.parametrize(
    ("axes", "stalls"),
    few_of([(1, Stalls(1, 100.0, 60.0)), (1, None), (1, Stalls(2)), (3, None), (3, Stalls(6))], 1),
)
def test_what_a_run_on_a_hub_tells_is_what_happened(axes: int, stalls: Stalls | None, tmp_path: Path) -> None:
    """Where processes stand still, the way of the commands is asked for too: at 1 kHz it leaves no room for
    three axes."""
    period_us = 2000 if stalls and axes == 3 else 1000
    plan = Plan("hub", axes=axes, period_us=period_us, commands=stalls is not None)
    found = run_beside_a_listener(plan, CYCLES, tmp_path, stalls=stalls, by=HIL if stalls else hil())

    assert_it_happened(found, axes)
    assert found.readings.uncertain <= (UNCERTAIN_STALLED_MAX if stalls else UNCERTAIN_MAX) * axes * CYCLES
    assert found.spacings.handed == 0


@pytest.mark.xdist_group("real time")
@pytest.mark.parametrize(("axes", "jitter_us"), few_of([(1, 400), (3, 0), (1, 0), (3, 400)], 1))
def test_what_a_run_at_the_syncs_of_a_further_client_tells_is_what_happened(
    axes: int, jitter_us: int, tmp_path: Path
) -> None:
    """At equal distances, but for how late the machine wakes their producer, as a kernel's timer makes them;
    and with jitter. No frame is lost on a hub, so no reading is, of no axis."""
    plan = Plan("hub", axes=axes, sync="foreign", producer_jitter_us=jitter_us)
    found = run_beside_a_listener(plan, CYCLES, tmp_path, by=hil())

    assert_it_happened(found, axes)
    assert found.readings.false_losses == 0
    assert found.readings.uncertain <= UNCERTAIN_MAX * axes * CYCLES
    assert found.readings.fates[USED] >= USED_LEAST * axes * CYCLES


def assert_it_happened(found: HubOutcome, axes: int) -> None:
    """Nothing certain is wrong, of a run of ``CYCLES``, and nothing is without its row."""
    readings, spacings = found.readings, found.spacings
    if readings.wrong or readings.echo_wrong or readings.bound_broken or found.negative_delays:
        raise Untrue(f"{readings.misjudged}, echoes {readings.echo_wrong}: {readings.examples}")
    if found.commands.wrong:
        raise Untrue(f"{found.commands.wrong} commands: {found.commands.examples}")
    if spacings.too_early:
        raise Untrue("by its stamps a SYNC was on the bus before it was handed over")
    assert found.status in (0, 6), found.said  # 6: cycles were missed, and no limit says how many may
    assert readings.rows == axes * CYCLES
    assert readings.unaccounted == 0


def frames(*syncs_us: int) -> FrameTable:
    """SYNCs that end at these instants, and after each the TPDOs of node 1."""
    rows = []
    for sync_us in syncs_us:
        ids = (0x080, *(pdo.cob_id for pdo in PLAN.tpdos))
        rows += [((sync_us + 100 * place) * NS_PER_US, can_id, 8, b"") for place, can_id in enumerate(ids)]
    return np.array(rows, FRAME_DTYPE)


def told(*handed_us: int) -> Told:
    rows = np.zeros(len(handed_us), TOLD_DTYPE)
    rows["fate"], rows["sync_handed_at"] = LOST, np.array(handed_us) * NS_PER_US
    rows["command_handed_at"], rows["command_raw"] = rows["sync_handed_at"], range(len(handed_us))
    return rows


def test_the_last_sync_belongs_to_the_last_row() -> None:
    truth = hub_truth(frames(0, 1000, 2050), told(950, 2000), PLAN, NO_COMMANDS)

    assert [sync.handed_at // NS_PER_US for sync in truth.syncs] == [0, 950, 2000]
    assert [sync.on_bus_at for sync in truth.syncs] == [0, 1000 * NS_PER_US, 2050 * NS_PER_US]
    answers = [sync.reading.heard.at for sync in truth.syncs if sync.reading is not None]
    assert answers == [sync.on_bus_at for sync in truth.syncs]


def test_spacings_are_counted_with_their_cause() -> None:
    rows = told(0, 1000, 1400, 2500, 4000)
    truth = hub_truth(frames(50, 1050, 1450, 3900, 3990), rows, PLAN, NO_COMMANDS)

    assert sync_spacings(truth, rows, PERIOD) == Spacings(handed=1, on_bus=2, held_up=1, too_early=1)


def test_an_order_that_does_not_tell_is_refused() -> None:
    heard = frames(0, 1000, 2000)
    with pytest.raises(OutOfOrder, match="4 SYNCs handed over, 3 on the bus"):
        hub_truth(heard, told(0, 1000, 2000, 3000), PLAN, NO_COMMANDS)
    with pytest.raises(OutOfOrder, match="long before or after"):
        hub_truth(heard, told(0, 1000, 300_000), PLAN, NO_COMMANDS)
    with pytest.raises(OutOfOrder, match="3 SYNCs and 2 frames"):
        hub_truth(
            np.delete(heard, np.flatnonzero(heard["can_id"] == 0x181)[-1]),
            told(0, 1000, 2000),
            PLAN,
            NO_COMMANDS,
        )


@pytest.mark.parametrize(
    ("last_us", "later"),
    [(2684, {2000: 2684 * NS_PER_US, 3000: None}), (3684, {})],
    ids=["the last was not handed over then", "either of two that are alike"],
)
def test_commands_are_known_by_their_set_points(last_us: int, later: dict[int, int | None]) -> None:
    rows = told(0, 1000, 2000, 3000)
    rows["command_raw"][3] = rows["command_raw"][2]
    heard = commands((84, 0), (last_us, 2))
    truth = hub_truth(frames(50, 1050, 2050, 3050), rows, PLAN, heard)

    acts_at = {at // NS_PER_US: command.acts_at for at, command in truth.commands.items()}
    assert acts_at == {0: 84 * NS_PER_US, 1000: None, **later}


def test_a_command_that_nobody_sent_is_refused() -> None:
    with pytest.raises(OutOfOrder, match="a set-point of 7"):
        hub_truth(frames(50, 1050), told(0, 1000), PLAN, commands((84, 0), (1084, 7)))


def commands(*heard: tuple[int, int]) -> FrameTable:
    """RPDOs of an enabled drive, each an instant in us and a set-point."""
    return np.array([(at * NS_PER_US, 0x201, 4, bytes((0x0F, 0, raw))) for at, raw in heard], FRAME_DTYPE)
