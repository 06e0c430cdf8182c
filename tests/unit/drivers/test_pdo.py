"""PDO plans: layout, bus load, and the standard's procedure on a scripted node."""

from collections.abc import Iterator

import pytest

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.objects import RemoteObjects, SettingRefused
from servobench.drivers.canopen.pdo import (
    PdoDirection,
    PdoEntry,
    PdoMap,
    PdoPlan,
    differences,
    write_plan,
)
from servobench.drivers.canopen.pdo_budget import budget_of, frame_bits_max
from servobench.drivers.cia402.pdo_planner import mode_plan
from servobench.drivers.cia402.pdo_plans import Features, PlanWish
from servobench.drivers.cia402.profile import Mode
from servobench.drivers.timebase import NS_PER_MS, Duration
from tests.unit.drivers.fake_bus import FakeBus, FakeServo, make_network

PLAN = mode_plan(1, PlanWish())
Node = tuple[FakeBus, FakeServo, CanopenNetwork, RemoteObjects]


@pytest.fixture
def node() -> Iterator[Node]:
    bus, network = make_network()
    yield bus, FakeServo(bus), network, RemoteObjects(network, 1)
    bus.shutdown()


def test_the_torque_plan_is_the_predefined_connection_set() -> None:
    assert [(pdo.name, pdo.cob_id, pdo.bits) for pdo in PLAN.tpdos] == [
        ("TPDO1", 0x181, 64),
        ("TPDO2", 0x281, 64),
        ("TPDO3", 0x381, 24),
    ]
    (command,) = PLAN.rpdos
    assert (command.cob_id, command.transmission_type, command.synchronous) == (0x201, 255, False)
    assert mode_plan(1, PlanWish(synchronous_command=True)).rpdos[0].synchronous


def test_codec_is_little_endian_without_padding() -> None:
    codec = PLAN.tpdos[1].codec()
    assert codec.size == 8
    assert codec.unpack(bytes.fromhex("9cff102700006400")) == (-100, 10000, 100)


def test_a_seldom_position_leaves_room_on_the_bus() -> None:
    plans = [mode_plan(node, PlanWish(position_every_cycles=10)) for node in (1, 2, 3)]
    speed, position, status = plans[0].tpdos
    assert [entry.index for entry in speed.entries] == [0x606C, 0x1013], "the stamp rides with the speed"
    assert [entry.index for entry in position.entries] == [0x6077, 0x6064, 0x6074]
    assert position.transmission_type == 10
    assert (status.transmission_type, status.inhibit_time_100us, status.event_timer_ms) == (255, 10, 25)
    # SYNC 55, and three times 135 + 135 / 10 + 85 / 25 + 95 bits a millisecond.
    load = budget_of(plans, Duration(NS_PER_MS), 1_000_000).load_percent
    assert load == pytest.approx((55 + 3 * (135 + 13.5 + 3.4 + 95)) / 10)
    whole = [mode_plan(node, PlanWish()) for node in (1, 2, 3)]
    assert budget_of(whole, Duration(NS_PER_MS), 1_000_000).load_percent > 100.0


@pytest.mark.parametrize("cycles", [0, 241])
def test_a_position_is_sent_every_1_to_240_syncs(cycles: int) -> None:
    with pytest.raises(ValueError, match=r"in 1\.\.240"):
        mode_plan(1, PlanWish(position_every_cycles=cycles))


def indices(plan: PdoPlan) -> list[list[int]]:
    return [[entry.index for entry in pdo.entries] for pdo in plan.tpdos]


def test_what_a_drive_cannot_tell_makes_another_plan() -> None:
    mode = Mode.CYCLIC_SYNCHRONOUS_TORQUE
    plan = mode_plan(1, PlanWish(mode, features=Features(stamp=False)))
    assert indices(plan) == [[0x606C], [0x6077, 0x6064, 0x6074], [0x6041, 0x6061]]
    plan = mode_plan(1, PlanWish(mode, features=Features(demand=False)))
    assert indices(plan) == [[0x606C, 0x1013], [0x6077, 0x6064], [0x6041, 0x6061]]
    plan = mode_plan(1, PlanWish(mode, features=Features(status_on_change=False)))
    assert indices(plan) == [[0x606C, 0x1013], [0x6077, 0x6064, 0x6041]]
    plan = mode_plan(1, PlanWish(mode, position_every_cycles=10, features=Features(status_on_change=False)))
    assert indices(plan) == [[0x606C, 0x6041, 0x6061], [0x6077, 0x6064, 0x6074]], (
        "the statusword with every SYNC"
    )
    assert [pdo.transmission_type for pdo in plan.tpdos] == [1, 10]
    plan = mode_plan(1, PlanWish(Mode.CYCLIC_SYNCHRONOUS_VELOCITY))
    assert indices(plan) == [[0x606C, 0x1013], [0x6077, 0x6064], [0x6041, 0x6061]], "no torque is commanded"


def test_a_counted_plan_has_position_and_speed_of_one_sync_in_one_frame() -> None:
    counted = Features(counted=True)
    plan = mode_plan(1, PlanWish(features=counted))
    assert indices(plan) == [[0x606C, 0x6064], [0x6077, 0x6074], [0x6041, 0x6061]]
    plan = mode_plan(1, PlanWish(position_every_cycles=10, features=counted))
    assert [pdo.transmission_type for pdo in plan.tpdos] == [1, 10, 255], "the count with every SYNC"
    plan = mode_plan(1, PlanWish(features=counted._replace(status_on_change=False)))
    assert indices(plan) == [[0x606C, 0x6064], [0x6077, 0x6041, 0x6061]]
    plan = mode_plan(1, PlanWish(features=counted, coherent=True))
    assert indices(plan) == [[0x6041, 0x6077, 0x6061], [0x606C, 0x6064]]


def test_a_coherent_plan_has_the_speed_behind_everything_else() -> None:
    plan = mode_plan(1, PlanWish(coherent=True))
    assert indices(plan) == [[0x6041, 0x6077, 0x6064], [0x606C, 0x1013], [0x6061]]
    assert [pdo.transmission_type for pdo in plan.tpdos] == [1, 1, 255]
    whole = mode_plan(1, PlanWish(coherent=True, mode_apart=False))
    assert indices(whole) == [[0x6041, 0x6077, 0x6064], [0x606C, 0x1013]], "the mode is asked for by SDO"


def test_demand_changes_have_a_pdo_of_their_own() -> None:
    plan = mode_plan(1, PlanWish(), demand_changes=True)
    change = plan.tpdos[3]
    assert (change.cob_id, change.transmission_type) == (0x481, 255)
    assert [entry.index for entry in change.entries] == [0x6074, 0x1013]


def test_mapping_word() -> None:
    assert PdoEntry(0x6064, 0, "i").mapping_word == 0x60640020


@pytest.mark.parametrize(("length", "bits"), [(0, 55), (1, 65), (8, 135)])
def test_longest_frame(length: int, bits: int) -> None:
    assert frame_bits_max(length) == bits


def test_a_pdo_of_more_than_eight_bytes_is_no_pdo() -> None:
    entries = (PdoEntry(0x6064, 0, "i"), PdoEntry(0x606C, 0, "i"), PdoEntry(0x6041, 0, "H"))
    with pytest.raises(ValueError, match="80 bits"):
        PdoMap(PdoDirection.TRANSMIT, 1, 0x181, entries)


def test_identifiers_are_not_shared() -> None:
    with pytest.raises(ValueError, match="share"):
        PdoPlan(PLAN.tpdos, PLAN.tpdos)


def test_the_plan_is_written_by_the_standards_procedure(node: Node) -> None:
    bus, servo, _, objects = node
    servo.values[0x1800, 1] = 0x40000181
    notes = write_plan(objects, PLAN)
    assert notes == ["TPDO1 written", "TPDO2 written", "TPDO3 written", "RPDO1 written"]
    assert servo.values[0x1800, 1] == 0x40000181
    assert servo.values[0x1801, 1] == 0x281
    assert servo.values[0x1A00, 0] == 2
    assert [servo.values[0x1A00, sub] for sub in (1, 2)] == [0x606C0020, 0x10130020]
    assert [servo.values[0x1802, sub] for sub in (2, 3, 5)] == [255, 10, 25]
    downloads = [data for data in bus.sent_to(0x601) if data[0] >> 5 == 1]
    mapping = [data for data in downloads if data[1:3] in (b"\x00\x18", b"\x00\x1a")]
    assert mapping[0] == bytes.fromhex("23001801810100c0")
    assert mapping[-1] == bytes.fromhex("2300180181010040")


def test_a_drive_that_holds_the_plan_is_left_alone(node: Node) -> None:
    bus, _, _, objects = node
    write_plan(objects, PLAN)
    bus.sent.clear()
    assert write_plan(objects, PLAN) == []
    assert not [data for data in bus.sent_to(0x601) if data[0] >> 5 == 1]


def test_pdos_outside_the_plan_are_switched_off(node: Node) -> None:
    _, servo, _, objects = node
    servo.values[0x1401, 1] = 0x301
    assert "RPDO2 switched off" in write_plan(objects, PLAN)
    assert servo.values[0x1401, 1] == 0x80000301


def test_two_pdos_may_swap_identifiers(node: Node) -> None:
    _, servo, _, objects = node
    write_plan(objects, PLAN)
    first, second, third = PLAN.tpdos
    swapped = PdoPlan(
        (
            PdoMap(first.direction, 1, second.cob_id, first.entries),
            PdoMap(second.direction, 2, first.cob_id, second.entries),
            third,
        ),
        PLAN.rpdos,
    )
    write_plan(objects, swapped)
    assert servo.values[0x1800, 1] == 0x281
    assert servo.values[0x1801, 1] == 0x181


def test_every_difference_is_named(node: Node) -> None:
    _, servo, _, objects = node
    write_plan(objects, PLAN)
    servo.values[0x1800, 1] = 0x80000199
    servo.values[0x1800, 2] = 254
    servo.values[0x1A00, 0] = 1
    assert differences(objects, PLAN.tpdos[0]) == [
        "TPDO1 is switched off",
        "TPDO1 has identifier 199h instead of 181h",
        "TPDO1 has transmission type 254 instead of 1",
        "TPDO1 maps 606Ch:00/32 instead of 606Ch:00/32 1013h:00/32",
    ]
    servo.values[0x1802, 3], servo.values[0x1802, 5] = 7, 50
    assert differences(objects, PLAN.tpdos[2]) == [
        "TPDO3 has an inhibit time of 7 x 100 us instead of 10",
        "TPDO3 has an event timer of 50 ms instead of 25 ms",
    ]


def test_a_statusword_without_an_event_timer_is_refused_one_without_inhibit_time_is_not(node: Node) -> None:
    _, servo, _, objects = node
    del servo.types[0x1802, 3]
    write_plan(objects, PLAN)
    del servo.types[0x1802, 5]
    assert differences(objects, PLAN.tpdos[2]) == ["TPDO3 has no event timer instead of 25 ms"]


def test_a_pdo_that_the_drive_lacks_is_named(node: Node) -> None:
    _, servo, _, objects = node
    del servo.types[0x1800, 1]
    servo.refuse[0x1800, 2] = 0x06020000
    assert differences(objects, PLAN.tpdos[0]) == ["TPDO1 does not exist"]


def test_a_transmission_type_that_is_not_taken_is_named(node: Node) -> None:
    _, servo, _, objects = node
    servo.stubborn.add((0x1801, 2))
    with pytest.raises(SettingRefused, match="TPDO2 has transmission type 255 instead of 1"):
        write_plan(objects, PLAN)


def test_a_transmission_type_that_fits_is_not_written(node: Node) -> None:
    _, servo, _, objects = node
    servo.refuse[0x1400, 2] = 0x06010002
    assert "RPDO1 written" in write_plan(objects, PLAN)


def test_a_pdo_that_cannot_be_switched_off_is_told(node: Node) -> None:
    _, servo, _, objects = node
    write_plan(objects, PLAN)
    servo.values[0x1801, 2] = 254
    servo.values[0x1803, 1] = 0x481
    servo.refuse |= {(0x1801, 1): 0x06010002, (0x1803, 1): 0x06010002}
    notes = write_plan(objects, PLAN)
    assert servo.values[0x1801, 2] == 1
    assert notes[0].startswith("TPDO4 is not used and cannot be switched off: abort code 06010002h")
    assert notes[1:] == ["TPDO2 written"]
