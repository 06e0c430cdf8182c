"""``hil scope`` beside a tap that looks at the shaft itself each 100 us, while a load turns it."""

import csv
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
import pytest
from typer.testing import CliRunner

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.write_list import NOTHING
from servobench.drivers.errors import BadInput
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S, NS_PER_US, Instant
from servobench.drivers.wire.adapters import parse_bus_spec
from servobench.hil.cli import app
from servobench.hil.configuration.bench_file import faults_from
from servobench.hil.execution.world import WorldPlan, open_world
from servobench.hil.inspecting.scope import BY_SDO, Channel, Key, Scope, key_in, lines_of, seen_all
from servobench.hil.inspecting.scope_files import write_scope
from servobench.virtual_bus.drive.servo import SimulatedServo
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from servobench.virtual_bus.frame import Frame
from tests.motors import LING
from tests.scenario.foreign_node import ForeignNode, put_on_the_bus
from tests.sdo_writes import SdoWrites

SPEED, TORQUE, POSITION, NONE_SUCH = (0x606C, 0), (0x6077, 0), (0x6064, 0), (0x3999, 1)
SYNC_S: Final = 0.004
STEP_NS: Final = 100 * NS_PER_US


class ShaftTap:
    """Knows the speed at any instant, rad/s, by the shaft."""

    def __init__(self, servo: SimulatedServo) -> None:
        self.wake_at: Instant | None = None
        self.at: list[Instant] = []
        self.speeds: list[float] = []
        self._inner = servo.drive.firmware.inner

    def start(self, now: Instant) -> Sequence[Frame]:
        self.wake_at = now
        return ()

    def receive(self, frame: Frame, now: Instant) -> Sequence[Frame]:
        del frame, now
        return ()

    def wake(self, now: Instant) -> Sequence[Frame]:
        self._inner.load_nm = -0.2 * math.cos(40.0 * now / NS_PER_S)
        self.wake_at = Instant(now + STEP_NS)
        self.at.append(now)
        self.speeds.append(self._inner.speed_rad_s)
        return ()

    def between(self, first: float, last: float) -> tuple[float, float]:
        """Return the least and the greatest speed between two instants."""
        at, speeds = np.array(self.at), np.array(self.speeds)
        low, high = np.searchsorted(at, [first - STEP_NS, last + STEP_NS])
        return float(speeds[low : high + 1].min()), float(speeds[low : high + 1].max())


class Scene:
    """A bus with a turning drive, a master that sends SYNC or none, and those who look on."""

    def __init__(self, network: CanopenNetwork, tap: ShaftTap, heard: SdoWrites) -> None:
        self.network, self.tap, self.heard = network, tap, heard

    def watch(self, *keys: Key, by_sdo: bool = False, seconds: float = 0.3) -> list[Channel]:
        return Scope(self.network, 1, keys, None, by_sdo).watch(seconds, lambda: False)


@contextmanager
def scene(sync: bool = True, faults: dict[str, Any] | None = None) -> Iterator[Scene]:
    servo = SimulatedServo(1, LING, DriveParameters(brake_torque_nm=0.0, clock_offset_us=0))
    injected = None if faults is None else faults_from(faults, "x")
    plan = WorldPlan(parse_bus_spec("simulated"), 1_000_000, False, injected)
    tap, heard = ShaftTap(servo), SdoWrites()
    with open_world(plan, [servo]) as world:
        others = [ForeignNode(Frame(0x000, b"\x01\x00"), 0.05)]
        if sync:
            others.append(ForeignNode(Frame(0x080, b""), 0.1, 10_000, SYNC_S))
        put_on_the_bus(world, tap, heard, *others)
        world.faults.start(world.clock.now())
        world.clock.sleep_until(Instant(90 * NS_PER_MS))
        yield Scene(CanopenNetwork(world.link, world.clock, writes=NOTHING), tap, heard)


QUANTUM: Final = 0.4
"""Of 606Ch, rad/s: a count in a tick is 1.5, which its filter of 500 Hz leaves a quarter of."""
FILTER_NS: Final = 2 * NS_PER_MS
"""So long that filter remembers."""


def test_the_instant_of_an_answer_lies_within_what_is_told() -> None:
    with scene() as seen:
        (speed,) = seen.watch(SPEED, by_sdo=True)
        assert speed.source == BY_SDO
        assert len(speed.values) > 100
        for at, within, value in zip(speed.at, speed.within, speed.values, strict=True):
            low, high = seen.tap.between(at - within - FILTER_NS, at + within)
            assert low - QUANTUM <= value <= high + QUANTUM
        assert max(speed.values) - min(speed.values) > 5.0, "or nothing was asked"


def test_the_drive_s_own_clock_was_read_within_the_interval_that_is_told() -> None:
    """1013h in us since power-on, which was at 0: no two instants of it fit another interval."""
    with scene() as seen:
        (clock,) = seen.watch((0x1013, 0), by_sdo=True)
        assert len(clock.values) > 100
        for at, within, raw in zip(clock.at, clock.within, clock.values, strict=True):
            read_ns = raw * (1e9 if clock.unit == "s" else 1e3)
            assert at - within - 1e3 <= read_ns <= at + within


def test_what_comes_in_pdos_is_taken_from_them_with_every_sync() -> None:
    with scene() as seen:
        speed, position = seen.watch(SPEED, POSITION, seconds=0.4)
        assert (speed.source, position.source) == ("TPDO1", "TPDO2")
        assert speed.rate_hz == pytest.approx(1.0 / SYNC_S, rel=1e-3)
        assert speed.gap_s == pytest.approx(SYNC_S, abs=1e-4)
        assert (speed.unit, position.unit) == ("rad/s", "rad")
        for at, value in zip(speed.at, speed.values, strict=True):
            low, high = seen.tap.between(at - FILTER_NS, at)
            assert low - QUANTUM <= value <= high + QUANTUM
        assert "by TPDO1, 250 a second, 4 ms apart at most" in lines_of([speed])[0]


def test_nothing_is_written() -> None:
    with scene() as seen:
        seen.watch(SPEED, TORQUE, NONE_SUCH)
        seen.watch(SPEED, by_sdo=True)
        assert seen.heard.objects == set()


def test_an_object_whose_pdo_does_not_come_is_asked_for_by_sdo() -> None:
    with scene(sync=False) as seen:
        channels = seen.watch(SPEED, TORQUE)
        assert seen_all(channels)
        for each in channels:
            assert (each.source, each.silent, each.as_json()["silent"]) == (BY_SDO, "TPDO1", "TPDO1")
        assert "by SDO (no TPDO1 came: not operational, or no SYNC)" in lines_of(channels)[0]
        for at, within, value in zip(channels[0].at, channels[0].within, channels[0].values, strict=True):
            low, high = seen.tap.between(at - within - FILTER_NS, at + within)
            assert low - QUANTUM <= value <= high + QUANTUM


def test_an_object_that_is_refused_is_named_and_the_others_are_watched() -> None:
    with scene() as seen:
        refused, speed = seen.watch(NONE_SUCH, SPEED)
        assert "06020000h" in refused.lack
        assert speed.values
        assert not seen_all([refused, speed])


def test_what_was_seen_before_the_bus_is_lost_is_kept() -> None:
    with scene(faults={"link_down": [{"at_s": 0.25, "duration_s": 1000.0}]}) as seen:
        watch = Scope(seen.network, 1, [SPEED], None, by_sdo=True)
        (speed,) = watch.watch(2.0, lambda: False)
        assert watch.ended_by is not None
        assert len(speed.values) > 30


def test_a_stop_ends_it_with_what_was_seen() -> None:
    with scene() as seen:
        watch = Scope(seen.network, 1, [SPEED], None, by_sdo=True)
        end = seen.network.clock.now() + 100 * NS_PER_MS
        (speed,) = watch.watch(60.0, lambda: seen.network.clock.now() > end)
        assert watch.ended_by is None
        assert 30 < len(speed.values) < 200


def test_samples_picture_and_page(tmp_path: Path) -> None:
    with scene() as seen:
        channels = seen.watch(SPEED, TORQUE, (0x1018, 4))
    files = write_scope(tmp_path / "seen", channels, "Node 1 on <bus>")
    assert [each.name for each in files] == ["samples.csv", "scope.png", "scope.html"]
    with files[0].open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == sum(len(each.values) for each in channels)
    times = [float(row["time_s"]) for row in rows]
    assert times == sorted(times)
    assert times[0] == 0.0
    speeds = [float(row["value"]) for row in rows if row["object"] == "606Ch:00"]
    assert speeds == channels[0].values
    page = files[2].read_text(encoding="utf-8")
    assert "Node 1 on &lt;bus&gt;" in page
    assert "Velocity actual value" in page
    with pytest.raises(BadInput, match="a folder without one"):
        write_scope(tmp_path / "seen", channels, "again")


@pytest.mark.parametrize(
    ("text", "key"), [("6077", TORQUE), ("2101:1F", (0x2101, 0x1F)), ("606Ch:00", SPEED)]
)
def test_objects_are_hexadecimal(text: str, key: Key) -> None:
    assert key_in(text) == key


@pytest.mark.parametrize("text", ["", "77", "6077.0", "60777", "6077:100", "speed"])
def test_what_is_no_object_is_refused(text: str) -> None:
    with pytest.raises(BadInput, match="an index in hexadecimal"):
        key_in(text)


@pytest.mark.parametrize("words", [("--object", "speed"), ("--object", "606C", "--eds", "none.eds")])
def test_bad_words_are_refused_before_the_bus_is_opened(words: tuple[str, ...]) -> None:
    done = CliRunner().invoke(app, ["scope", "--bus", "hub:nobody", "--node", "1", *words])
    assert done.exit_code == BadInput.exit_status
    assert words[-2] in done.output or words[-1] in done.output
