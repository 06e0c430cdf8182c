"""What is said in ``observe`` of an object: its place, type, name and unit, and what is refused of it."""

from typing import Any

import pytest
from pydantic import TypeAdapter, ValidationError

from servobench.drivers.canopen.pdo import PdoEntry
from servobench.hil.configuration.config_axis import (
    ENTRIES_MAX,
    Observe,
    ObservedObject,
    observed_faults,
)

TABLES: TypeAdapter[tuple[ObservedObject, ...]] = TypeAdapter(Observe)


def one(**table: Any) -> ObservedObject:
    return ObservedObject.model_validate(table)


def observed(*entries: Any) -> tuple[ObservedObject, ...]:
    return TABLES.validate_python(list(entries))


@pytest.mark.parametrize(
    ("text", "kept", "key"),
    [
        ("6078", "6078", (0x6078, 0)),
        ("2a0f:1", "2A0F:1", (0x2A0F, 1)),
        ("2101:255", "2101:255", (0x2101, 255)),
        ("2101:0", "2101:0", (0x2101, 0)),
    ],
)
def test_an_object_is_an_index_and_a_sub_index(text: str, kept: str, key: tuple[int, int]) -> None:
    (made,) = observed(text)
    assert (made.object, made.key) == (kept, key)


@pytest.mark.parametrize("text", ["", "607", "0x6078", "60780", "2101:", "2101:256", "2101:1000", "2101.1"])
def test_what_is_no_object_is_refused(text: str) -> None:
    with pytest.raises(ValidationError) as caught:
        observed(text)
    (error,) = caught.value.errors()
    assert error["msg"] == 'Value error, an object ("6078"), or with its sub-index ("2101:1")'


def test_an_object_of_the_standard_tells_its_type_name_and_unit() -> None:
    current, voltage = observed("6078", "6079")
    assert (current.title, current.factor, current.told_unit) == ("current", 0.1, "% of rated")
    assert (voltage.title, voltage.factor, voltage.told_unit) == ("DC link voltage", 1e-3, "V")
    assert (current.entry, voltage.entry) == (PdoEntry(0x6078, 0, "h"), PdoEntry(0x6079, 0, "I"))


def test_what_is_said_goes_before_the_standard() -> None:
    said = one(object="6078", type="int32", name="i", scale=0.5, unit="A")
    assert (said.title, said.factor, said.told_unit, said.code) == ("i", 0.5, "A", "i")
    assert one(object="6078", scale=2.0).told_unit == "", "of a scale of one's own the unit is not known"
    assert one(object="6078", unit="").told_unit == ""
    assert one(object="6078", scale=0.0).factor == 0.0


def test_a_maker_s_object_has_no_type_of_itself() -> None:
    made = one(object="2101:1")
    assert (made.code, made.factor, made.told_unit) == (None, 1.0, "")
    assert made.title == "2101h:01"


@pytest.mark.parametrize(
    ("name", "code"),
    [
        *(("int8", "b"), ("int16", "h"), ("int32", "i"), ("int64", "q"), ("real32", "f")),
        *(("uint8", "B"), ("uint16", "H"), ("uint32", "I"), ("uint64", "Q"), ("real64", "d")),
    ],
)
def test_each_type_has_its_code(name: str, code: str) -> None:
    assert one(object="2101:1", type=name).code == code


def faults(*entries: Any) -> list[tuple[str, object, str, str]]:
    return list(observed_faults("drive.a.observe", observed(*entries)))


LOOP = "an object that the loop does not read anyway"
REMEDY = 'type = "int16", "uint32", ... as the maker\'s manual has it'


@pytest.mark.parametrize("text", ["6041", "6064", "606C", "6077", "6074"])
def test_what_the_loop_reads_is_not_observed(text: str) -> None:
    assert faults("6078", text) == [("drive.a.observe[1].object", text, LOOP, "")]


def test_a_type_that_nobody_says_is_asked_for() -> None:
    expected = "the data type of a maker's object"
    assert faults("2101:1") == [("drive.a.observe[0].type", "nothing", expected, REMEDY)]


def test_an_object_and_a_name_stand_once() -> None:
    twice = {"object": "2101:1", "type": "int16", "name": "i"}
    assert faults(twice, twice | {"name": "j"}) == [
        (f"drive.a.observe[{place}].object", "2101:1", "each object once", "") for place in (0, 1)
    ]
    assert faults(twice, twice | {"object": "2101:2"}, "6079") == [
        (f"drive.a.observe[{place}].name", "i", "a name of its own", "") for place in (0, 1)
    ]
    assert faults(twice, "6078", "6079") == []


@pytest.mark.parametrize("beyond", [0, 1])
def test_so_many_as_pdos_hold_are_observed(beyond: int) -> None:
    entries = [f"2101:{number}" for number in range(ENTRIES_MAX + beyond)]
    if not beyond:
        assert len(observed(*entries)) == ENTRIES_MAX
        return
    with pytest.raises(ValidationError):
        observed(*entries)
