"""A session of commissioning: how an attempt begins and ends, how the drive is set up, and what may wait."""

import math
import threading
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final, cast

import pytest

from servobench.drivers.canopen.pdo import PdoPlan
from servobench.drivers.canopen.pdo_budget import budget_of
from servobench.drivers.cia402.drive_setup import DriveSettings
from servobench.drivers.cia402.pdo_planner import mode_plan
from servobench.drivers.cia402.pdo_plans import PlanWish
from servobench.drivers.cia402.profile import Mode, QuickStopOption, State
from servobench.drivers.cia402.scaling import ScaleOverride
from servobench.drivers.errors import PeerFault
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, NS_PER_US, Duration, Instant
from servobench.hil.commissioning import session as module
from servobench.hil.commissioning.exercise import EnergyMeter
from servobench.hil.commissioning.findings import Findings, StepFailed, StepOutcome
from servobench.hil.commissioning.request import CommissionRequest, cautious
from servobench.hil.commissioning.session import Session
from tests.unit.hil.simulated_shaft import LIMITS, Objects

CST = Mode.CYCLIC_SYNCHRONOUS_TORQUE
LOST: Final = 0x8130


class Bench:
    """A session on a drive that notes all it is told; ``notes`` are in order."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *, watched: bool = True, **request: Any) -> None:
        self.notes: list[str] = []
        self.settings: list[DriveSettings] = []
        self.lapsed: list[str] = []
        self.now = Instant(0)
        self.plan = mode_plan(5, PlanWish(CST, coherent=True))
        self.control = SimpleNamespace(emergencies=[], read_state=lambda: State.SWITCH_ON_DISABLED)
        self.drive = SimpleNamespace(
            control=self.control,
            enabled=False,
            plan=None,
            error_control=SimpleNamespace(host_watched=watched),
            reset_fault=lambda deadline: self.notes.append(f"reset within {deadline / NS_PER_S:g} s"),
            configure=self._configure,
        )
        monkeypatch.setattr(module, "lapses", lambda drive, ms: self._lapses(drive, ms))
        session = Session.__new__(Session)
        mine: Any = session
        mine.request = CommissionRequest("hub:x", 5, Path("out"), **request)
        mine.drive, mine.found = self.drive, Findings(modes=(CST,), limits=LIMITS)
        mine.dialog = SimpleNamespace(tell=self.notes.append)
        mine.network = SimpleNamespace(
            clock=SimpleNamespace(now=lambda: self.now),
            pump=self._pump,
            deadline_after=lambda duration: duration,
        )
        arm = lambda syncs, period: self.notes.append(f"armed {syncs} {period}")  # noqa: E731
        mine.drives = SimpleNamespace(guard=SimpleNamespace(arm=arm))
        mine.gaps = SimpleNamespace(begin=lambda: self.notes.append("gaps"), cause_of=lambda failure: failure)
        mine.world = SimpleNamespace(real_time=False)
        mine.log = SimpleNamespace(write=lambda: self.notes.append(threading.current_thread().name))
        mine.stop = lambda: False
        mine.capability = mine.dictionary = None
        mine.objects = Objects()
        mine.configured = mine.disturbed = False
        self.session = session

    def _configure(self, settings: DriveSettings) -> list[str]:
        self.settings.append(settings)
        self.drive.plan = self.plan
        return [f"note {len(self.settings)}"]

    def _lapses(self, drive: Any, heartbeat_ms: int) -> list[str]:
        assert (drive, heartbeat_ms) == (self.drive, 50)
        return self.lapsed

    def _pump(self, until: Instant) -> None:
        self.now = max(self.now, until)

    def configured(self) -> "Bench":
        """Set up already, the notes of it forgotten."""
        self.session.configure()
        self.notes.clear()
        self.settings.clear()
        return self


# ---- an attempt ------------------------------------------------------------------------------------------


def test_an_attempt_has_a_bound_on_its_work_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch)
    bench.session.energy = spent = EnergyMeter()
    bench.lapsed = ["never looked at"]
    bench.session.begin_attempt()
    assert bench.session.energy is not spent
    assert bench.notes == ["gaps"], "nothing is set up before the first time"


def emergencies(*codes: int) -> list[Any]:
    return [SimpleNamespace(code=code) for code in codes]


RESET = ["reset within 3 s", "    the fault 8130h, of a host that was not heard, is reset"]


@pytest.mark.parametrize("state", [State.FAULT, State.FAULT_REACTION, State.SWITCH_ON_DISABLED])
@pytest.mark.parametrize(
    ("codes", "silence"),
    [
        ((LOST,), True),
        ((LOST, 0), True),
        ((0x2310, LOST), True),
        ((LOST, 0x2310), False),
        ((0,), False),
        ((), False),
    ],
)
def test_only_the_fault_of_the_hosts_own_silence_is_reset(
    monkeypatch: pytest.MonkeyPatch, state: State, codes: tuple[int, ...], silence: bool
) -> None:
    """By the last EMCY that tells of an error; 0 is its end."""
    bench = Bench(monkeypatch).configured()
    bench.control.emergencies, bench.control.read_state = emergencies(*codes), lambda: state
    bench.session.begin_attempt()
    faulty = state is not State.SWITCH_ON_DISABLED
    assert bench.notes == ["gaps", *(RESET if silence and faulty else [])]
    assert bench.settings == []


@pytest.mark.parametrize(
    ("code", "cause"),
    [
        (0x3210, "of a DC link that braking charged"),
        (0x3220, "of a DC link that driving emptied"),
        (0x2350, "of I^2 t"),
    ],
)
def test_a_fault_that_an_exercise_causes_and_that_passes_is_reset(
    monkeypatch: pytest.MonkeyPatch, code: int, cause: str
) -> None:
    bench = Bench(monkeypatch).configured()
    bench.control.emergencies, bench.control.read_state = emergencies(LOST, code), lambda: State.FAULT
    bench.session.begin_attempt()
    assert bench.notes == ["gaps", "reset within 3 s", f"    the fault {code:04X}h, {cause}, is reset"]


def test_a_drive_that_fell_out_of_its_setting_is_set_up_again(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch).configured()
    bench.lapsed = ["it is stopped", "6072h holds 0"]
    bench.session.begin_attempt()
    told = "    the drive is set up again: it is stopped; 6072h holds 0"
    assert bench.notes == ["gaps", told, "armed {} 1000000"]
    assert len(bench.settings) == 1


def test_the_host_s_own_silence_is_why_an_attempt_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch)
    cause = PeerFault("the host stood still")
    cast(Any, bench.session).gaps.cause_of = lambda _failure: cause
    assert bench.session.end_attempt(StepFailed("it went wrong")) is cause
    assert bench.session.disturbed


# ---- setting up ------------------------------------------------------------------------------------------


def test_all_that_a_drive_is_set_up_with(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch, heartbeat_timeout_ms=300)
    found = bench.session.found
    found.period = Duration(2 * NS_PER_MS)
    found.quick_stop_rad_s2, found.quick_stop_option = 70.0, QuickStopOption.SLOW_DOWN_RAMP
    found.override = ScaleOverride(rated_torque_nm=2.0)
    cast(Any, bench.session).capability = capability = cast(Any, object())
    assert bench.session.configure() == ["note 1"]
    assert bench.settings == [
        DriveSettings(
            sync_period_ns=Duration(2 * NS_PER_MS),
            plan=None,
            capability=capability,
            mode=CST,
            coherent=True,
            command_timeout_ms=40,
            drive_heartbeat_ms=100,
            drive_heartbeat_timeout_ms=300,
            host_heartbeat_ms=100,
            host_heartbeat_timeout_ms=300,
            unwatched=False,
            torque_max_nm=LIMITS.torque_nm,
            speed_max_rad_s=1.3 * LIMITS.speed_rad_s,
            set_acceleration_rad_s2=LIMITS.acceleration_rad_s2,
            quick_stop_deceleration_rad_s2=70.0,
            quick_stop_option=QuickStopOption.SLOW_DOWN_RAMP,
            scale=ScaleOverride(rated_torque_nm=2.0),
        )
    ]
    assert bench.session.found.plan is bench.plan
    assert bench.notes == ["armed {} 2000000"]
    port = bench.session.port
    assert (port.mode, port._period_s) == (CST, 0.002)


def test_a_mode_and_a_plan_that_are_given_go_before(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch)
    plan = PdoPlan((), ())
    bench.session.configure(Mode.PROFILE_VELOCITY, plan)
    assert [(each.mode, each.plan) for each in bench.settings] == [(Mode.PROFILE_VELOCITY, plan)]
    assert bench.session.port.mode is Mode.PROFILE_VELOCITY


def test_a_drive_without_a_mode_to_move_it_in_is_not_set_up(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch)
    bench.session.found.modes = (Mode.HOMING,)
    with pytest.raises(StepFailed, match=r"^the drive has no mode in which the bench could move it$"):
        bench.session.configure()
    assert (bench.settings, bench.session.configured) == ([], False)
    assert bench.session.torque_mode() is None


def test_a_drive_that_turns_out_to_be_unwatched_is_set_up_again_with_less(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bench = Bench(monkeypatch, watched=False, unwatched=True)
    assert bench.session.configure() == ["note 2"]
    less = cautious(LIMITS)
    assert [each.torque_max_nm for each in bench.settings] == [LIMITS.torque_nm, less.torque_nm]
    assert bench.settings[1].speed_max_rad_s == 1.3 * less.speed_rad_s
    assert bench.notes == ["armed {} 1000000"]
    assert bench.session.limits == less
    bench.session.configure()
    assert len(bench.settings) == 3


def load_of(plan: PdoPlan, period_us: int, bitrate: int) -> float:
    return budget_of([plan], Duration(period_us * NS_PER_US), bitrate).load_percent


def test_a_period_that_is_asked_for_is_taken_or_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    taken = Bench(monkeypatch, period_us=3000).session.choose_period(CST)
    bench = Bench(monkeypatch, period_us=500)
    assert taken == (3_000_000, load_of(bench.plan, 3000, 1_000_000))
    with pytest.raises(StepFailed) as caught:
        bench.session.choose_period(CST)
    assert (caught.value.summary, caught.value.evidence, caught.value.remedy) == (
        f"the PDOs would take {load_of(bench.plan, 500, 1_000_000):.0f} % of the bus",
        "at a period of 500 us and 1000000 bit/s",
        "give a longer period, or a higher bit rate",
    )


@pytest.mark.parametrize(("period_ms", "settle_ms"), [(1, 20), (6, 20), (7, 21), (20, 60)])
def test_between_syncs_no_late_reading_passes_for_a_later_one(
    monkeypatch: pytest.MonkeyPatch, period_ms: int, settle_ms: int
) -> None:
    session = Bench(monkeypatch).session
    session.found.period = Duration(period_ms * NS_PER_MS)
    timing = session.timing()
    assert (timing.period, timing.settle) == (period_ms * NS_PER_MS, settle_ms * NS_PER_MS)


# ---- what takes its time ---------------------------------------------------------------------------------


def test_while_a_drive_is_enabled_nothing_takes_its_time(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch)
    bench.drive.enabled = True
    with pytest.raises(RuntimeError, match=r"^the drive is enabled: its host has no time for anything else$"):
        bench.session.meanwhile(lambda: 1)
    bench.session.write_log()
    assert bench.notes == ["MainThread"]


def test_in_real_time_the_bus_is_served_while_a_thread_works(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch)
    cast(Any, bench.session).world.real_time = True
    served = threading.Event()

    def pump(until: Instant) -> None:
        bench.now = until
        served.set()

    def work(one: int, *, more: int) -> tuple[bool, int]:
        return served.wait(5.0), one + more

    cast(Any, bench.session).network.pump = pump
    assert bench.session.meanwhile(work, 2, more=3) == (True, 5)
    assert bench.now % (10 * NS_PER_MS) == 0
    bench.session.write_log()
    assert bench.notes != ["MainThread"]


def test_in_simulated_time_work_takes_none(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch)

    def work(one: int, *, more: int) -> int:
        return one + more

    assert bench.session.meanwhile(work, 2, more=3) == 5
    bench.session.write_log()
    assert (bench.notes, bench.now) == (["MainThread"], 0)


def test_while_somebody_thinks_20_ms_pass_and_a_stop_is_heard(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch)
    looked: list[int] = []

    def stop() -> bool:
        looked.append(bench.now)
        return False

    cast(Any, bench.session).stop = stop
    bench.session.idle()
    assert looked == [20 * NS_PER_MS]


def test_a_picture_is_drawn_into_the_folder_of_the_report(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    session, outcome = Bench(monkeypatch).session, StepOutcome()
    session.request = CommissionRequest("hub:x", 5, tmp_path / "out")
    drawn: list[tuple[Path, int]] = []

    def draw(path: Path, figure: int) -> None:
        drawn.append((path, figure))

    for name in ("one", "two"):
        session.picture(outcome, name, draw, 7)
    folder = tmp_path / "out" / "plots"
    assert folder.is_dir()
    assert drawn == [(folder / "one.png", 7), (folder / "two.png", 7)]
    assert outcome.pictures == ["plots/one.png", "plots/two.png"]


def test_a_drive_without_a_watch_is_given_a_fifth_of_the_speed_half_the_torque_and_few_turns() -> None:
    less = cautious(LIMITS)
    speed, torque = 0.2 * LIMITS.speed_rad_s, 0.5 * LIMITS.torque_nm
    less_steep = 0.2 * LIMITS.acceleration_rad_s2
    assert less == replace(
        LIMITS, speed_rad_s=speed, torque_nm=torque, acceleration_rad_s2=less_steep, travel_rad=3.0 * math.tau
    )
    near = cautious(replace(LIMITS, travel_rad=1.0))
    assert near == replace(less, travel_rad=1.0)


def test_what_the_guard_sees_is_recorded_and_told(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(monkeypatch)
    events: list[tuple[str, str, int]] = []
    cast(Any, bench.session).log.event = lambda *event: events.append(event)
    bench.session._tell(Instant(7), "WARN", "a second master")
    assert (events, bench.notes) == ([("WARN", "a second master", 7)], ["    a second master"])
