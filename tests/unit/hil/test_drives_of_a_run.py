"""The drives of a run: how long they are waited for, what each is told, and in which order they stop."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final, cast

import pytest

from servobench.drivers.cia402.drive_setup import DriveSettings, Identity, Observed
from servobench.drivers.cia402.profile import Mode, QuickStopOption
from servobench.drivers.cia402.servo import ServoDrive
from servobench.drivers.errors import BadInput, NoAnswer, PeerFault
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.drivers.sheets.dictionary import held
from servobench.drivers.timebase import NS_PER_MS, Duration, Instant
from servobench.hil.configuration.bench_file import load_bench
from servobench.hil.execution.assembly import loop_timing
from servobench.hil.execution.drive_session import connect, data_sheets, drive_settings, stop_all
from servobench.hil.machine.stopping import Interrupted, StopRequest
from tests.unit.drivers.eds_maker import four_pdos, sheet_text
from tests.unit.hil.test_commissioned_drive import FILE, drive_file

EXAMPLE: Final = Path(__file__).parents[3] / "examples" / "ling2012.toml"
IDENTITY: Final = Identity("made", 1, 2, 3, 4, 0x20192)
SLICE: Final = 300 * NS_PER_MS


# ---- waiting --------------------------------------------------------------------------------------------


class Answering:
    """A drive, and its network, that answers the ``answers``-th time it is asked; one asking takes 100 ms."""

    def __init__(self, answers: int = 10**9, stop: StopRequest | None = None, stop_at: int = 10**9) -> None:
        self.at = 1000 * NS_PER_MS
        self.network = self.clock = self
        self.asked: list[tuple[int, int]] = []
        """When, and until when it was to answer."""
        self.pumped: list[int] = []
        self._answers, self._stop, self._stop_at = answers, stop, stop_at

    def now(self) -> Instant:
        return Instant(self.at)

    def deadline_after(self, span: Duration) -> Instant:
        return Instant(self.at + span)

    def pump(self, until: Instant) -> None:
        self.pumped.append(until)
        self.at = max(self.at, until)

    def connect(self, deadline: Instant) -> Identity:
        self.asked.append((self.at - 1000 * NS_PER_MS, deadline - 1000 * NS_PER_MS))
        if len(self.asked) >= self._stop_at and self._stop is not None:
            self._stop.ask("SIGINT")
        self.at = min(deadline, self.at + 100 * NS_PER_MS)
        if len(self.asked) < self._answers:
            raise NoAnswer("nobody is there")
        return IDENTITY


def wait_for(drive: Answering, timeout_s: float, stop: StopRequest | None = None) -> Identity:
    return connect(cast(ServoDrive, drive), timeout_s, stop or StopRequest())


def test_a_drive_that_answers_is_not_waited_for() -> None:
    drive = Answering(1)
    assert wait_for(drive, 3.0) == IDENTITY
    assert (drive.asked, drive.pumped) == ([(0, SLICE)], [])


def test_a_drive_that_boots_is_asked_every_third_of_a_second() -> None:
    drive = Answering(3)
    assert wait_for(drive, 3.0) == IDENTITY
    assert drive.asked == [(0, SLICE), (SLICE, 2 * SLICE), (2 * SLICE, 3 * SLICE)]
    assert [at - 1000 * NS_PER_MS for at in drive.pumped] == [SLICE, 2 * SLICE]


@pytest.mark.parametrize(
    ("timeout_ms", "asked"),
    [(100, [(0, 100)]), (300, [(0, 300), (300, 300)]), (350, [(0, 300), (300, 350)])],
)
def test_a_drive_is_waited_for_no_longer_than_the_bench_says(
    timeout_ms: int, asked: list[tuple[int, int]]
) -> None:
    drive = Answering()
    with pytest.raises(NoAnswer):
        wait_for(drive, timeout_ms / 1000)
    assert drive.asked == [(at * NS_PER_MS, until * NS_PER_MS) for at, until in asked]
    assert drive.at == (1000 + timeout_ms) * NS_PER_MS


@pytest.mark.parametrize("stop_at", [0, 2])
def test_a_stop_ends_the_wait_at_the_next_asking(stop_at: int) -> None:
    stop = StopRequest()
    drive = Answering(stop=stop, stop_at=stop_at)
    if stop_at == 0:
        stop.ask("SIGINT")
    with pytest.raises(Interrupted) as caught:
        wait_for(drive, 3.0, stop)
    assert str(caught.value) == "ended by SIGINT"
    assert len(drive.asked) == stop_at


# ---- data sheets and settings ---------------------------------------------------------------------------


def bench_with(**changes: Any) -> Any:
    """The example, whose drive has been changed so."""
    config = load_bench(EXAMPLE)
    return config.model_copy(update={"drive": {"axis1": config.drive["axis1"].model_copy(update=changes)}})


def test_the_data_sheets_of_the_axes_that_name_one_are_read(tmp_path: Path) -> None:
    path = tmp_path / "drive.eds"
    path.write_text(sheet_text(four_pdos()))
    assert data_sheets(load_bench(EXAMPLE)) == {}
    (sheet,) = data_sheets(bench_with(eds=str(path), node=5)).values()
    assert held(sheet.dictionary, 0x1400, 1) == 0x205
    assert list(data_sheets(bench_with(eds=str(path)))) == ["axis1"]
    with pytest.raises(BadInput):
        data_sheets(bench_with(eds=str(tmp_path / "gone.eds")))


def test_a_drive_is_told_what_its_bench_says() -> None:
    config = load_bench(EXAMPLE)
    drive, host = config.drive["axis1"], config.host
    limits = drive.limits.model_copy(update={"quick_stop_deceleration_rpm_s": 600.0})
    changed = bench_with(limits=limits, heartbeat_ms=70, heartbeat_timeout_ms=210, unwatched=True)
    assert drive_settings(changed, "axis1", loop_timing(config), None) == DriveSettings(
        sync_period_ns=config.loop.period,
        mode=Mode.CYCLIC_SYNCHRONOUS_TORQUE,
        synchronous_command=False,
        position_every_cycles=config.loop.position_every_cycles,
        coherent=False,
        command_timeout_ms=min(100, host.heartbeat_timeout_ms),
        demand_changes=config.loop.command_readback == "event",
        observed=Observed((), 1),
        drive_heartbeat_ms=70,
        drive_heartbeat_timeout_ms=210,
        host_heartbeat_ms=host.heartbeat_ms,
        host_heartbeat_timeout_ms=host.heartbeat_timeout_ms,
        unwatched=True,
        torque_max_nm=limits.torque_max_nm,
        speed_max_rad_s=limits.speed_max_rpm * RAD_S_PER_RPM,
        quick_stop_deceleration_rad_s2=600.0 * RAD_S_PER_RPM,
        quick_stop_option=QuickStopOption.QUICK_STOP_RAMP,
    )


def test_a_commissioned_drive_stops_and_counts_as_its_file_says(tmp_path: Path) -> None:
    file = drive_file(tmp_path, f"{FILE}\n[stop]\noption = 3\n")
    config = bench_with(commissioned=file)
    settings = drive_settings(config, "axis1", loop_timing(config), None)
    assert settings.quick_stop_option is QuickStopOption(3)
    assert settings.scale == file.override


# ---- the end --------------------------------------------------------------------------------------------


def test_each_drive_is_stopped_by_its_command_first_and_then_asked() -> None:
    told: list[tuple[str, bool]] = []

    def drive(name: str, fails: bool) -> ServoDrive:
        def stop(*, asking: bool) -> None:
            told.append((name, asking))
            if fails:
                raise PeerFault("it is silent")

        return cast(ServoDrive, SimpleNamespace(stop=stop))

    stop_all([drive("first", True), drive("second", False)])
    assert told == [("first", False), ("second", False), ("first", True), ("second", True)]
