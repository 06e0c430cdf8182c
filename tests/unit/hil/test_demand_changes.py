"""Between which instants a command began to act, where a drive tells changes or what it follows at SYNCs."""

import pytest

from servobench.drivers.timebase import Duration, Instant
from servobench.drivers.wire.frame_port import EchoBasis
from servobench.hil.loop.command_meter import FOLLOWED_MAX, CommandMeter
from servobench.hil.loop.samples import CommandFate, Sending
from tests.unit.hil.test_command_meter import AT_REST, HANDED, HORIZON, ON_BUS, command, meter_on, sync_at

ERROR = Duration(3_000)
ACTING, LOST, UNKNOWN = CommandFate.ACTING, CommandFate.LOST, CommandFate.NOT_IDENTIFIABLE


def meter_with(*raws: int) -> CommandMeter:
    """The commands 0, 1, ... with these values have been on the bus."""
    meter, _ = meter_on(EchoBasis.BUS)
    for number, raw in enumerate(raws):
        meter.sent(command(number, raw))
    return meter


def on_bus_at(number: int) -> Instant:
    return Instant(sync_at(number) + ON_BUS)


def told(outcome: Sending | None) -> tuple[CommandFate, int | None, int | None] | None:
    return None if outcome is None else (outcome.fate, outcome.acts_after, outcome.acts_by)


# ---- a change with its stamp ----------------------------------------------------------------------------


def test_a_change_tells_within_which_error_its_command_began_to_act() -> None:
    meter = meter_with(5)
    at = Instant(on_bus_at(0) + 20_000)
    meter.changed(5, at, ERROR)
    outcome = meter.outcome(0, 1)
    assert outcome == Sending(
        5, Instant(HANDED), on_bus_at(0), ACTING, Instant(at - ERROR), Instant(at + ERROR)
    )
    assert meter.outcome(0, 1) is None, "it is forgotten"
    assert meter.unexplained == 0


@pytest.mark.parametrize(("early", "acts"), [(ERROR, True), (ERROR + 1, False)])
def test_a_change_is_of_a_command_that_may_have_been_there(early: int, acts: bool) -> None:
    meter = meter_with(5)
    meter.changed(5, Instant(on_bus_at(0) - early), ERROR)
    assert told(meter.outcome(0, HORIZON)) == (
        (ACTING, on_bus_at(0), on_bus_at(0) - early + ERROR) if acts else (UNKNOWN, None, None)
    )


def test_a_change_to_what_two_commands_ask_for_tells_of_neither() -> None:
    meter = meter_with(5, 5)
    meter.changed(5, Instant(on_bus_at(1) + 1), ERROR)
    assert [told(meter.outcome(number, HORIZON + 1)) for number in (0, 1)] == [(UNKNOWN, None, None)] * 2


def test_a_change_to_what_no_command_asks_for_tells_of_none() -> None:
    meter = meter_with(5)
    meter.changed(6, Instant(on_bus_at(0) + 1), ERROR)
    assert told(meter.outcome(0, HORIZON - 1)) is None
    assert told(meter.outcome(0, HORIZON)) == (UNKNOWN, None, None)


def test_a_change_that_is_told_twice_moves_no_instant() -> None:
    meter = meter_with(5)
    first = Instant(on_bus_at(0) + 10_000)
    meter.changed(5, first, ERROR)
    meter.changed(5, Instant(first + 500_000), ERROR)
    assert told(meter.outcome(0, 1)) == (ACTING, first - ERROR, first + ERROR)


@pytest.mark.parametrize(
    ("patient", "newer", "exact"), [(False, True, True), (True, False, True), (True, True, False)]
)
def test_a_change_behind_a_newer_command_may_be_the_second_of_its_command(
    patient: bool, newer: bool, exact: bool
) -> None:
    """Where frames of the drive may be lost or overtaken: what told of the first and of the newer command."""
    meter = meter_with(5, 6) if newer else meter_with(5)
    meter.patient = patient
    at = Instant(on_bus_at(1) + 100_000)
    meter.changed(5, at, ERROR)
    assert told(meter.outcome(0, HORIZON)) == (ACTING, at - ERROR if exact else on_bus_at(0), at + ERROR)


def test_once_commands_have_come_twice_a_change_may_be_the_second_of_its_command() -> None:
    meter = meter_with(5, 6)
    for number, raw in ((0, 5), (1, 6), (1, 5)):  # 5 again, behind 6
        meter.changed(raw, Instant(on_bus_at(number) + 10_000 + 100_000 * (raw == 5)), ERROR)
    meter.sent(command(2, 7))
    at = Instant(on_bus_at(2) + 100_000)
    meter.changed(7, at, ERROR)
    meter.outcome(0, HORIZON)
    meter.outcome(1, HORIZON)
    assert told(meter.outcome(2, HORIZON)) == (ACTING, on_bus_at(2), at + ERROR)


def test_commands_that_a_change_passes_over_were_not_seen_to_be_lost() -> None:
    """A drive that tells changes may have followed one for less than it takes to tell."""
    meter = meter_with(5, 6, 7)
    meter.changed(5, Instant(on_bus_at(0) + 10), ERROR)
    at = Instant(on_bus_at(2) + 10)
    meter.changed(7, at, ERROR)
    assert [told(meter.outcome(number, 3 + HORIZON)) for number in (0, 1, 2)] == [
        (ACTING, on_bus_at(0), on_bus_at(0) + 10 + ERROR),
        (UNKNOWN, None, None),
        (ACTING, on_bus_at(2), at + ERROR),
    ]


def test_what_was_not_followed_at_a_sync_and_is_replaced_by_a_change_was_passed_over() -> None:
    meter = meter_with(5)
    meter.changed(5, Instant(on_bus_at(0) + 10), ERROR)
    meter.sent(command(1, 6))
    meter.told(5, sync_at(2), sync_at(2))
    meter.sent(command(2, 7))
    at = Instant(on_bus_at(2) + 10)
    meter.changed(7, at, ERROR)
    assert [told(meter.outcome(number, 3 + HORIZON)) for number in (0, 1, 2)] == [
        (ACTING, on_bus_at(0), on_bus_at(0) + 10 + ERROR),
        (UNKNOWN, sync_at(2), None),
        (ACTING, on_bus_at(2), at + ERROR),
    ]


# ---- at SYNCs -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("missing", "fate"), [(None, LOST), (1, LOST), (3, UNKNOWN), (4, UNKNOWN)])
def test_where_commands_act_at_syncs_one_is_lost_that_none_of_them_shows(
    missing: int | None, fate: CommandFate
) -> None:
    """Command 2 was there at SYNC 3, so SYNC 4 would show it; SYNC 5 shows the next one."""
    _, syncs = meter_on(EchoBasis.BUS)
    meter = CommandMeter(HORIZON, syncs, acts_at_syncs=True)
    acting = [None, 0, 1, 1, 3, 4]
    for number in range(1, 7):
        mark = syncs.heard(number, sync_at(number))
        shown = acting[number - 1]
        if number != missing:
            meter.told(AT_REST if shown is None else 10 + shown, sync_at(number), sync_at(number), mark)
        meter.sent(command(number - 1, 9 + number))
    fates = [told(meter.outcome(number, 6 + HORIZON)) for number in (0, 1, 2)]
    assert fates[2] is not None
    assert fates[2][0] is fate


def test_of_two_equal_commands_the_newer_is_in_force_and_neither_is_known_to_act() -> None:
    meter = meter_with(5)
    meter.told(AT_REST, sync_at(0), sync_at(0))
    meter.sent(command(1, 5))
    meter.told(5, sync_at(2), sync_at(2))
    meter.sent(command(2, 6))
    meter.told(6, sync_at(3), sync_at(3))
    assert [told(meter.outcome(number, 3 + HORIZON)) for number in (0, 1, 2)] == [
        (UNKNOWN, None, None),
        (UNKNOWN, None, None),
        (ACTING, on_bus_at(2), sync_at(3)),
    ]


def test_what_the_drive_goes_on_to_follow_is_explained() -> None:
    meter = meter_with(5)
    for number, raw in enumerate((AT_REST, 5, 5, 4, 5), start=0):
        meter.told(raw, sync_at(number), sync_at(number))
    assert meter.unexplained == 1, "the 4; before the first command there was none on its way"


@pytest.mark.parametrize(("beyond", "known"), [(0, True), (1, False)])
def test_so_many_commands_are_followed_at_a_time(beyond: int, known: bool) -> None:
    meter = meter_with(*range(FOLLOWED_MAX + beyond))
    assert (meter.outcome(0, FOLLOWED_MAX) is not None) is known


def test_outcomes_are_asked_for_in_order_and_of_commands_that_were_sent() -> None:
    meter = meter_with(5, 6)
    assert meter.outcome(7, 30) is None, "it was not sent"
    assert meter.outcome(1, 30) is None, "that passes over those before"


@pytest.mark.parametrize(("age", "settled"), [(1, False), (2, True)])
def test_of_a_drive_that_tells_nothing_an_echo_is_waited_for(age: int, settled: bool) -> None:
    meter = meter_with(5)
    assert told(meter.outcome(0, age)) == ((CommandFate.NOT_MEASURED, None, None) if settled else None)
