"""Whether a dictionary serves a bench."""

import pytest

from servobench.drivers.cia402.profile import Mode
from servobench.drivers.sheets.fitness import Fitness, assess
from servobench.hil.commissioning.drive_port import QUANTITY_OF_MODE
from tests.unit.drivers.eds_maker import I8, NODE, U8, U16, U32, Pdo, four_pdos, sheet, sub, variable


def fitness(pdos: list[Pdo] | None = None, **how: object) -> Fitness:
    return assess(sheet(four_pdos() if pdos is None else pdos, **how), NODE, tuple(QUANTITY_OF_MODE))


def test_identity_comes_from_the_identity_object_first() -> None:
    record = "[1018]\nParameterName=I\nObjectType=9\nSubNumber=3\n"
    record += sub(0x1018, 0, 5, "ro", "2") + sub(0x1018, 1, U32, "ro", "0x77") + sub(0x1018, 2, U32, "ro", "")
    found = fitness(also=record).identity
    assert (found.vendor, found.product) == (0x77, None)


def test_modes_are_those_of_6502h() -> None:
    found = fitness(modes="0x25")
    assert [mode.title for mode in found.modes] == ["profile position", "profile velocity", "homing"]
    assert found.best is not None
    assert found.best.mode is Mode.PROFILE_VELOCITY
    assert any("no torque mode" in remark for remark in found.remarks)
    assert found.serves


@pytest.mark.parametrize("modes", ["", "0"])
def test_without_a_value_of_6502h_the_objects_tell(modes: str) -> None:
    found = fitness(modes=modes)
    without_object = {Mode.VELOCITY, Mode.INTERPOLATED_POSITION}
    asked = [mode for mode in QUANTITY_OF_MODE if mode not in without_object]
    assert found.modes == tuple(sorted(asked))
    assert "to be tried (6502h gives no value)" in found.modes_told_by
    assert [each.mode for each in found.usable] == asked


@pytest.mark.parametrize(
    ("how", "telling"),
    [
        ({"device_type": "0x00030191"}, "device profile 401"),
        (
            {"device_type": "0x00220811"},
            "1000h is 00220811h, whose low 16 bits say device profile 2065 (0811h); a drive's say 402 (0192h",
        ),
        ({"without": (0x6040,)}, "6040h:00 missing: it has no CiA 402 state machine"),
        ({"without": (0x6040, 0x6041)}, "6040h:00 and 6041h:00 missing"),
        ({"without": (0x6060,)}, "6060h:00 missing: its mode cannot be chosen"),
        ({"modes": "0x20"}, "it has none of the modes in which the bench could move it"),
        (
            {"without": (0x606C,)},
            "cyclic synchronous torque: 606Ch:00 is not in the dictionary",
        ),
        ({"pdos": []}, "there is no TPDO"),
    ],
)
def test_obstacles_say_why(how: dict[str, object], telling: str) -> None:
    found = fitness(**how)  # type: ignore[arg-type]
    assert not found.serves
    assert any(telling in obstacle for obstacle in found.obstacles)


def test_no_standardised_profile_is_a_drive_by_its_statusword() -> None:
    found = fitness(device_type="0x00020000")
    assert found.serves
    assert any("no device profile" in remark for remark in found.remarks)
    assert not fitness(device_type="0x00020000", without=(0x6041,)).serves


@pytest.mark.parametrize(
    ("limits", "reason"),
    [
        ("LowLimit=1\nHighLimit=9\n", "6060h takes 1 to 9 by its limits, the mode is 10"),
        ("HighLimit=8\n", "6060h takes up to 8 by its limits, the mode is 10"),
        ("HighLimit=10\n", ""),
    ],
)
def test_a_mode_beyond_the_limits_of_6060h_is_none(limits: str, reason: str) -> None:
    also = variable(0x6060, I8, "rww") + limits
    torque = fitness(without=(0x6060,), also=also).usable[0]
    assert (torque.mode, torque.reason, torque.plan is None) == (
        Mode.CYCLIC_SYNCHRONOUS_TORQUE,
        reason,
        bool(reason),
    )


def test_a_mode_that_cannot_be_written_is_the_only_one() -> None:
    found = fitness(without=(0x6060,), also=variable(0x6060, I8, "ro", "7"))
    assert {each.reason for each in found.usable if each.mode is not Mode.INTERPOLATED_POSITION} == {
        "6060h cannot be written, and holds 7"
    }
    assert not found.serves
    held = fitness(without=(0x6060,), also=variable(0x6060, I8, "ro", "9"))
    assert held.best is not None
    assert held.best.mode is Mode.CYCLIC_SYNCHRONOUS_VELOCITY


def test_a_watch_that_cannot_be_is_a_condition() -> None:
    heartbeats = {index: variable(index, U16, "rw") for index in (0x1016, 0x1017)}
    guarding = variable(0x100C, U16, "rw") + variable(0x100D, U8, "rw")
    assert fitness(also="".join(heartbeats.values())).conditions == ()
    assert fitness(also=guarding).conditions == ()
    (host,) = fitness(also=heartbeats[0x1016]).conditions
    assert host == (
        "without 1017h, 100Ch and 100Dh the host does not notice that the drive is gone: it is refused "
        "unless --unwatched (unwatched = true)"
    )
    assert fitness(also=heartbeats[0x1016]).remarks[0] == host
    assert "without 1016h" in fitness(also=heartbeats[0x1017]).conditions[0]


def test_no_device_type_is_a_remark() -> None:
    found = fitness(device_type="")
    assert found.serves
    assert found.profile is None
    assert any("no device profile" in remark for remark in found.remarks)


def test_a_second_axis_is_a_remark() -> None:
    found = fitness(also=variable(0x6840, U16, "rww"))
    assert found.axes == 2
    assert any("2 axes" in remark for remark in found.remarks)


def test_what_is_recommended_and_missing_is_listed_with_its_consequence() -> None:
    lacks = {lack.index: lack.consequence for lack in fitness().lacks}
    assert "it does not notice by itself that the host is gone" in lacks[0x1016]
    assert 0x6041 not in lacks
    assert 0x1017 not in {lack.index for lack in fitness(also=variable(0x1017, U16, "rw")).lacks}


RECOMMENDED = {
    0x1003: "pre-defined error field",
    0x1005: "COB-ID SYNC",
    0x1008: "manufacturer device name",
    0x1010: "store parameters",
    0x1011: "restore default parameters",
    0x1013: "high resolution time stamp",
    0x1014: "COB-ID EMCY",
    0x1016: "consumer heartbeat time",
    0x1017: "producer heartbeat time",
    0x6007: "abort connection option code",
    0x603F: "error code",
    0x605A: "quick stop option code",
    0x605E: "fault reaction option code",
    0x6061: "modes of operation display",
    0x6064: "position actual value",
    0x6065: "following error window",
    0x606C: "velocity actual value",
    0x6071: "target torque",
    0x6072: "max torque",
    0x6075: "motor rated current",
    0x6076: "motor rated torque",
    0x6077: "torque actual value",
    0x607D: "software position limit",
    0x6080: "max motor speed",
    0x6085: "quick stop deceleration",
    0x608F: "position encoder resolution",
    0x6091: "gear ratio",
    0x60A8: "SI unit position",
    0x60A9: "SI unit velocity",
    0x6502: "supported drive modes",
}
"""Names as CiA 301 (7.5.2) and CiA 402-2 print them."""


def test_each_recommended_object_is_missed_by_its_own_index() -> None:
    in_the_sheet = {0x1005, 0x6061, 0x6064, 0x606C, 0x6071, 0x6077, 0x6502}
    also = {index: variable(index, U32, "rw") for index in RECOMMENDED if index not in in_the_sheet}
    assert fitness(also="".join(also.values())).lacks == ()
    assert {lack.index: lack.name for lack in fitness().lacks} == {
        index: name for index, name in RECOMMENDED.items() if index not in in_the_sheet
    }
    for index in in_the_sheet - {0x1005, 0x6502}:
        (lack,) = fitness(also="".join(also.values()), without=(index,)).lacks
        assert (lack.index, lack.name) == (index, RECOMMENDED[index])


def test_pdo_defaults_are_those_of_the_file() -> None:
    pdos = [Pdo(0x1400, kind=1, kind_access="ro"), Pdo(0x1801, (0x60410010,), False, cob_id="0xC0000285")]
    tpdo, rpdo = fitness(pdos).pdos
    assert (rpdo.name, rpdo.identifier, rpdo.valid, rpdo.transmission_type) == ("RPDO1", 0x205, True, 1)
    assert (tpdo.name, tpdo.identifier, tpdo.valid) == ("TPDO2", 0x285, False)
    assert (tpdo.mapping, tpdo.mapping_writable) == ((0x6041_0010,), False)


RAMP_REMARK = "6083h takes 7 at most: hil commission refuses a mode that it makes too slow"


@pytest.mark.parametrize(
    ("modes", "most", "said"),
    [("0x4", "7", [RAMP_REMARK]), ("0x204", "7", []), ("0x4", "0x7FFFFFFF", []), ("0x4", "", [])],
)
def test_a_ramp_is_remarked_whose_greatest_value_every_mode_obeys(
    modes: str, most: str, said: list[str]
) -> None:
    ramp = variable(0x6083, U32, "rw") + f"HighLimit={most}\n"
    found = fitness(modes=modes, also=ramp)
    assert [remark for remark in found.remarks if "6083h" in remark] == said


@pytest.mark.parametrize("index", [0x2F31, 0x1013])
def test_the_plan_by_a_sheet_has_its_makers_stamp_or_the_standards(index: int) -> None:
    """Elmo's drives have 2F31h and no 1013h, but for those that have it the other way round."""
    record = "[1018]\nParameterName=I\nObjectType=9\nSubNumber=2\n"
    record += sub(0x1018, 0, U8, "ro", "1") + sub(0x1018, 1, U32, "ro", "0x9A")
    found = fitness(also=record + variable(index, U32, "rw"))
    assert found.best is not None
    assert found.best.plan is not None
    speed = found.best.plan.plan.tpdo_with(0x606C)
    assert speed is not None
    assert [entry.index for entry in speed.entries] == [0x606C, index]
    assert 0x1013 not in {lack.index for lack in found.lacks}
    assert 0x1013 in {lack.index for lack in fitness(also=record).lacks}
