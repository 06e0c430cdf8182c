"""The invariants of drives that do otherwise find runs that are made to break them."""

import json
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from servobench.drivers.errors import DriveInFault
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, Instant
from servobench.hil.testing.bench_runs import BenchRunner
from servobench.hil.testing.campaign_runs import CampaignRunner
from servobench.hil.testing.run import Run
from tests.scenario.processes import EXAMPLES
from tests.swarm.following import CYCLES_MAX, OF_FOLLOWING, seen_on_the_wire
from tests.swarm.invariants import held_against
from tests.swarm.mishaps import Circumstances, Mishap
from tests.swarm.ran import Member, Told
from tests.swarm.witness import (
    FAR_TORQUE,
    FOLLOWS,
    OTHER_MODE,
    OTHER_TORQUE,
    TARGET_IGNORED,
    DriveWitness,
    witnessed,
)

pytestmark = pytest.mark.usefixtures("forked_children")

LEFT: dict[str, Any] = {"mode_change": [{"at_s": 0.2, "mode": "pv"}]}
DEAF: dict[str, Any] = {"ignored_commands": [{"at_s": 0.2, "duration_s": 0.1, "holds": "zero"}]}
SWEEP = Path(__file__).with_name("swarm.toml")
QUIET = Circumstances(Mishap.NONE, 0.0, 0, ())


@pytest.fixture
def swarm_member(servo_bench: BenchRunner) -> Callable[..., Member]:
    def run_member(faults: dict[str, Any], on_mode: str, *, ends: bool, lacks: Sequence[str] = ()) -> Member:
        drives: list[DriveWitness] = []
        changes = {"bench.duration_s": 0.5, "load": {}, "guard.on_mode": on_mode}
        changes["drive.axis1.simulation.lacks"] = lacks
        with witnessed(drives):
            ran: Run = servo_bench(
                EXAMPLES / "ling2012.toml", changes, faults=faults, ends_in=DriveInFault if ends else None
            )
        out = json.dumps(ran.summary.as_json())
        told = Told(ran.verdict.exit_status, out, "", [drive.testimony() for drive in drives])
        return Member(ran.config, QUIET, Path(ran.summary.recording), told, run=ran)

    return run_member


def found(member: Member) -> str:
    return "; ".join(held_against(OF_FOLLOWING, member))


def passed(member: Member) -> Member:
    """As if the bench had noticed nothing."""
    told = json.loads(member.case.out)
    told["verdict"] |= {"passed": True, "completed": True}
    return replace(member, case=member.case._replace(out=json.dumps(told)))


def stopping(member: Member) -> Member:
    """As if it had been asked to stop."""
    guard = member.config.guard.model_copy(update={"on_mode": "stop"})
    return replace(member, config=member.config.model_copy(update={"guard": guard}))


@pytest.mark.parametrize(
    ("faults", "why"), [(LEFT, OTHER_MODE), (DEAF, TARGET_IGNORED)], ids=["left", "deaf"]
)
def test_what_drives_that_do_otherwise_must_not_come_to(
    swarm_member: Callable[..., Member], faults: dict[str, Any], why: str
) -> None:
    stopped = swarm_member(faults, "stop", ends=True)
    went_on = swarm_member(faults, "tell", ends=False)
    assert found(stopped) == found(went_on) == ""
    drive = went_on.case.drives[0]
    assert drive.astray(Instant(0), Instant(10 * NS_PER_S), why), "the witness has seen it"

    assert "no_run_passes_whose_drive_did_not_follow: axis1" in found(passed(went_on))
    assert "is_stopped_within_three_cycles: axis1: told at" in found(stopping(went_on))
    unseen = [replace(each, otherwise=[(Instant(0), FOLLOWS)]) for each in stopped.case.drives]
    blind = replace(stopped, case=stopped.case._replace(drives=unseen))
    assert "no_run_is_ended_for_a_drive_that_follows: every drive followed" in found(blind)
    turning = [replace(each, speed_rad_s=5.0) for each in stopped.case.drives]
    ended = replace(stopped, case=stopped.case._replace(drives=turning))
    assert "the_shafts_are_at_rest_at_the_end: axis1: at 5.0 rad/s" in found(ended)


@pytest.mark.parametrize(
    ("lacks", "why", "lasts_ms", "is_found"),
    [
        ([], OTHER_TORQUE, 120, True),
        ([], OTHER_TORQUE, 100, False),
        (["6074"], OTHER_TORQUE, 300, False),
        (["6074"], FAR_TORQUE, 120, True),
        (["6074"], FAR_TORQUE, 100, False),
    ],
)
def test_a_drive_that_is_deaf_without_a_word_must_be_noticed_after_the_time_of_the_manual(
    swarm_member: Callable[..., Member], lacks: list[str], why: str, lasts_ms: int, is_found: bool
) -> None:
    """100 ms at 1 kHz, a tenth and three cycles; without 6074h only if its torque is far off."""
    member = swarm_member({}, "stop", ends=False, lacks=lacks)
    began = Instant(member.first_cycle + 100 * NS_PER_MS)
    ended = Instant(began + lasts_ms * NS_PER_MS)
    otherwise = [(Instant(0), FOLLOWS), (began, why), (ended, FOLLOWS)]
    deaf = [replace(each, otherwise=otherwise) for each in member.case.drives]
    assert bool(found(replace(member, case=member.case._replace(drives=deaf)))) is is_found


def test_a_drive_that_answers_late_is_stopped_as_soon(swarm_member: Callable[..., Member]) -> None:
    """Its quick stop waits for no SDO."""
    slow = {"slow_drive": [{"sdo_delay_us": 20_000}]}
    for faults in (LEFT, DEAF):
        assert found(swarm_member(faults | slow, "stop", ends=True)) == ""


def test_all_drives_are_stopped_before_the_one_that_fails_is_asked_why(servo_bench: BenchRunner) -> None:
    """Its EMCY comes at once, its answers 20 ms late; all questions but the first, of 10 ms, come later."""
    faults = {
        "drive_fault": [{"at_s": 0.2, "fault": "over_current", "nodes": [1]}],
        "slow_drive": [{"sdo_delay_us": 20_000}],
    }
    changes: dict[str, Any] = {"load": {}}
    ran = servo_bench(EXAMPLES / "three_axes.toml", changes, faults=faults, ends_in=DriveInFault)
    failed = next(frame.at for frame in ran.wire.frames if frame.can_id == 0x081 and frame.at > 0)
    _, stops = seen_on_the_wire(ran.wire.frames, 2)
    asked_after_emergency = 10 * NS_PER_MS
    limit = asked_after_emergency + CYCLES_MAX * ran.config.loop.period
    assert next(at for at in stops if at > failed) - failed < limit


@pytest.mark.parametrize(
    "seed",
    [8000275, 8000242, 8000055, 34001332, 342712579, 342711492, 341127632],
    ids=[
        "it follows again within the cycle",
        "three do not follow at once",
        "it is deaf for less than T",
        "between two SYNCs",
        "polled, and deaf to SDO at the end",
        "while no SYNC of another is heard",
        "its own mappings, without 6061h",
    ],
)
def test_nothing_is_found_any_more(tmp_path: Path, seed: int) -> None:
    tables = tomllib.loads(SWEEP.read_text(encoding="utf-8"))
    tables["campaign"] |= {"first_seed": seed, "seeds": 1}
    CampaignRunner(tmp_path, SWEEP.parent)(tables).assert_nothing_found()
