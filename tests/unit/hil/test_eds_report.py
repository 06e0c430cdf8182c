"""What ``hil eds`` prints of a data sheet, part by part; a plan's cost counted by the bits of its frames."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from servobench.drivers.canopen.pdo import PdoDirection, PdoPlan
from servobench.drivers.canopen.pdo_budget import Budget, BudgetLine
from servobench.drivers.canopen.pdo_capability import PdoSlot
from servobench.drivers.cia402.judgement import ModeFitness
from servobench.drivers.cia402.pdo_planner import PlanResult
from servobench.drivers.cia402.profile import Mode
from servobench.drivers.sheets.dictionary import LoadedDictionary
from servobench.drivers.sheets.eds.information import Commissioning, DeviceInformation, FileInformation
from servobench.drivers.sheets.eds.text import Repair
from servobench.drivers.sheets.fitness import FileIdentity, Fitness, Lack, assess
from servobench.drivers.timebase import Duration
from servobench.hil.commissioning.drive_port import QUANTITY_OF_MODE
from servobench.hil.terminal.eds_report import print_sheet
from servobench.hil.terminal.eds_sheet import Planned, plan_for, sheet, unit_lines
from tests.unit.drivers.eds_maker import NODE, four_pdos
from tests.unit.drivers.eds_maker import sheet as made_sheet

FILE = Path("made.eds")
MADE = replace(made_sheet(four_pdos()), repairs=())
ASSESSED = assess(MADE, NODE, tuple(QUANTITY_OF_MODE))
NOBODY = FileIdentity("", "", "", None, None, None, "", None)
PLAIN = replace(ASSESSED, identity=NOBODY, profile=None, modes=(), pdos=(), lacks=(), remarks=())
MODES = "What its modes serve for"
SIZE = "29 objects, 125 entries"


@pytest.fixture
def printed(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Any:
    """The parts that are printed, each of its lines with single blanks between its cells."""
    monkeypatch.setenv("COLUMNS", "220")

    def parts(
        fitness: Fitness = PLAIN, loaded: LoadedDictionary = MADE, planned: Planned | None = None
    ) -> list[list[str]]:
        print_sheet(FILE, loaded, fitness, planned)
        lines = (" ".join(line.split()) for line in capsys.readouterr().out.splitlines())
        return [part.split("\n") for part in "\n".join(lines).split("\n\n")]

    return parts


UNITS = [
    "One raw unit, of the motor shaft, by the values in the file",
    *(f"{name} not told" for name in ("position", "velocity", "acceleration", "torque")),
]
SERVES = [
    "It can serve a bench, best in cyclic synchronous torque; `hil run` can use it with mode = "
    '"cst" or "csv" or "csp".'
]


def test_a_sheet_that_tells_little_is_printed_without_what_it_lacks(printed: Any) -> None:
    assert printed() == [
        [
            f"File made.eds (EDS, node 5, {SIZE})",
            "Identity none given",
            "Profile not given, 1 axis with a controlword",
            "Modes none, by 6502h",
        ],
        ["PDOs as the device has them", "none"],
        UNITS,
        ["The file needed no repair."],
        SERVES,
    ]


def test_what_the_sheet_says_of_itself_stands_first(printed: Any) -> None:
    identity = FileIdentity("Maker", "Servo", "X1", 0x123, 0, 0x10002, "Servo 2", 0x20192)
    loaded = replace(
        MADE,
        kind="DCF",
        file=FileInformation(version="1", revision="", created="2001", modified=""),
        device=DeviceInformation(bit_rates_kbit_s=(125, 1000)),
        commissioning=Commissioning(7, "left", 500, serial_number=0xAB),
    )
    fitness = replace(
        PLAIN, identity=identity, profile=402, axes=2, modes=(Mode.PROFILE_VELOCITY, Mode.HOMING)
    )
    assert printed(fitness, loaded)[0] == [
        f"File made.eds (DCF, node 5, {SIZE})",
        "Made 2001 version 1.0",
        "Device Maker Servo (device name Servo 2)",
        "Identity vendor 00000123h, product 00000000h, revision 00010002h, device type 00020192h",
        "Profile drive (CiA 402), 2 axes with a controlword",
        "Modes profile velocity, homing, by 6502h",
        "Bit rates 125, 1000 kbit/s",
        "Commissioning node 7, left, 500 kbit/s, serial 000000ABh",
    ]


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"file": FileInformation(created="2001", modified="2002")}, "Made 2002"),
        ({"file": FileInformation(version="3", revision="4")}, "Made version 3.4"),
        ({"file": FileInformation(revision="4")}, None),
        ({"commissioning": Commissioning()}, None),
        ({"commissioning": Commissioning(0, serial_number=0)}, "Commissioning node 0, serial 00000000h"),
        ({"commissioning": Commissioning(bit_rate_kbit_s=20)}, "Commissioning 20 kbit/s"),
    ],
)
def test_what_is_not_said_is_left_out(printed: Any, changes: dict[str, Any], line: str | None) -> None:
    facts = [each for each in printed(PLAIN, replace(MADE, **changes))[0] if each[:4] in ("Made", "Comm")]
    assert facts == ([] if line is None else [line])


@pytest.mark.parametrize(
    ("vendor", "product", "device", "line"),
    [
        ("Maker", "", "", "Device Maker"),
        ("", "Servo", "Servo", "Device Servo"),
        ("", "Servo", "", "Device Servo"),
        ("", "", "Servo", "Device (device name Servo)"),
    ],
)
def test_a_device_is_named_once(printed: Any, vendor: str, product: str, device: str, line: str) -> None:
    identity = NOBODY._replace(vendor_name=vendor, product_name=product, device_name=device)
    assert printed(replace(PLAIN, identity=identity))[0][1] == line


@pytest.mark.parametrize(
    ("profile", "words"),
    [(0, "no standard profile"), (401, "I/O module (CiA 401)"), (None, "not given")],
)
def test_the_profile_is_told_in_words(printed: Any, profile: int | None, words: str) -> None:
    told = printed(replace(PLAIN, profile=profile))[0][2]
    assert told.removesuffix(", 1 axis with a controlword") == f"Profile {words}"


SLOT = PdoSlot(PdoDirection.TRANSMIT, 1, 0x185, True, 255, True, (0x6041_0010, 0x606C_0020), True, 8, 25, 40)


def test_the_pdos_are_listed_as_the_device_has_them(printed: Any) -> None:
    off = replace(SLOT, direction=PdoDirection.RECEIVE, number=3, cob_id=1 << 31 | 0x305)
    bare = PdoSlot(PdoDirection.TRANSMIT, 7, None, True, None, True, (), False, 0)
    assert printed(replace(PLAIN, pdos=(SLOT, replace(off, event_timer=0, inhibit_time=0), bare)))[1] == [
        "PDOs as the device has them",
        "PDO COB-ID type inhibit event mapping",
        "TPDO1 185h 255 2.5 ms 40 ms 6041h:00/16 606Ch:00/32 (8 entries)",
        "RPDO3 305h off 255 - - 6041h:00/16 606Ch:00/32 (8 entries)",
        "TPDO7 - off - - - nothing (fixed)",
    ]


def test_a_plan_that_is_impossible_has_its_reason_and_no_table(printed: Any) -> None:
    impossible = ["PDO plan for homing", "none: no set-point"]
    assert printed(planned=Planned("homing", None, None, "no set-point"))[2] == impossible
    result, budget = PlanResult(PdoPlan((), ())), Budget((), Duration(1), 1)
    assert printed(planned=Planned("homing", result, None, "no set-point"))[2] == impossible
    assert printed(planned=Planned("homing", None, budget, "no set-point"))[2] == impossible


def budget(bits: int, period_us: int) -> Budget:
    """Of SYNC and one frame of so many bits in two cycles of three, at 500 kbit/s: 2 us a bit."""
    lines = (
        BudgetLine("SYNC", 0x80, 0, 55, Duration(110_000), 1.0, ""),
        BudgetLine("TPDO1", 0x185, 8, bits, Duration(2_000 * bits), 0.25, "6041h:00/16"),
    )
    return Budget(lines, Duration(period_us * 1_000), 500_000)


def test_a_plan_is_told_frame_by_frame_with_its_load(printed: Any) -> None:
    """110 us and a quarter of 270 us of 500 us; all at once 380, of which a cycle of 475 us leaves 20 %. The
    frames of an SDO transfer have 135 bits each."""
    result = PlanResult(PdoPlan((), ()), ("first", "second"))
    left = 1.0 - 177.5 / 500.0
    assert printed(planned=Planned("homing", result, budget(135, 500)))[2] == [
        "PDO plan for homing",
        "frame COB-ID bytes bits us a cycle content",
        "SYNC 080h 0 55 110 1",
        "TPDO1 185h 8 135 270 0.25 6041h:00/16",
        "178 us of 500 us at 500 kbit/s: 35.5 % of the bus, 76.0 % in the fullest cycle",
        f"shortest cycle 475 us with 20 % left; room for {left * 500_000 / 270:.0f} SDO transfers a second",
        "note: first",
        "note: second",
    ]


def test_units_lacks_repairs_and_remarks_are_told_each_in_a_line(printed: Any) -> None:
    one = Repair("6041sub0", "no type", "taken for 6")
    fitness = replace(
        PLAIN, lacks=(Lack(0x1003, "history", "none [told]"), Lack(0x6072, "max", "no limit")),
        remarks=("slow", "[loud]"),
    )  # fmt: skip
    parts = printed(fitness, replace(MADE, repairs=(one,)))
    assert parts[3] == [
        "Recommended objects that it does not have", "1003h history none [told]", "6072h max no limit",
    ]  # fmt: skip
    assert parts[4] == ["1 repair to read the file", "[6041sub0] no type: taken for 6"]
    assert parts[5] == ["note: slow", "note: [loud]", *SERVES]
    two = printed(PLAIN, replace(MADE, repairs=(one, one._replace(line=17))))[3]
    assert two == [
        "2 repairs to read the file",
        "[6041sub0] no type: taken for 6",
        "line 17 [6041sub0] no type: taken for 6",
    ]


def test_each_mode_says_whether_it_can_be_commissioned_and_run(printed: Any) -> None:
    plan = ASSESSED.usable[0].plan
    usable = (
        ModeFitness(Mode.CYCLIC_SYNCHRONOUS_TORQUE, None, "6071h:00 is [not] there"),
        ModeFitness(Mode.PROFILE_TORQUE, plan),
        ModeFitness(Mode.CYCLIC_SYNCHRONOUS_VELOCITY, plan),
    )
    modes = (
        Mode.PROFILE_TORQUE,
        Mode.HOMING,
        Mode.CYCLIC_SYNCHRONOUS_VELOCITY,
        Mode.CYCLIC_SYNCHRONOUS_TORQUE,
    )
    fitness = replace(PLAIN, modes=modes, usable=usable)
    assert printed(fitness)[1] == [
        MODES,
        "mode hil commission hil run",
        "cyclic synchronous torque no no 6071h:00 is [not] there",
        "profile torque yes no",
        'cyclic synchronous velocity yes mode = "csv"',
        "homing no no",
    ]
    assert [line.split() for line in printed(replace(fitness, obstacles=("o",)))[1][3:5]] == [
        ["profile", "torque", "no", "no"],
        ["cyclic", "synchronous", "velocity", "no", "no"],
    ]


def test_a_drive_that_cannot_serve_has_its_obstacles_at_the_end(printed: Any) -> None:
    fitness = replace(PLAIN, obstacles=("no controlword", "no [plan]"))
    assert printed(fitness)[-1] == ["It cannot serve a bench:", "no controlword", "no [plan]"]


# ---- for programs -------------------------------------------------------------------------------------


def told(fitness: Fitness = PLAIN, loaded: LoadedDictionary = MADE, planned: Planned | None = None) -> Any:
    return sheet(FILE, loaded, fitness, planned)


def test_the_sheet_of_a_bare_file_is_whole() -> None:
    one = Repair("6041sub0", "no type", "taken for 6", 17)
    usable = (ModeFitness(Mode.HOMING, None, "no plan"),)
    fitness = replace(
        PLAIN,
        usable=usable,
        obstacles=("o",),
        conditions=("c",),
        remarks=("r",),
        lacks=(Lack(0x1003, "n", "c"),),
        pdos=(SLOT,),
    )
    loaded = replace(MADE, repairs=(one,), commissioning=Commissioning(7))
    assert told(fitness, loaded) == {
        "file": "made.eds", "serves": False, "obstacles": ["o"], "remarks": ["r"], "kind": "EDS",
        "node_id": 5,
        "identity": {
            "vendor_name": "", "product_name": "", "order_code": "", "device_name": "", "vendor_id": None,
            "product_code": None, "revision": None, "device_type": None,
        },
        "profile": None, "axes": 1, "modes": [], "modes_told_by": "6502h",
        "usable_modes": [
            {"mode": "homing", "pdo_plan": False, "commission": False, "run": None, "reason": "no plan"}
        ],
        "conditions": ["c"],
        "pdos": [
            {
                "name": "TPDO1", "cob_id": "0x185", "valid": True, "transmission_type": 255,
                "inhibit_time_us": 2500, "event_timer_ms": 40, "mapping": ["6041h:00/16", "606Ch:00/32"],
                "mapping_writable": True, "entries_max": 8,
            }
        ],
        "missing": [{"index": "1003h", "name": "n", "consequence": "c"}],
        "units": [line._asdict() for line in unit_lines(loaded, fitness)[0]],
        "repairs": [{"section": "6041sub0", "fault": "no type", "action": "taken for 6", "line": 17}],
        "objects": {"total": 29, "communication": 18, "manufacturer": 0, "profile": 11, "entries": 125},
        "file_information": {
            "name": "", "version": "", "revision": "", "eds_version": "", "description": "", "created": "",
            "modified": "",
        },
        "device_information": told()["device_information"],
        "commissioning": {
            "node_id": 7, "node_name": "", "bit_rate_kbit_s": None, "net_number": None, "network_name": "",
            "serial_number": None,
        },
        "denotations": {},
    }  # fmt: skip


def test_numbers_of_an_identity_are_hexadecimal() -> None:
    identity = FileIdentity("m", "p", "o", 1, 0, 0xABCDEF12, "d", 402)
    assert told(replace(PLAIN, identity=identity))["identity"] == {
        "vendor_name": "m", "product_name": "p", "order_code": "o", "device_name": "d",
        "vendor_id": "0x00000001", "product_code": "0x00000000", "revision": "0xABCDEF12",
        "device_type": "0x00000192",
    }  # fmt: skip


def test_a_pdo_that_is_not_there_tells_nothing() -> None:
    bare = PdoSlot(PdoDirection.TRANSMIT, 7, 1 << 31, True, None, True, (), False, 0)
    (pdo,) = told(replace(PLAIN, pdos=(bare,)))["pdos"]
    assert pdo == {
        "name": "TPDO7", "cob_id": None, "valid": False, "transmission_type": None, "inhibit_time_us": None,
        "event_timer_ms": None, "mapping": [], "mapping_writable": False, "entries_max": 0,
    }  # fmt: skip


def test_a_plan_for_programs_has_its_frames_in_us() -> None:
    assert "plan" not in told()
    impossible = {"mode": "homing", "possible": False, "reason": "none"}
    assert told(planned=Planned("homing", None, None, "none"))["plan"] == impossible
    plan = PlanResult(PdoPlan((), ()), ("first",))
    frame = {"cob_id": "0x080", "data_bytes": 0, "bits_max": 55, "time_us": 110.0, "a_cycle": 1.0}
    other = {"cob_id": "0x185", "data_bytes": 8, "bits_max": 135, "time_us": 270.0, "a_cycle": 0.25}
    assert told(planned=Planned("homing", plan, budget(135, 500)))["plan"] == {
        "mode": "homing", "possible": True, "notes": ["first"], "pdos": [],
        "budget": {
            "period_us": 500.0, "bitrate_bit_s": 500_000,
            "frames": [{"name": "SYNC"} | frame, {"name": "TPDO1"} | other],
            "busy_us": 177.5, "load_percent": pytest.approx(35.5),
            "fullest_cycle_percent": pytest.approx(76.0),
            "shortest_period_us": pytest.approx(475.0, abs=0.01),
            "sdo_transfers_a_s": pytest.approx((1.0 - 0.355) * 500_000 / 270),
        },
    }  # fmt: skip


def test_a_plan_is_for_the_mode_asked_for_or_the_best() -> None:
    best = plan_for(MADE, ASSESSED, NODE, None, 1000, 1_000_000)
    asked = plan_for(MADE, ASSESSED, NODE, "cst", 1000, 1_000_000)
    assert best == asked
    assert asked is not None
    assert asked.budget is not None
    assert (asked.mode, asked.reason) == ("cyclic synchronous torque", "")
    assert (asked.budget.period_ns, asked.budget.bitrate_bit_s) == (1_000_000, 1_000_000)
    other = plan_for(MADE, ASSESSED, NODE, "pp", 1000, 1_000_000)
    assert other is not None
    assert other.mode == "profile position"
    assert plan_for(MADE, replace(ASSESSED, usable=()), NODE, None, 1000, 1_000_000) is None
