"""``hil stop``, word by word: what a drive is told in each state, when, and when it counts as at rest."""

from collections.abc import Callable, Sequence

import pytest

from servobench.drivers.errors import BusDown
from servobench.drivers.timebase import Duration, Instant
from servobench.hil.inspecting.stopping import NodeStopped, stop_drives
from servobench.virtual_bus.frame import Frame
from tests.unit.hil.scripted_drive import (
    DISABLE_VOLTAGE,
    DISABLED,
    ENABLED,
    FAULT,
    NO_STATE,
    NOT_READY,
    PRE_OPERATIONAL,
    QUICK_STOP,
    REACTING,
    READY,
    STOP,
    STOPPING,
    SWITCHED_ON,
    ScriptedDrive,
    on_a_bus,
)

ROUNDS = 5000 // 20
"""Of 20 ms, in the 5 s that it takes at most."""


def stopped(*drives: ScriptedDrive, nodes: Sequence[int] = (1,)) -> NodeStopped:
    with on_a_bus(*drives) as (_, network):
        return stop_drives(network, nodes)[0]


def always(word: int | None) -> Callable[[ScriptedDrive], int | None]:
    return lambda _drive: word


@pytest.mark.parametrize("word", [DISABLED, FAULT, NOT_READY])
def test_a_drive_that_is_disabled_is_told_nothing(word: int) -> None:
    drive = ScriptedDrive(always(word))
    result = stopped(drive)
    assert (drive.told, result.at_rest) == ([], True)
    assert result.text == (
        "at rest and in fault already" if word == FAULT else "at rest and disabled already"
    )
    assert drive.looks == 1 + 11, "ten rounds without a change of position follow the first"
    assert result.before == result.after != ""


def test_one_that_hears_no_quick_stop_is_told_at_once_again_and_by_nmt() -> None:
    drive = ScriptedDrive(always(ENABLED))
    result = stopped(drive)
    assert drive.told[:8] == [QUICK_STOP] * 4 + [PRE_OPERATIONAL, QUICK_STOP] * 2
    assert drive.told_ms[0] < 1.0, "before anything is waited for"
    assert drive.told_ms[2] - drive.told_ms[1] == pytest.approx(20.0, abs=0.5)
    assert drive.told.count(QUICK_STOP) == 1 + ROUNDS
    assert not result.at_rest
    assert result.took_ms == pytest.approx(5000.0, abs=60.0)
    assert result.text.startswith("NOT known to be at rest: operation enabled; NMT enter pre operational, as")
    assert result.text.count("NMT") == 1


@pytest.mark.parametrize("word", [READY, SWITCHED_ON])
def test_one_that_could_be_enabled_is_disabled(word: int) -> None:
    drive = ScriptedDrive(lambda drive: word if DISABLE_VOLTAGE not in drive.told else DISABLED)
    result = stopped(drive)
    assert drive.told == [QUICK_STOP, DISABLE_VOLTAGE]
    assert result.at_rest
    assert result.text == "at rest and disabled"


def test_one_that_tells_no_state_is_disabled_but_not_at_rest() -> None:
    drive = ScriptedDrive(always(NO_STATE))
    result = stopped(drive)
    assert drive.told == [QUICK_STOP] + [DISABLE_VOLTAGE] * ROUNDS
    assert result.text == "NOT known to be at rest: unknown state"


def test_one_that_reacts_to_a_fault_is_left_to_it() -> None:
    drive = ScriptedDrive(lambda drive: REACTING if drive.looks < 9 else FAULT)
    result = stopped(drive)
    assert drive.told == [QUICK_STOP]
    assert (result.before, result.text) == ("fault reaction active", "at rest and in fault")
    assert drive.looks == 8 + 10, "its position is known by then"


@pytest.mark.parametrize(
    ("places", "disabled"),
    [((0, 2), True), ((0, 3), False), ((0x7FFF_FFFF, -0x8000_0000), True), ((1, -1), True), ((1, -2), False)],
)
def test_one_in_quick_stop_is_disabled_when_it_stands_still(places: tuple[int, int], disabled: bool) -> None:
    """605Ah = 5 to 8 stay in it, with torque: two units are rest, also across the ends of 32 bits."""
    drive = ScriptedDrive(
        lambda drive: DISABLED if DISABLE_VOLTAGE in drive.told else STOPPING,
        lambda drive: places[drive.places % 2],
    )
    result = stopped(drive)
    assert drive.told[0] == QUICK_STOP
    assert (DISABLE_VOLTAGE in drive.told) is result.at_rest is disabled
    if disabled:
        assert drive.told == [QUICK_STOP, DISABLE_VOLTAGE]
        assert drive.places == 12, "one to compare with, one a round later, ten at rest"


def test_rest_is_ten_rounds_in_a_row_and_its_time_is_the_first_of_them() -> None:
    """A jump of three units in the sixth round: they are counted anew; its end is told, not the watch's."""
    drive = ScriptedDrive(always(DISABLED), lambda drive: 3 if drive.places > 6 else 0)
    result = stopped(drive)
    assert drive.places == 6 + 1 + 10
    assert result.at_rest
    first_of_ten_ms = 51.0 + 20.0 * 7
    assert result.took_ms == pytest.approx(first_of_ten_ms, abs=3.0)


def test_rest_that_another_master_ends_is_none() -> None:
    """Enabled anew in the tenth round."""
    drive = ScriptedDrive(lambda drive: ENABLED if drive.looks == 11 else DISABLED)
    result = stopped(drive)
    assert drive.told == [QUICK_STOP]
    assert drive.looks == 11 + 10
    assert result.at_rest


def test_it_falls_silent_and_is_stopped_by_nmt() -> None:
    drive = ScriptedDrive(lambda drive: ENABLED if drive.looks <= 2 else None)
    result = stopped(drive)
    assert drive.told == [QUICK_STOP, QUICK_STOP, PRE_OPERATIONAL, STOP]
    silent = drive.told_ms[2] - drive.told_ms[1], drive.told_ms[3] - drive.told_ms[2]
    assert silent == pytest.approx((3 * 50.0 + 20.0, 3 * 50.0), abs=25.0), (
        "it is asked once a round, for 50 ms"
    )
    assert (result.at_rest, result.before) == (False, "operation enabled")
    assert result.text == (
        "NOT known to be at rest: operation enabled; NMT enter pre operational, as it did not answer; "
        "NMT stop, as it did not answer"
    )


def test_a_lost_answer_begins_rest_anew_and_calls_for_no_nmt() -> None:
    """Two in a row, twice, in a drive at rest."""
    drive = ScriptedDrive(lambda drive: None if drive.looks in (6, 7, 13, 14) else DISABLED)
    result = stopped(drive)
    assert drive.told == []
    assert drive.looks == 14 + 10
    assert result.at_rest


def test_a_drive_without_a_position_is_disabled_and_not_said_to_be_at_rest() -> None:
    drive = ScriptedDrive(
        lambda drive: ENABLED if len(drive.told) < 2 else READY if len(drive.told) < 4 else DISABLED,
        lambda _drive: None,
    )
    result = stopped(drive)
    assert drive.told == [QUICK_STOP] * 2 + [DISABLE_VOLTAGE] * 2
    assert result.text == "NOT known to be at rest: switch on disabled"


@pytest.mark.parametrize(
    "answer",
    [
        b"\x4b\x41\x60\x00\x27\x02",
        b"\x80\x41\x60\x00\x27\x02\x00\x00",
        b"\x4b\x42\x60\x00\x27\x02\x00\x00",
        b"\x4b\x41\x61\x00\x27\x02\x00\x00",
        b"\x4b\x41\x60\x01\x27\x02\x00\x00",
    ],
)
def test_what_is_no_statusword_gets_no_controlword(answer: bytes) -> None:
    """6040h of another device may be anything."""
    drive = ScriptedDrive(always(ENABLED), around=lambda _frame: (Frame(0x581, answer),))
    stopped(drive)
    assert drive.told == [PRE_OPERATIONAL, STOP]


def test_an_answer_that_comes_twice_gets_one_quick_stop_at_once() -> None:
    drive = ScriptedDrive(
        lambda drive: ENABLED if not drive.told else DISABLED, around=lambda frame: (frame,) * 2
    )
    assert stopped(drive).at_rest
    assert drive.told == [QUICK_STOP]


@pytest.mark.parametrize(("word", "told"), [(0x0327, [QUICK_STOP]), (0xFF40, []), (0x0627, [QUICK_STOP])])
def test_only_its_statusword_is_taken_for_its_state(word: int, told: list[str]) -> None:
    """Higher bits, and what a drive leaves in the four bytes behind, are no part of the state."""

    def filled(frame: Frame) -> Sequence[Frame]:
        return (Frame(0x581, frame.data[:6] + b"\xff\xff"),)

    drive = ScriptedDrive(lambda drive: DISABLED if drive.told else word, around=filled)
    result = stopped(drive)
    assert drive.told == told
    assert result.before == ("operation enabled" if told else "switch on disabled")


def test_who_is_asked_by_nobody_is_found_by_its_statusword() -> None:
    """All 127 are asked within 130 ms; what is heard later is not waited for."""
    drive = ScriptedDrive(always(DISABLED))
    with on_a_bus(drive) as (world, network):
        (result,) = stop_drives(network, ())
        assert result.node == 1
        took_ms = world.clock.now() / 1e6
    assert took_ms == pytest.approx(127 + 50 + 20 * 11, abs=15.0)


def test_nobody_listens_any_more_when_all_were_asked() -> None:
    """What a drive tells later, asked by somebody else, gets no quick stop behind the back of its stop."""
    first = ScriptedDrive(always(DISABLED))
    late = ScriptedDrive(lambda drive: None if drive.looks == 1 else ENABLED, node=2)
    with on_a_bus(first, late) as (_, network):
        told = stop_drives(network, ())
        network.link.send(0x602, bytes.fromhex("4041600000000000"))
        network.pump(Instant(network.clock.now() + Duration(5_000_000)))
    assert [each.node for each in told] == [1]
    assert (late.looks, late.told) == (2, [])


def test_all_are_waited_for() -> None:
    """One rests at once, one for only a second."""
    first = ScriptedDrive(always(DISABLED))
    last = ScriptedDrive(
        lambda drive: STOPPING if drive.now_ms < 1000.0 else DISABLED,
        lambda drive: 9 * drive.places if drive.now_ms < 1000.0 else 0,
        node=2,
    )
    with on_a_bus(first, last) as (_, network):
        told = stop_drives(network, (1, 2))
    assert [each.at_rest for each in told] == [True, True]
    assert told[0].took_ms < 100.0 < 1000.0 < told[1].took_ms


def test_a_shaft_that_still_turns_keeps_its_torque() -> None:
    """4 units a millisecond down to none within a second: two readings at once would show no change."""
    drive = ScriptedDrive(
        lambda drive: DISABLED if DISABLE_VOLTAGE in drive.told else STOPPING,
        lambda drive: round(4.0 * min(drive.now_ms, 1000.0)),
    )
    assert stopped(drive).at_rest
    assert drive.told == [QUICK_STOP, DISABLE_VOLTAGE]
    assert drive.told_ms[1] > 1000.0


def test_a_position_that_is_told_no_more_is_not_rest() -> None:
    drive = ScriptedDrive(always(DISABLED), lambda drive: 0 if drive.places == 1 else None)
    assert not stopped(drive).at_rest


def test_a_write_that_is_not_answered_holds_up_for_as_long_as_a_read() -> None:
    """50 ms; then it is asked for again, as an answer can be lost."""

    def deaf(frame: Frame) -> Sequence[Frame]:
        return () if frame.data[0] == 0x60 else (frame,)

    drive = ScriptedDrive(lambda drive: ENABLED if len(drive.told) < 3 else DISABLED, around=deaf)
    stopped(drive)
    assert set(drive.told) == {QUICK_STOP}
    assert drive.told_ms[2] - drive.told_ms[1] == pytest.approx(50.0, abs=1.0)


def test_a_bus_that_goes_away_ends_it(monkeypatch: pytest.MonkeyPatch) -> None:
    drive = ScriptedDrive(always(ENABLED))
    with on_a_bus(drive) as (_, network):
        upload = network.upload

        def gone(node: int, index: int, sub: int = 0, **options: float) -> bytes:
            if drive.looks == 4:
                raise BusDown("the bus is down", "taken away", "put it back")
            return upload(node, index, sub, **options)  # type: ignore[arg-type]

        monkeypatch.setattr(network, "upload", gone)
        with pytest.raises(BusDown):
            stop_drives(network, (1,))


def test_its_time_is_counted_from_the_command() -> None:
    drive = ScriptedDrive(always(DISABLED))
    with on_a_bus(drive) as (_, network):
        network.pump(Instant(network.clock.now() + Duration(3_000_000_000)))
        (result,) = stop_drives(network, (1,))
    assert result.took_ms == pytest.approx(51.0 + 20.0, abs=3.0)
