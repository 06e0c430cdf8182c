"""PDO plans for drives of every kind of limitation."""

import pytest

from servobench.drivers.canopen.pdo import PdoMap
from servobench.drivers.canopen.pdo_budget import budget_of, content_of
from servobench.drivers.cia402.pdo_planner import PlanImpossible, PlanResult, mode_plan, plan_pdos
from servobench.drivers.cia402.pdo_plans import Features, PlanWish
from servobench.drivers.cia402.profile import Mode
from servobench.drivers.sheets.capability import capability_of
from servobench.drivers.sheets.dictionary import parse_dictionary
from servobench.drivers.timebase import NS_PER_MS, Duration
from tests.unit.drivers.eds_maker import I16, NODE, U32, Pdo, four_pdos, sheet, sheet_text, variable

STATUS, SPEED, TORQUE, POSITION = 0x60410010, 0x606C0020, 0x60770010, 0x60640020
CLOCK, DEMAND = variable(0x1013, U32, "rw"), variable(0x6074, I16, "ro")
CONTROL, TARGET_TORQUE, TARGET_SPEED = 0x60400010, 0x60710010, 0x60FF0020


def plan(pdos: list[Pdo], wish: PlanWish | None = None, **how: object) -> PlanResult:
    return plan_pdos(capability_of(sheet(pdos, **how)), NODE, wish or PlanWish())


def shown(result: PlanResult) -> list[str]:
    return [_shown(pdo) for pdo in (*result.plan.tpdos, *result.plan.rpdos)]


def _shown(pdo: PdoMap) -> str:
    return f"{pdo.name} {pdo.cob_id:03X}h {pdo.transmission_type}: {content_of(pdo)}"


def test_a_free_drive_gets_the_standard_plan() -> None:
    for also, features in (
        ("", Features(stamp=False, demand=False)),
        (CLOCK, Features(demand=False)),
        (CLOCK + DEMAND, Features()),
    ):
        assert plan(four_pdos(), also=also).plan == mode_plan(NODE, PlanWish(features=features))
    assert not plan(four_pdos(), also=CLOCK + DEMAND).notes


def test_what_is_lost_is_told() -> None:
    order = "no 1013h beside 606Ch: readings are attributed to SYNCs by their order"
    unmeasured = "no 6074h beside the position: which command acts is not measured"
    assert plan(four_pdos()).notes == (order, unmeasured)
    assert plan(four_pdos(), also=CLOCK).notes == (unmeasured,)
    assert plan(four_pdos(), PlanWish(Mode.PROFILE_VELOCITY), also=CLOCK).notes == ()
    with_sync = "6041h is not told on change: it is told with the SYNC"
    asked = "no 6061h in a TPDO: the mode is asked for by SDO"
    assert plan(four_pdos(timers=False), also=CLOCK + DEMAND).notes == (unmeasured, with_sync, asked)


def test_without_an_inhibit_time_a_chattering_statusword_is_told_of() -> None:
    text = sheet_text(four_pdos(), also=CLOCK + DEMAND)
    for number in range(4):
        text = text.replace(f"[{0x1800 + number:04X}sub3]", f"[{0x2F00 + number:04X}]")
    result = plan_pdos(capability_of(parse_dictionary(text.encode(), "x", NODE)), NODE, PlanWish())
    assert result.notes == ("TPDO3 has no inhibit time: a statusword that chatters fills the bus",)
    assert result.plan.tpdos[2].inhibit_time_100us == 0


def test_homing_needs_no_set_point() -> None:
    assert shown(plan(four_pdos(), PlanWish(Mode.HOMING)))[-1] == "RPDO1 205h 255: 6040h:00/16"


def test_wishes_for_synchronous_commands_and_seldom_positions() -> None:
    wish = PlanWish(synchronous_command=True, position_every_cycles=4)
    lines = shown(plan(four_pdos(), wish, also=CLOCK))
    assert lines[1] == "TPDO2 285h 4: 6077h:00/16 6064h:00/32"
    assert lines[2] == "TPDO3 385h 255: 6041h:00/16 6061h:00/8"
    assert lines[3].startswith("RPDO1 205h 1:")


def test_a_file_that_defines_too_few_entries_is_helped_by_its_limit() -> None:
    # 6041h, 606Ch and 6064h as INTEGER16 fit into one PDO, which has two entries in the file.
    small = variable(0x606C, 3, "ro") + variable(0x6064, 3, "ro")
    text = sheet_text([Pdo(0x1400), Pdo(0x1800, entries=2)], without=(0x6077, 0x606C, 0x6064), also=small)
    with pytest.raises(PlanImpossible, match="6064h:00: the TPDOs have no room left"):
        plan_pdos(capability_of(parse_dictionary(text.encode(), "x", NODE)), NODE, PlanWish())
    allowed = text.replace("[1A00sub0]\n", "[1A00sub0]\nHighLimit=64\n").encode()
    result = plan_pdos(capability_of(parse_dictionary(allowed, "x", NODE)), NODE, PlanWish())
    assert shown(result)[0] == "TPDO1 185h 1: 6041h:00/16 606Ch:00/16 6064h:00/16 6061h:00/8"
    assert any("sub-index 0 allows" in note for note in result.notes)


def test_entries_that_nobody_reads_are_skipped_octets() -> None:
    pdos = [
        Pdo(0x1400, (CONTROL, TARGET_TORQUE), False),
        Pdo(0x1800, (STATUS, 0x20000018), False),
        Pdo(0x1801, (SPEED, POSITION), False),
        Pdo(0x1802, (TORQUE,), False),
    ]
    tpdo = plan(pdos).plan.tpdos[0]
    assert [entry.code for entry in tpdo.entries] == ["H", "3s"]
    assert tpdo.codec().unpack(b"\x27\x06abc") == (0x627, b"abc")


def test_bits_in_a_fixed_mapping_are_not_read() -> None:
    pdos = [
        Pdo(0x1400, (CONTROL, TARGET_TORQUE), False),
        Pdo(0x1800, (0x20000001, STATUS), False),
        Pdo(0x1801, (SPEED, POSITION), False),
    ]
    with pytest.raises(PlanImpossible, match="6041h:00"):
        plan(pdos)


def test_objects_that_may_not_be_mapped() -> None:
    with pytest.raises(PlanImpossible, match="606Ch:00 cannot be mapped into a TPDO"):
        plan(four_pdos(), unmapped=(0x606C,))


def test_marks_that_are_all_missing_say_nothing() -> None:
    everything = (0x6040, 0x6041, 0x6060, 0x6061, 0x6064, 0x606C, 0x6071, 0x6077, 0x607A, 0x60FF)
    assert len(shown(plan(four_pdos(), unmapped=everything))) == 4


def test_torque_degrades_to_current_and_to_nothing() -> None:
    current = variable(0x6078, 3, "ro")
    result = plan(four_pdos(), without=(0x6077,), also=current)
    assert shown(result)[1].endswith("6078h:00/16 6064h:00/32")
    assert "torque is taken from the current 6078h" in result.notes[0]
    result = plan(four_pdos(), without=(0x6077,))
    assert shown(result)[1].endswith(": 6064h:00/32")
    assert "readings carry no torque" in result.notes[0]


def test_types_and_identifiers_that_cannot_be_changed_are_kept() -> None:
    pdos = [
        Pdo(0x1400, cob_id="0x321", cob_id_access="ro"),
        Pdo(0x1800, kind=254, kind_access="ro"),
        Pdo(0x1801),
    ]
    result = plan(pdos)
    assert [line.split(":")[0] for line in shown(result)] == [
        "TPDO1 185h 254",
        "TPDO2 285h 1",
        "RPDO1 321h 255",
    ]
    assert result.notes[0] == "TPDO1 keeps its transmission type 254, 1 was wanted"


def test_a_pdo_that_cannot_be_switched_on() -> None:
    with pytest.raises(PlanImpossible, match="TPDO1 is switched off"):
        plan([Pdo(0x1400), Pdo(0x1800, cob_id="0x80000185", cob_id_access="ro"), Pdo(0x1801)])


def test_a_fifth_pdo_keeps_the_identifier_that_it_has() -> None:
    pdos = [Pdo(0x1400), Pdo(0x1800), Pdo(0x1804, cob_id="0x80000000")]
    with pytest.raises(PlanImpossible, match="TPDO5 has no identifier"):
        plan(pdos)
    pdos[2] = Pdo(0x1804, cob_id="0x80000291")
    assert shown(plan(pdos))[1].startswith("TPDO5 291h")


def test_the_budget_is_that_of_the_longest_frames() -> None:
    result = plan(four_pdos(), also=CLOCK)
    budget = budget_of([result.plan], Duration(NS_PER_MS), 500_000)
    assert [(line.name, line.bits_max, line.time_ns) for line in budget.lines] == [
        ("SYNC", 55, 110_000),
        ("TPDO1", 135, 270_000),
        ("TPDO2", 115, 230_000),
        ("TPDO3", 85, 170_000),
        ("RPDO1", 95, 190_000),
    ]
    assert budget.load_percent == pytest.approx(11 + 27 + 23 + 17 / 25 + 19)
    assert budget.shortest_period_ns == 1_212_501


def test_a_seldom_pdo_costs_its_share() -> None:
    result = plan(four_pdos(), PlanWish(position_every_cycles=4))
    budget = budget_of([result.plan], Duration(NS_PER_MS), 1_000_000)
    assert budget.load_percent == pytest.approx(5.5 + 9.5 + 11.5 / 4 + 8.5 / 25 + 9.5)
    assert budget.fullest_cycle_percent == pytest.approx(5.5 + 9.5 + 11.5 + 8.5 + 9.5)
