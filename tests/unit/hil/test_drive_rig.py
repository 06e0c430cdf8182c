"""The drive of the pytest plugin with its master, in simulated time, in this process."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from servobench.drivers.canopen.write_list import UnlistedWrite
from servobench.drivers.cia402.profile import State
from servobench.drivers.errors import BadInput, PeerFault, PowerLost
from servobench.drivers.exchange import Reading
from servobench.drivers.timebase import NS_PER_MS, NS_PER_S
from servobench.hil.configuration.motor_file import LING2012
from servobench.hil.testing.drive_rig import DriveRig, drive_rig
from servobench.hil.testing.hosted import DriveHost, DriveWish

Make = Callable[..., DriveRig]
STO = {"safe_torque_off": [{"nodes": [1], "at_s": 0.3, "duration_s": 5.0}]}


@pytest.fixture
def make(tmp_path: Path) -> Iterator[Make]:
    with ExitStack() as stack:
        host = DriveHost("simulated", tmp_path)
        yield lambda **wish: stack.enter_context(drive_rig("simulated", host, DriveWish(**wish)))


def test_the_settings_are_the_motors_ratings(make: Make) -> None:
    rig = make(node=3)
    settings = rig.settings
    assert settings.sync_period_ns == rig.period == NS_PER_MS
    assert (settings.host_heartbeat_ms, settings.host_heartbeat_timeout_ms) == (100, 1000)
    assert (settings.drive_heartbeat_ms, settings.drive_heartbeat_timeout_ms) == (100, 1000)
    assert settings.torque_max_nm == LING2012.rating.torque_nm
    assert settings.speed_max_rad_s == pytest.approx(157.0796, rel=1e-6)
    assert (rig.node, rig.process, rig.motor) == (3, None, LING2012)
    assert rig.device is not None


def test_a_drive_is_enabled_run_and_left_at_rest(make: Make) -> None:
    rig = make()
    assert rig.state() is State.SWITCH_ON_DISABLED
    rig.enable()
    assert rig.state() is State.OPERATION_ENABLED
    began = rig.clock.now()
    readings = rig.run(0.25, torque_nm=0.5)
    assert rig.clock.now() - began == 250 * NS_PER_MS
    assert len(readings) == 250
    # w = T / J t, as the friction of 1.85e-3 N m s/rad takes little in so short a time
    speeds = [reading.velocity_rad_s for reading in readings]
    assert speeds[0] == pytest.approx(0.0, abs=0.2)
    assert speeds[100] == pytest.approx(0.5 / LING2012.mechanics.inertia_kg_m2 * 0.1, rel=0.15)
    assert speeds == sorted(speeds)
    rig.release()
    assert rig.state() is State.SWITCH_ON_DISABLED


def test_a_torque_may_answer_the_reading(make: Make) -> None:
    rig = make()
    rig.enable()
    seen: list[Reading] = []

    def brake(reading: Reading) -> float:
        seen.append(reading)
        return -0.05 * reading.velocity_rad_s

    rig.run(0.1, torque_nm=0.5)
    slowed = rig.run(0.2, torque_nm=brake)
    assert seen == slowed
    assert abs(slowed[-1].velocity_rad_s) < 0.02 * slowed[0].velocity_rad_s


def test_a_set_up_tells_what_it_wrote_and_takes_changes(make: Make) -> None:
    rig = make(node=2)
    said = rig.configure(torque_max_nm=1.0)
    assert said == ["TPDO1 written", "TPDO2 written", "TPDO3 written"]
    rated = LING2012.rating.torque_nm
    assert rig.device is not None
    assert rig.device.dictionary.variable(0x6072).value == round(1000 * 1.0 / rated)


def test_a_test_writes_a_further_object_once_it_has_said_so(make: Make) -> None:
    rig = make()
    index_pulse = (0x2110, 7)
    rig.configure()
    with pytest.raises(UnlistedWrite, match="a fixture of pytest: SDO write: found '2110h:07 of node 1'"):
        rig.client.objects.write(*index_pulse, "I", 5)
    rig.allow_write(*index_pulse)
    rig.client.objects.write(*index_pulse, "I", 5)
    assert rig.client.objects.read(*index_pulse) == 5
    rig.allow_write(0x605D)
    rig.client.objects.write(0x605D, 0, "h", 2)


def test_how_long_a_state_took_is_returned(make: Make) -> None:
    rig = make(faults=STO)
    rig.enable()
    began = rig.clock.now()
    took_s = rig.assert_reaches(State.SWITCH_ON_DISABLED, within_s=1.0)
    assert 0.05 < took_s < 0.3, "some of the 0.3 s went by while the drive was enabled"
    assert took_s == pytest.approx((rig.clock.now() - began) / NS_PER_S)
    rig.assert_stays(State.SWITCH_ON_DISABLED, for_s=0.2)


def test_a_state_that_is_not_reached_names_those_that_were(make: Make) -> None:
    rig = make(faults=STO)
    rig.enable()
    with pytest.raises(AssertionError) as caught:
        rig.assert_reaches(State.FAULT, within_s=0.5)
    assert str(caught.value) == (
        "node 1: not in 'fault' after 0.5 s; it was in 'operation enabled', then in 'switch on disabled'"
    )
    with pytest.raises(
        AssertionError, match=r"^node 1: 'switch on disabled' after 0.000 s, to stay in 'fault'"
    ):
        rig.assert_stays(State.FAULT, for_s=0.1)


def test_a_state_that_is_left_is_told_with_the_instant(make: Make) -> None:
    rig = make(faults=STO)
    rig.enable()
    with pytest.raises(AssertionError, match=r"'switch on disabled' after 0\.\d{3} s, to stay in 'operation"):
        rig.assert_stays(State.OPERATION_ENABLED, for_s=1.0)


def test_a_run_ends_where_the_drive_does(make: Make) -> None:
    rig = make(faults=STO)
    rig.enable()
    with pytest.raises(PowerLost, match="lost the power of its stage"):
        rig.run(1.0)
    assert rig.state() is State.SWITCH_ON_DISABLED


def test_time_passes_for_as_long_as_is_waited(make: Make) -> None:
    rig = make()
    began = rig.clock.now()
    assert rig.deadline(0.4) - began == 400 * NS_PER_MS
    rig.wait(0.4)
    assert rig.clock.now() - began == 400 * NS_PER_MS


def test_frames_beyond_the_plan_are_unintended(make: Make) -> None:
    rig = make()
    with pytest.raises(ValueError, match="the drive was not configured: no PDO is intended yet"):
        rig.assert_no_unintended_frame()
    rig.enable()
    rig.run(0.05)
    rig.assert_no_unintended_frame()
    rig.network.link.send(0x123, b"\1")
    rig.wait(0.01)
    with pytest.raises(AssertionError, match="123#01"):
        rig.assert_no_unintended_frame()
    rig.assert_no_unintended_frame(allow=("123#*",))


def test_controlwords_are_those_of_the_walk(make: Make) -> None:
    rig = make()
    rig.configure()
    rig.wire.clear()
    rig.assert_controlwords()
    with pytest.raises(AssertionError, match=r"^node 1: controlwords 0006h expected, the host sent none$"):
        rig.assert_controlwords(0x06)
    rig.enable()
    rig.assert_controlwords(0x06, 0x07, 0x0F)
    with pytest.raises(AssertionError) as caught:
        rig.assert_controlwords()
    first, *lines = str(caught.value).splitlines()
    assert first == "node 1: controlwords none expected, the host sent:"
    assert [line.split()[-1] for line in lines] == ["0006h", "0007h", "000Fh"]


def test_a_wish_is_read_from_files(tmp_path: Path) -> None:
    plan = tmp_path / "plan.toml"
    plan.write_text("[[loss]]\nprobability = 0.5\n")
    wish = DriveWish(faults=plan)
    assert wish.plan is not None
    assert DriveWish().plan is None
    assert DriveWish().motor_file is LING2012
    plan.write_text("[[loss]]\nprobability = 2\n")
    with pytest.raises(BadInput, match="probability"):
        _ = wish.plan
    motor = Path(__file__).parents[3] / "examples" / "motors" / "azaiz2007.toml"
    assert DriveWish(motor=motor).motor_file.parameters.name != LING2012.parameters.name


class Commands:
    """What a host would start, in place of processes."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, complaint: str = "") -> None:
        self.given: list[list[str]] = []

        class Process:
            def __init__(process, command: list[str], log: Path) -> None:  # noqa: N805
                self.given.append([*command, log.name])

            def finish(process) -> str:  # noqa: N805
                return complaint

        monkeypatch.setattr("servobench.hil.testing.hosted.DriveProcess", Process)


def test_the_command_of_a_process_says_all_that_was_wished(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    commands, host = Commands(monkeypatch), DriveHost("hub:x", tmp_path)
    assert host.missing([1, 2]) == [1, 2]
    host.start([1, 2], DriveWish(motor="m.toml", seed=7, bitrate_bit_s=250_000))
    assert host.missing([1, 2, 3]) == [3]
    wish = DriveWish(faults={"loss": [{"probability": 0.5}]}, eds="a.eds", store="s.json")
    host.start([3], wish, {3: "load.csv"})
    one, two = commands.given
    assert one[-10:] == [
        "hub:x", "--node", "1,2", "--motor", "m.toml", "--seed", "7", "--bitrate", "250000", "drive-1.log",
    ]  # fmt: skip
    motor, faults = tmp_path / "motor-2.toml", tmp_path / "faults-2.toml"
    assert two[two.index("--motor") : -1] == [
        "--motor", str(motor), "--seed", "0", "--bitrate", "1000000", "--faults", str(faults),
        "--eds", "a.eds", "--store", "s.json", "--load", "3=load.csv",
    ]  # fmt: skip
    assert "probability = 0.5" in faults.read_text()
    assert "Ling2012" in motor.read_text()
    assert DriveHost("hub:x", tmp_path, present=True).missing([1]) == []
    host.end()


def test_a_process_that_failed_fails_the_test(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    Commands(monkeypatch, "it ended with status 3")
    host = DriveHost("hub:x", tmp_path)
    host.start([1], DriveWish(motor="m.toml"))
    with pytest.raises(PeerFault, match="a simulated drive on hub:x failed; it ended with status 3"):
        host.end()
    host.end()
