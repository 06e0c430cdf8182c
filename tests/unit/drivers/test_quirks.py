"""What is known of drives beside their objects."""

import math
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import pytest

from servobench.drivers.canopen.objects import RemoteObjects
from servobench.drivers.cia402.drive_setup import read_scaling
from servobench.drivers.cia402.quirky_units import Applied, apply_quirks
from servobench.drivers.cia402.scaling import ScaleOverride, scaling_from
from servobench.drivers.errors import BadInput
from servobench.drivers.vendors.families import DriveFamily, Quirk, known_families, quirks_for, read_family
from tests.unit.drivers.fake_bus import FakeServo, make_network

MAXON, TECHNOSOFT, NANOTEC = 0xFB, 0x1A3, 0x26C
NOTHING = ScaleOverride()


def applied(
    vendor: int, name: str, values: dict[tuple[int, int], int | None], override: ScaleOverride = NOTHING
) -> Applied:
    held = {(0x3000, 5): 3200}
    return apply_quirks(quirks_for(vendor, 1, name), values, override, lambda *key: held.get(key))


def test_every_entry_has_a_source() -> None:
    known = [family for family in known_families() if family.quirks]
    assert {family.vendor for family in known} >= {MAXON, TECHNOSOFT, NANOTEC}
    assert all(len(quirk.source) > 40 for family in known for quirk in family.quirks)


def test_epos4_has_its_rated_torque_in_micro_newton_metres_and_its_resolution_elsewhere() -> None:
    word = 0x00B44700
    known = applied(MAXON, "EPOS4", {(0x6076, 0): 512871, (0x60A8, 0): 0x00B50000, (0x60A9, 0): word})
    scaling = scaling_from(known.values, known.override)
    assert scaling.rated_torque_nm == pytest.approx(0.512871)
    assert scaling.position_rad == pytest.approx(2 * math.pi / 3200)
    assert scaling.velocity_rad_s == pytest.approx(2 * math.pi / 60)
    assert known.sources["position"] == "3000h:5 (maxon_epos4.toml)"


def test_ipos_counts_increments_per_sample() -> None:
    known = applied(TECHNOSOFT, "iPOS", {(0x608F, 1): 51200, (0x608F, 2): 1})
    scaling = scaling_from({**known.values, (0x6076, 0): 1000}, known.override)
    # 9322 raw are 1 deg/s, as its users found out.
    assert 9322 * scaling.velocity_rad_s == pytest.approx(math.radians(1.0), rel=1e-3)


def test_a_unit_word_of_the_drive_goes_before_what_is_known_of_its_make() -> None:
    values: dict[tuple[int, int], int | None] = {(0x608F, 1): 1000, (0x608F, 2): 1, (0x60A9, 0): 0x00B44700}
    assert applied(TECHNOSOFT, "iPOS", values).override == NOTHING


def test_the_user_goes_first() -> None:
    known = applied(MAXON, "EPOS4", {(0x6076, 0): 512871}, ScaleOverride(rated_torque_nm=0.4))
    assert known.override.rated_torque_nm == 0.4


def test_notes_are_passed_on() -> None:
    assert "203Bh:01" in applied(NANOTEC, "CL4-E", {}).notes[0]


@pytest.mark.parametrize(
    ("vendor", "product", "name", "fits"),
    [
        (7, 1, "Drive 12", True),
        (7, 1, "", True),
        (7, 1, "DRIVE", True),
        (7, 3, "Drive", False),
        (8, 1, "Drive", False),
        (7, 1, "Motor", False),
    ],
)
def test_a_family_is_known_by_vendor_product_and_name(
    vendor: int, product: int, name: str, fits: bool
) -> None:
    family = DriveFamily(
        name="x.toml",
        vendor=7,
        products=frozenset({1, 2}),
        device_name="Drive",
        quirks=(Quirk(source="here"),),
    )
    assert bool(quirks_for(vendor, product, name, [family])) == fits


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("vendor = 1\nvendr = 2", "vendr"),
        ("device_name = 'x'", "vendor"),
        ("vendor = 1\n[[entry]]\nnote = 'x'", "entry.0.source"),
        ("vendor = 1\n[[entry]]\nsource = 'x'\nvelocity = 2", "entry.0.velocity"),
    ],
)
def test_bad_files_are_named(text: str, key: str) -> None:
    with pytest.raises(BadInput) as caught:
        read_family(text, "bad.toml")
    assert caught.value.key == key


def test_other_units_of_position_and_velocity() -> None:
    quirk = Quirk(source="here", position_increments=4.0, velocity_rpm=0.5)
    known = apply_quirks([("x", quirk)], {(0x608F, 1): 1000, (0x608F, 2): 1}, NOTHING, lambda *_: None)
    assert known.override.position_rad == pytest.approx(4 * 2 * math.pi / 1000)
    assert known.override.velocity_rad_s == pytest.approx(math.pi / 60)


def test_a_drive_of_a_known_make_is_scaled_by_it() -> None:
    bus, network = make_network()
    servo = FakeServo(bus)
    servo.values[0x1018, 1] = MAXON
    servo.values[0x6076, 0] = 512871
    servo.texts[0x1008, 0] = b"EPOS4"
    for sub in (1, 2):
        del servo.types[0x608F, sub]
    servo.types[0x3000, 5], servo.values[0x3000, 5] = "I", 3200
    objects = RemoteObjects(network, 1)
    scaling = read_scaling(objects, NOTHING)
    assert scaling.rated_torque_nm == pytest.approx(0.512871)
    assert scaling.position_rad == pytest.approx(2 * math.pi / 3200)
    assert "maxon_epos4.toml" in scaling.sources["torque"]
    assert read_scaling(objects, replace(NOTHING, position_rad=0.5)).position_rad == 0.5
    bus.shutdown()


def test_the_table_of_makers_in_the_docs_is_that_of_their_files() -> None:
    page = (Path(__file__).parents[3] / "docs" / "box-to-axis.md").read_text(encoding="utf-8")
    rows = [
        [cell.strip() for cell in line.split("|")[1:-1]] for line in page.splitlines() if line[:2] == "| "
    ]
    told = {f"{row[0]}.toml": row[1:] for row in rows[1:]}

    def indices(objects: Iterable[int]) -> str:
        return ", ".join(f"{index:04X}h" for index in dict.fromkeys(objects))

    for family in known_families():
        if family.name == "servobench.toml":
            continue
        vendor, texts, units, motor, commutation, gains, stamp = told.pop(family.name)
        assert vendor == f"{family.vendor:08X}h"
        assert texts == ("yes" if family.texts or family.numbers else "")
        assert bool(units) == bool(family.quirks)
        assert motor == indices(each.index for each in (family.motor.objects if family.motor else ()))
        settings = family.commutation.settings if family.commutation else ()
        assert commutation == indices(each.index for each in settings)
        assert gains == indices(each.index for each in family.gains or ())
        assert stamp == (indices([family.stamp.index]) if family.stamp else "")
    assert told == {}
