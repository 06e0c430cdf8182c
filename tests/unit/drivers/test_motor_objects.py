"""Where makers keep what their drives were told of a motor: the files, the conventions, and reading them."""

import math
import re
from pathlib import Path

import pytest

from servobench.drivers.canopen.objects import RemoteObjects
from servobench.drivers.cia402.told_motor import ToldMotor, read_told_motor
from servobench.drivers.errors import BadInput
from servobench.drivers.vendors.families import known_families, motor_objects_for, read_family
from servobench.drivers.vendors.motor_objects import MotorObject, NotTold
from tests.unit.drivers.fake_bus import FakeServo, make_network

MAXON, TRINAMIC, NOVANTA, SYNAPTICON, FESTO, NANOTEC = 0xFB, 0x286, 0x29C, 0x22D2, 0x1D, 0x26C


def told(
    vendor: int, held: dict[tuple[int, int], tuple[str, int]], product: int = 1, name: str = ""
) -> ToldMotor:
    """What is read of a drive of ``vendor`` with these objects, each a ``struct`` character and a value."""
    bus, network = make_network()
    servo = FakeServo(bus)
    for key, (code, value) in held.items():
        servo.types[key], servo.values[key] = code, value
    found = read_told_motor(RemoteObjects(network, 1), vendor, product, name)
    bus.shutdown()
    return found


def test_every_maker_has_a_source_and_makers_are_several() -> None:
    makers = {family.vendor: family.motor for family in known_families() if family.motor is not None}
    assert makers.keys() >= {MAXON, TRINAMIC, NOVANTA, SYNAPTICON, FESTO, NANOTEC}
    assert all(len(motor.source) > 60 for motor in makers.values())


@pytest.mark.parametrize(
    ("vendor", "held", "values"),
    [
        # the DCF of an EPOS4 with an EC 90 flat, as maxon wrote it
        (
            MAXON,
            {(0x3001, 1): ("I", 4760), (0x3001, 3): ("B", 12), (0x3001, 5): ("I", 107746)},
            {"rated_current_a": 4.76, "pole_pairs": 12, "torque_constant_nm_a": 0.107746},
        ),
        # "if a 2 ARMS motor is used, the content of this object must be 2828"; 900 mOhm between two phases
        (
            NOVANTA,
            {(0x2301, 0): ("B", 5), (0x2701, 1): ("H", 900), (0x2701, 2): ("H", 60),
             (0x6075, 0): ("I", 2828)},
            {"pole_pairs": 5, "resistance_ohm": 0.45, "inductance_d_h": 3e-4, "inductance_q_h": 3e-4,
             "rated_current_a": 2.0},
        ),
        # between terminal and neutral point
        (
            SYNAPTICON,
            {(0x2003, 1): ("B", 7), (0x2003, 3): ("i", 450_000), (0x2003, 4): ("i", 300)},
            {"pole_pairs": 7, "resistance_ohm": 0.45, "inductance_d_h": 3e-4, "inductance_q_h": 3e-4},
        ),
        (FESTO, {(0x604D, 0): ("B", 8)}, {"pole_pairs": 4}),
        (NANOTEC, {(0x2030, 0): ("I", 50)}, {"pole_pairs": 50}),
    ],
    ids=["maxon", "novanta", "synapticon", "festo", "nanotec"],
)  # fmt: skip
def test_units_and_conventions_of_each_maker(
    vendor: int, held: dict[tuple[int, int], tuple[str, int]], values: dict[str, float]
) -> None:
    found = told(vendor, held, name="EPOS4" if vendor == MAXON else "")
    assert {name: figure.value for name, figure in found.figures.items()} == pytest.approx(values, rel=1e-3)
    assert found.not_told == ()


def test_only_the_family_is_asked() -> None:
    held = {(0x2056, 0): ("B", 4)}
    assert told(TRINAMIC, held, product=0x664).value("pole_pairs") == 4
    assert told(TRINAMIC, held, product=0x665) == ToldMotor()
    assert told(0x0BAD, held) == ToldMotor()
    assert not motor_objects_for(MAXON, 1, "EPOS2")


def test_objects_that_are_missing_or_refused_are_named_and_the_rest_is_taken() -> None:
    found = told(SYNAPTICON, {(0x2003, 1): ("B", 7)})
    assert found.value("pole_pairs") == 7
    assert len(found.not_told) == 3
    assert "resistance: object 2003h:03 (synapticon_somanet.toml) refused" in found.not_told[0]
    assert "abort code" in found.not_told[0]


def test_a_summit_drive_is_not_read_as_one_with_emcl() -> None:
    """The same vendor-ID; 2301h:00 may be there, and is something else."""
    found = told(NOVANTA, {(0x2301, 0): ("B", 5), (0x2701, 0): ("I", 20_000)})
    assert not found.figures
    assert found.not_told == ("motor data of novanta_emcl.toml: the drive has no 2701h:01, so none of them",)


def test_what_nobody_has_set_is_not_taken() -> None:
    held = {(0x2301, 0): ("B", 5), (0x2701, 1): ("H", 800), (0x2701, 2): ("H", 120), (0x6075, 0): ("I", 0)}
    found = told(NOVANTA, held)
    assert found.figures.keys() == {"pole_pairs"}
    assert "resistance: object 2701h:01 (novanta_emcl.toml) tells 800, as nobody has set it" in found.not_told


@pytest.mark.parametrize(
    ("data", "said"),
    [
        ("09", "9, which cannot be"),
        ("00", "nobody has set it"),
        ("0801", "is no UNSIGNED8"),
        ("", "no octet is no UNSIGNED8"),
    ],
)
def test_what_is_no_number_of_poles_is_refused(data: str, said: str) -> None:
    poles = MotorObject(quantity="pole_pairs", index=0x604D, type="UNSIGNED8", unit=0.5)
    with pytest.raises(NotTold, match=said):
        poles.value(bytes.fromhex(data))
    assert poles.value(bytes.fromhex("08000000")) == (4.0, 8), "more octets than it has, and still one of its"


def test_a_negative_resistance_and_two_octets_of_four_are_refused() -> None:
    ohm = MotorObject(quantity="resistance_ohm", index=0x2003, type="INTEGER32", convention="phase")
    for data in ("ffffffff", "0001"):
        with pytest.raises(NotTold):
            ohm.value(bytes.fromhex(data))


@pytest.mark.parametrize(("ampere", "raw"), [("rms", 2000), ("peak", round(1000 * math.sqrt(2.0)))])
def test_a_torque_constant_per_ampere_of_either_kind(ampere: str, raw: int) -> None:
    constant = MotorObject(
        quantity="torque_constant_nm_a", index=0x2000, type="UNSIGNED16", unit=1e-3, convention=ampere
    )
    assert constant.value(raw.to_bytes(2, "little"))[0] == pytest.approx(2.0, rel=1e-3)
    assert constant.raw(2.0) == raw
    assert constant.raw(1e9) == 0xFFFF


def test_the_example_of_the_documentation_is_one() -> None:
    text = (Path(__file__).parents[3] / "docs" / "write-your-own.md").read_text(encoding="utf-8")
    (example,) = (block for block in re.findall(r"```toml\n(.*?)```", text, re.DOTALL) if "[motor]" in block)
    motor = read_family(example, "example.toml").motor
    assert motor is not None
    (ohm,) = motor.objects
    assert ohm.value(b"\x84\x03")[0] == pytest.approx(0.45), "900 mOhm between lines"


GOOD = "index = 0x2000\ntype = 'UNSIGNED16'\n"


@pytest.mark.parametrize(
    ("text", "key"),
    [
        (f"[motor.pole_pairs]\n{GOOD}", "motor.source"),
        (f"[motor]\nsource = 'x'\n[motor.poles]\n{GOOD}", "motor.poles"),
        ("[motor]\nsource = 'x'\n[motor.pole_pairs]\ntype = 'UNSIGNED8'", "motor.pole_pairs.index"),
        ("[motor]\nsource = 'x'\n[motor.pole_pairs]\nindex = 8192\ntype = 'u8'", "motor.pole_pairs.type"),
        (f"[motor]\nsource = 'x'\n[motor.resistance_ohm]\n{GOOD}", "motor.resistance_ohm.between"),
        (f"[motor]\nsource = 'x'\n[motor.pole_pairs]\n{GOOD}between = 'lines'", "motor.pole_pairs.between"),
        (f"[motor]\nsource = 'x'\n[motor.pole_pairs]\n{GOOD}unit = 0", "motor.pole_pairs.unit"),
    ],
)
def test_bad_files_are_named(text: str, key: str) -> None:
    with pytest.raises(BadInput) as caught:
        read_family(f"vendor = 1\n{text}", "bad.toml")
    assert caught.value.key == key
