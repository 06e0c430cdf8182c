"""Whether a drive follows its commands, by 6061h and its statusword: when a lapse begins and ends."""

import pytest

from servobench.drivers.cia402.follow_watch import FOLLOWS_BIT, OLDER_MAX, FollowWatch, Lapse
from servobench.drivers.cia402.profile import Mode
from servobench.drivers.timebase import NS_PER_S, Instant

CST, PV = Mode.CYCLIC_SYNCHRONOUS_TORQUE, Mode.PROFILE_VELOCITY
FOLLOWS, IGNORES, LIMITED, CUT, DISABLED = 0x1237, 0x0237, 0x1A37, 0x0A37, 0x0250


def watch_of(mode: Mode = CST) -> FollowWatch:
    watch = FollowWatch()
    watch.aim(mode)
    watch.begin()
    return watch


def words(watch: FollowWatch, *told: int) -> list[bool]:
    """Whether there is a lapse after each statusword; they are told one nanosecond after the other."""
    found = []
    for at, word in enumerate(told):
        watch.status_told(word, Instant(at))
        found.append(watch.lapse is not None)
    return found


def test_a_bit_that_is_cleared_is_a_lapse_until_it_is_set_again() -> None:
    watch = watch_of()
    assert words(watch, FOLLOWS, IGNORES, IGNORES, FOLLOWS) == [False, True, True, False]
    (lapse,) = watch.lapses
    assert (lapse.began_at, lapse.ended_at) == (1, 3)
    assert str(lapse) == "ignores the commands of cyclic synchronous torque"
    assert lapse.evidence == "bit 12 of its statusword is 0"


def test_a_drive_that_never_sets_the_bit_is_not_judged_by_it() -> None:
    watch = watch_of()
    assert words(watch, *[IGNORES] * 5) == [False] * 5
    assert not watch.bit_watched


def test_a_command_that_is_cut_is_followed_but_ends_no_lapse() -> None:
    watch = watch_of()
    assert words(watch, FOLLOWS, CUT, LIMITED, CUT) == [False] * 4
    assert words(watch, IGNORES, CUT, LIMITED) == [True, True, False]


def test_only_an_enabled_drive_is_judged() -> None:
    assert words(watch_of(), FOLLOWS, DISABLED) == [False, False]
    watch = watch_of()
    assert words(watch, FOLLOWS, IGNORES) == [False, True]
    watch.end()
    assert watch.lapse is None
    assert words(watch, IGNORES) == [False]
    assert len(watch.lapses) == 1, "what was stays known"


@pytest.mark.parametrize("mode", [mode for mode in Mode if mode not in FOLLOWS_BIT])
def test_in_other_modes_bit_12_means_something_else(mode: Mode) -> None:
    assert words(watch_of(mode), FOLLOWS, IGNORES) == [False, False]


@pytest.mark.parametrize(
    ("shown", "title"),
    [(3, "profile velocity"), (0, "no mode"), (-3, "mode -3 of its maker"), (99, "mode 99, which CiA 402-2")],
)
def test_a_mode_that_is_left_is_named(shown: int, title: str) -> None:
    watch = watch_of()
    watch.mode_told(CST, Instant(1))
    assert watch.lapse is None
    watch.mode_told(shown, Instant(2))
    assert watch.lapse is not None
    assert str(watch.lapse).startswith(f"left cyclic synchronous torque for {title}")
    assert watch.lapse.evidence == f"6061h is {shown}, 10 was commanded"
    watch.mode_told(CST, Instant(NS_PER_S))
    assert watch.lapse is None
    assert watch.lapses[0].told(Instant(0)).endswith(" at 0.0000 s and did not follow for 0 cycles")


def test_a_mode_that_was_on_its_way_when_it_was_changed_is_no_lapse() -> None:
    watch = watch_of()
    watch.mode_told(PV, Instant(1))
    assert watch.lapse is None
    watch.mode_told(CST, Instant(2))
    watch.mode_told(PV, Instant(3))
    assert watch.lapse is not None


def test_a_drive_that_never_shows_the_commanded_mode_is_not_in_it() -> None:
    watch = watch_of()
    for at in range(1, OLDER_MAX):
        watch.mode_told(PV, Instant(at))
        assert watch.lapse is None
    watch.mode_told(PV, Instant(OLDER_MAX))
    assert watch.lapse is not None


def test_the_host_may_change_the_mode() -> None:
    watch = watch_of()
    watch.mode_told(CST, Instant(1))
    watch.aim(Mode.NONE)
    watch.mode_told(PV, Instant(2))
    watch.aim(PV)
    watch.mode_told(PV, Instant(3))
    assert watch.lapses == []


def test_a_mode_that_was_left_before_the_drive_is_enabled_is_a_lapse_from_the_beginning() -> None:
    watch = FollowWatch()
    watch.aim(CST)
    watch.mode_told(CST, Instant(1))
    watch.mode_told(PV, Instant(2))
    assert watch.lapse is None, "nobody commands it"
    watch.begin()
    assert watch.lapse is not None
    assert watch.lapse.began_at == 2


def test_each_change_is_told_once() -> None:
    told: list[tuple[str, bool]] = []

    def tell(lapse: Lapse) -> None:
        told.append((str(lapse), lapse.ended_at is None))

    watch = watch_of()
    watch.mode_told(CST, Instant(1))
    watch.on_change = tell
    words(watch, FOLLOWS, IGNORES, IGNORES)
    watch.mode_told(PV, Instant(5))
    watch.mode_told(CST, Instant(6))
    words(watch, FOLLOWS)
    ignores, left = (
        "ignores the commands of cyclic synchronous torque",
        "left cyclic synchronous torque for profile velocity",
    )
    assert told == [(ignores, True), (left, True), (ignores, True), (ignores, False)]
