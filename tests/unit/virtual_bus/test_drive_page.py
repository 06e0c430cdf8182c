"""The page about the simulated drive names objects and modes that are there, and all of its own."""

import re
from dataclasses import replace
from pathlib import Path

from servobench.design.mechanism import EndStops, Mechanism, PlacedLoad
from servobench.design.motor import Commutation
from servobench.drivers.canopen.objects301 import DataType
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import Mode
from servobench.virtual_bus.drive.homing_methods import HOMING_METHODS
from servobench.virtual_bus.drive.servo_parameters import DriveParameters
from tests.motors import LING
from tests.unit.virtual_bus.servo_bench import ServoBench

PAGE = (Path(__file__).parents[3] / "docs" / "simulated-drive.md").read_text(encoding="utf-8")
MACHINE_ROW = re.compile(r"^\| (2\d{3}h:.*?) \| (\w+) \|", re.MULTILINE)
ALL_OF_IT = replace(
    LING,
    mechanism=Mechanism(load=PlacedLoad(stops=EndStops(-1.0, 1.0, 100.0, 0.1))),
    commutation=Commutation(),
)
"""A machine that every object is there for."""


def test_every_object_of_the_page_is_in_the_dictionary() -> None:
    dictionary = ServoBench(motor=ALL_OF_IT).servo.dictionary
    named = {int(index, 16) for index in re.findall(r"\b(6[0-9A-F]{3})h", PAGE)}
    assert len(named) > 30
    assert [f"{index:04X}" for index in sorted(named) if index not in dictionary] == []


def test_the_machines_objects_have_these_types_and_no_other_is_there() -> None:
    dictionary = ServoBench(DriveParameters(gain_objects=True), motor=ALL_OF_IT).servo.dictionary
    told = {
        (int(index, 16), int(sub)): DataType[kind]
        for names, kind in MACHINE_ROW.findall(PAGE)
        for index, sub in re.findall(r"(\w{4})h:(\d+)", names)
    }
    there = {
        (index, sub): variable.data_type
        for index in (0x2100, 0x2110, 0x2120, 0x2121)
        for sub, variable in dictionary.object(index).members.items()
        if sub
    }
    assert told == there


def test_modes_and_methods_are_those_of_the_drive() -> None:
    numbers = {int(number) for number in re.findall(r"^\| [a-z ]+ \| (\d+) \|", PAGE, re.MULTILINE)}
    bits = ServoBench().read(Object.SUPPORTED_DRIVE_MODES, "I")
    assert numbers == {int(mode) for mode in Mode if mode > 0 and bits >> (mode - 1) & 1}
    assert "methods 1 to 14, 17 to 30, 33, 34, 35 and 37" in PAGE
    assert set(HOMING_METHODS) == {*range(1, 15), *range(17, 31), 33, 34, 35, 37}
