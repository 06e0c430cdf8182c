"""SYNC, heartbeat, guarding, EMCY and error behaviour (CiA 301, 7.2.5, 7.2.7, 7.2.8)."""

import pytest

from servobench.drivers.canopen.error_codes import ErrorRegister
from servobench.drivers.canopen.nmt_states import NmtState
from servobench.drivers.timebase import Instant
from servobench.virtual_bus.device.device_options import DeviceOptions
from servobench.virtual_bus.device.sdo_abort import AbortCode
from servobench.virtual_bus.device.station import CommunicationLoss
from servobench.virtual_bus.frame import Frame
from tests.unit.virtual_bus.device_bench import (
    DEFAULTS,
    NODE,
    PRE_OPERATIONAL,
    RESET_COMMUNICATION,
    RESET_NODE,
    START,
    STOP,
    Bench,
    SdoRefused,
    operational,
)

MS = 1_000_000
MASTER = 127
HEARTBEAT = 0x700 + NODE
EMCY = 0x80 + NODE


def post(bench: Bench, code: int, register: ErrorRegister, information: bytes = b"") -> list[Frame]:
    """The application raises an error; frames that this sends."""
    before = len(bench.sent)
    bench.act()
    bench.device.raise_error(code, register, information)
    bench.run_until_ms(bench.now / MS)
    return [frame for _, frame in bench.sent[before:]]


def clear(bench: Bench, code: int) -> list[Frame]:
    before = len(bench.sent)
    bench.act()
    bench.device.clear_error(code)
    bench.run_until_ms(bench.now / MS)
    return [frame for _, frame in bench.sent[before:]]


def guarded(behaviour: int = 0) -> Bench:
    """OPERATIONAL, watching the master's heartbeat with 150 ms, heard at instant 0."""
    bench = operational()
    bench.write(0x1016, 1, MASTER << 16 | 150, 4)
    bench.write(0x1029, 1, behaviour, 1)
    bench.put(0x700 + MASTER, b"\x05")
    return bench


def test_heartbeat_begins_when_it_is_set_and_tells_the_state() -> None:
    bench = Bench()
    bench.run_until_ms(3)
    bench.write(0x1017, 0, 10, 2)
    assert Frame(HEARTBEAT, b"\x7f") in [frame for _, frame in bench.sent]
    bench.nmt(START)
    assert bench.run_until_ms(24) == [
        (13 * MS, Frame(HEARTBEAT, b"\x05")),
        (23 * MS, Frame(HEARTBEAT, b"\x05")),
    ]
    bench.nmt(STOP)
    assert bench.run_until_ms(34) == [(33 * MS, Frame(HEARTBEAT, b"\x04"))]


def test_boot_up_counts_as_the_first_heartbeat() -> None:
    bench = Bench(DeviceOptions(heartbeat_ms=10))
    assert [at for at, _ in bench.run_until_ms(25)] == [10 * MS, 20 * MS]


def test_heartbeat_ends_with_zero() -> None:
    bench = Bench(DeviceOptions(heartbeat_ms=10))
    bench.write(0x1017, 0, 0, 2)
    assert bench.run_until_ms(100) == []


def test_a_late_host_does_not_make_up_for_missed_heartbeats() -> None:
    bench = Bench(DeviceOptions(heartbeat_ms=10))
    bench.now = Instant(95 * MS)
    assert len(bench.device.wake(bench.now)) == 1
    assert bench.device.wake_at == 105 * MS


@pytest.mark.parametrize(
    ("behaviour", "state"),
    [(0, NmtState.PRE_OPERATIONAL), (1, NmtState.OPERATIONAL), (2, NmtState.STOPPED)],
)
def test_lost_heartbeat(behaviour: int, state: NmtState) -> None:
    bench = guarded(behaviour)
    bench.run_until_ms(100)
    bench.put(0x700 + MASTER, b"\x05")
    ((at, emergency),) = bench.run_until_ms(400)
    assert (at, emergency) == (250 * MS, Frame(EMCY, b"\x30\x81\x11\x7f\x00\x00\x00\x00"))
    assert ("loss", CommunicationLoss.HEARTBEAT, MASTER, 250 * MS) in bench.application.calls
    assert bench.device.state is state


def test_heartbeat_that_comes_back_clears_the_error() -> None:
    bench = guarded()
    bench.run_until_ms(400)
    assert bench.put(0x700 + MASTER, b"\x05") == [Frame(EMCY, bytes(8))]
    assert [at for at, _ in bench.run_until_ms(1000)] == [550 * MS]


def test_watching_begins_with_the_first_heartbeat() -> None:
    bench = operational()
    bench.write(0x1016, 1, MASTER << 16 | 150, 4)
    assert bench.run_until_ms(1000) == []


def test_pre_operational_is_kept_on_a_lost_heartbeat_with_behaviour_0() -> None:
    bench = guarded()
    bench.nmt(PRE_OPERATIONAL)
    bench.run_until_ms(400)
    assert bench.device.state is NmtState.PRE_OPERATIONAL


def test_several_nodes_are_watched_apart() -> None:
    bench = guarded(behaviour=1)
    bench.write(0x1016, 2, 9 << 16 | 50, 4)
    bench.put(0x709, b"\x05")
    ((at, first),) = bench.run_until_ms(100)
    assert (at, first.data[3]) == (50 * MS, 9)
    ((at, second),) = bench.run_until_ms(200)
    assert (at, second.data[3]) == (150 * MS, MASTER)
    (partly,) = bench.put(0x709, b"\x05")
    assert partly.data[:3] == b"\x00\x00\x11"


def test_consumer_times_are_checked() -> None:
    bench = guarded()
    assert bench.refused(0x1016, 2, MASTER << 16 | 10, 4) == AbortCode.PARAMETER_INCOMPATIBLE
    assert bench.refused(0x1016, 2, 128 << 16 | 10, 4) == AbortCode.INVALID_VALUE
    bench.write(0x1016, 2, MASTER << 16, 4)
    bench.write(0x1016, 1, MASTER << 16 | 20, 4)


def test_error_behaviour_is_checked() -> None:
    assert Bench().refused(0x1029, 1, 3, 1) == AbortCode.INVALID_VALUE


def test_node_guarding_answers_with_a_toggle_bit() -> None:
    bench = Bench()
    answers = [bench.put(HEARTBEAT, remote=True)[0].data for _ in range(3)]
    assert answers == [b"\x7f", b"\xff", b"\x7f"]
    bench.nmt(RESET_COMMUNICATION)
    assert bench.put(HEARTBEAT, remote=True)[0].data == b"\x7f"


def test_node_guarding_is_off_while_heartbeats_are_on() -> None:
    bench = Bench(DeviceOptions(heartbeat_ms=10))
    assert bench.put(HEARTBEAT, remote=True) == []


def test_life_guarding_runs_from_the_first_request() -> None:
    bench = operational()
    bench.write(0x100C, 0, 20, 2)
    bench.write(0x100D, 0, 3, 1)
    assert bench.run_until_ms(200) == []
    bench.put(HEARTBEAT, remote=True)
    ((at, emergency),) = bench.run_until_ms(500)
    assert (at, emergency.data[:2]) == (260 * MS, b"\x30\x81")
    assert bench.device.state is NmtState.PRE_OPERATIONAL
    assert ("loss", CommunicationLoss.LIFE_GUARDING, 0, 260 * MS) in bench.application.calls
    assert [frame.can_id for frame in bench.put(HEARTBEAT, remote=True)] == [HEARTBEAT, EMCY]


def test_emergency_and_its_end() -> None:
    bench = Bench()
    raised = post(bench, 0x2310, ErrorRegister.CURRENT, b"\x01\x02\x03\x04\x05")
    assert raised == [Frame(EMCY, b"\x10\x23\x03\x01\x02\x03\x04\x05")]
    assert post(bench, 0x2310, ErrorRegister.CURRENT) == []
    assert post(bench, 0x3210, ErrorRegister.VOLTAGE) == [Frame(EMCY, b"\x10\x32\x07" + bytes(5))]
    assert bench.read(0x1001) == 0x07
    assert clear(bench, 0x2310) == [Frame(EMCY, b"\x00\x00\x05" + bytes(5))]
    assert clear(bench, 0x3210) == [Frame(EMCY, bytes(8))]
    assert clear(bench, 0x3210) == []
    assert bench.read(0x1001) == 0


def test_error_history_is_newest_first_and_cleared_by_zero() -> None:
    bench = Bench()
    for code in range(0x1001, 0x100B):
        post(bench, code, ErrorRegister.GENERIC, b"\x34\x12")
    assert bench.read(0x1003, 0) == 8
    assert bench.read(0x1003, 1) == 0x1234100A
    assert bench.read(0x1003, 8) == 0x12341003
    assert bench.refused(0x1003, 0, 1, 1) == AbortCode.INVALID_VALUE
    bench.write(0x1003, 0, 0, 1)
    assert bench.read(0x1003, 0) == 0
    with pytest.raises(SdoRefused) as error:
        bench.read(0x1003, 1)
    assert error.value.code == AbortCode.NO_DATA


def test_emergency_inhibit_time() -> None:
    bench = Bench()
    bench.write(0x1015, 0, 100, 2)
    assert len(post(bench, 0x1001, ErrorRegister.GENERIC)) == 1
    assert post(bench, 0x1002, ErrorRegister.GENERIC) == []
    assert post(bench, 0x1003, ErrorRegister.GENERIC) == []
    assert [(at, frame.data[0]) for at, frame in bench.run_until_ms(100)] == [(10 * MS, 2), (20 * MS, 3)]


def test_emergency_waits_while_stopped() -> None:
    bench = Bench()
    bench.nmt(STOP)
    assert post(bench, 0x1001, ErrorRegister.GENERIC) == []
    assert [frame.can_id for frame in bench.nmt(START)] == [EMCY]


def test_emergency_that_is_switched_off_or_moved() -> None:
    bench = Bench()
    assert bench.refused(0x1014, 0, 0x99, 4) == AbortCode.INVALID_VALUE
    bench.write(0x1014, 0, 1 << 31 | EMCY, 4)
    assert post(bench, 0x1001, ErrorRegister.GENERIC) == []
    assert bench.read(0x1003, 1) == 0x1001
    bench.write(0x1014, 0, 0x99, 4)
    assert post(bench, 0x1002, ErrorRegister.GENERIC)[0].can_id == 0x99


def test_resets_forget_what_is_theirs() -> None:
    bench = guarded(behaviour=1)
    bench.run_until_ms(400)
    post(bench, 0x2310, ErrorRegister.CURRENT)
    bench.nmt(RESET_COMMUNICATION)
    assert bench.read(0x1001) == 0x03
    bench.nmt(RESET_NODE)
    assert (bench.read(0x1001), bench.read(0x1003, 0)) == (0, 0)


def test_error_present_at_power_on_is_told_after_boot_up() -> None:
    bench = Bench()
    bench.application.error_at_reset = 0x3120
    assert [frame.can_id for frame in bench.nmt(RESET_NODE)] == [HEARTBEAT, EMCY]
    assert bench.read(0x1001) == 0x01


def test_sync_with_a_counter_that_is_not_expected_is_told_once_and_taken() -> None:
    bench = operational()
    emergency, tpdo = bench.sync(1)
    assert (emergency.data[:3], tpdo.can_id) == (b"\x40\x82\x11", 0x180 + NODE)
    assert [frame.can_id for frame in bench.sync(2)] == [0x180 + NODE]
    cleared, tpdo = bench.sync()
    assert (cleared.data[:3], tpdo.can_id) == (bytes(3), 0x180 + NODE)


def test_sync_counter_reaches_the_application() -> None:
    bench = operational()
    bench.write(0x1019, 0, 4, 1)
    bench.sync(3)
    assert bench.application.calls[-1] == ("sync", 3, 0)


def test_sync_parameters_are_checked() -> None:
    bench = Bench()
    assert bench.refused(0x1005, 0, 1 << 30 | 0x80, 4) == AbortCode.INVALID_VALUE
    assert bench.refused(0x1005, 0, 1 << 29 | 0x80, 4) == AbortCode.INVALID_VALUE
    assert bench.refused(0x1005, 0, 0x701, 4) == AbortCode.INVALID_VALUE
    assert bench.refused(0x1019, 0, 1, 1) == AbortCode.INVALID_VALUE
    assert bench.refused(0x1019, 0, 241, 1) == AbortCode.INVALID_VALUE
    bench.write(0x1006, 0, 1000, 4)
    assert bench.refused(0x1019, 0, 10, 1) == AbortCode.DEVICE_STATE


def test_sync_cob_id_can_be_moved() -> None:
    bench = operational()
    bench.write(0x1005, 0, 0x90, 4)
    assert bench.sync() == []
    assert [frame.can_id for frame in bench.put(0x90)] == [0x180 + NODE]


def test_identity_and_strings() -> None:
    bench = Bench(DEFAULTS)
    assert bench.read(0x1018, 0) == 4
    assert bench.read(0x1009) == ord("1")
    assert (bench.read(0x1200, 1), bench.read(0x1200, 2)) == (0x605, 0x585)


@pytest.mark.parametrize("value", [1 << 29 | EMCY, 1 << 30 | EMCY, 0x701, 0x000])
def test_emergency_cob_id_is_checked(value: int) -> None:
    bench = Bench()
    bench.write(0x1014, 0, 1 << 31 | EMCY, 4)
    assert bench.refused(0x1014, 0, value, 4) == AbortCode.INVALID_VALUE


def test_new_setting_of_a_consumer_forgets_its_lost_node() -> None:
    bench = guarded(behaviour=1)
    bench.run_until_ms(400)
    before = len(bench.sent)
    bench.write(0x1016, 1, MASTER << 16 | 500, 4)
    assert Frame(EMCY, bytes(8)) in [frame for _, frame in bench.sent[before:]]
    assert bench.run_until_ms(2000) == []


def test_heartbeat_of_another_length_is_none() -> None:
    bench = guarded()
    bench.run_until_ms(100)
    bench.put(0x700 + MASTER, b"")
    assert [at for at, _ in bench.run_until_ms(400)] == [150 * MS]


def test_life_guarding_ends_when_heartbeats_begin() -> None:
    bench = operational()
    bench.write(0x100C, 0, 20, 2)
    bench.write(0x100D, 0, 3, 1)
    bench.put(HEARTBEAT, remote=True)
    bench.write(0x1017, 0, 1000, 2)
    bench.run_until_ms(500)
    assert bench.read(0x1001) == 0
    assert bench.device.state is NmtState.OPERATIONAL
