"""Every number in every file of a bench, a campaign or a fault plan refuses what is none of its kind.

Fields are found, not listed. From Python and from pytest a bench is the tables of its file: there is
one definition.
"""

import math
import tomllib
from collections.abc import Iterator
from functools import partial
from importlib import import_module
from pkgutil import iter_modules
from typing import Any, get_args

import numpy as np
import pytest
from pydantic import BaseModel, ValidationError

import servobench
from servobench.drivers.errors import BadInput
from servobench.hil.configuration.bench_file import faults_from, load_bench
from servobench.hil.configuration.config import Background
from servobench.hil.configuration.config_files import BadInputs, toml_text
from servobench.hil.configuration.controller_files import CurrentLoop
from servobench.virtual_bus.faults.register import TABLES
from tests.pictures.cases import FAULTS
from tests.scenario.processes import BENCH

NO_NUMBERS = (math.nan, math.inf, -math.inf, True, False, "1.0", b"1", 1j, np.float64(math.nan))
FILES = ("hil.configuration", "hil.campaign.sweep_file", "virtual_bus.faults.fault_plan")


def models(base: type[BaseModel]) -> Iterator[type[BaseModel]]:
    for model in base.__subclasses__():
        yield model
        yield from models(model)


def numbers_in(hint: Any) -> bool:
    """``int``, ``float``, or a whole number of a Literal, somewhere in it."""
    return hint in (int, float) or type(hint) is int or any(numbers_in(part) for part in get_args(hint))


def _place(model: type[BaseModel]) -> tuple[str, ...]:
    """Return the same order in each process: two tables of a verdict bear one name."""
    return model.__module__, model.__qualname__, *model.model_fields


def fields() -> list[tuple[type[BaseModel], str]]:
    for name in FILES:
        room = import_module(f"servobench.{name}")
        for module in iter_modules(getattr(room, "__path__", ())):
            import_module(f"{room.__name__}.{module.name}")
    return [
        (model, key)
        for model in sorted({*models(BaseModel)}, key=_place)
        if model.__module__.startswith("servobench.")
        for key, field in model.model_fields.items()
        if numbers_in(field.annotation)
    ]


FIELDS = fields()


def test_numbers_are_found_in_each_kind_of_file() -> None:
    found = {(model.__name__, key) for model, key in FIELDS}
    assert {("LoopConfig", "period_us"), ("CampaignSection", "seeds"), ("Loss", "probability")} <= found, (
        found
    )
    assert len(FIELDS) > 300


def refused_at(model: type[BaseModel], key: str, value: Any) -> set[object]:
    """Return the places at which ``value`` is refused for ``key``; none if it is accepted."""
    try:
        model.__pydantic_validator__.validate_assignment(model.model_construct(), key, value)
    except ValidationError as error:
        return {part for each in error.errors() for part in each["loc"]}
    except BadInput:
        return {key}
    return set()


@pytest.mark.parametrize("module", sorted({model.__module__ for model, _ in FIELDS}))
def test_what_is_no_number_is_refused_at_its_key(module: str) -> None:
    wrong = [
        (model.__name__, key, value)
        for model, key in FIELDS
        if model.__module__ == module
        for value in NO_NUMBERS
        if key not in refused_at(model, key, value)
    ]
    assert wrong == []


@pytest.mark.parametrize("key", ["bench.duration_s", "loop.period_us", "reference.axis1.0.at_s"])
@pytest.mark.parametrize("value", [math.nan, math.inf, True, "1"])
def test_python_and_a_file_are_refused_at_the_same_key(tmp_path: Any, key: str, value: Any) -> None:
    whole = tomllib.loads(load_bench(BENCH).resolved_text())
    changed = servobench.Bench(whole).changed({key: value})
    file = tmp_path / "bench.toml"
    file.write_text(toml_text(changed.tables))
    told, benches = [], (partial(servobench.Bench, changed.tables), partial(servobench.Bench.load, file))
    for bench in benches:
        with pytest.raises((BadInput, BadInputs)) as refused:
            assert bench().config
        told.append(str(refused.value).partition(": ")[2].partition(", expected")[0])
    assert told[0] == told[1]


def pairs(model: type[BaseModel]) -> Iterator[tuple[str, str]]:
    """Names of a least and a most of the same quantity."""
    for least, most in (("from_s", "until_s"), ("low", "high")):
        if least in model.model_fields and most in model.model_fields:
            yield least, most
    for name in model.model_fields:
        most = name.replace("_min", "_max")
        if most != name and most in model.model_fields:
            yield name, most


BOUNDS = [
    pytest.param(kind, least, most, id=f"{kind}-{least}")
    for kind, table in TABLES.items()
    for least, most in pairs(table)
]


def test_there_are_bounds() -> None:
    assert {("delay", "delay_min_us", "delay_max_us"), ("loss", "from_s", "until_s")} <= {
        case.values for case in BOUNDS
    }


@pytest.mark.parametrize(("kind", "least", "most"), BOUNDS)
def test_swapped_bounds_of_a_fault_are_refused(kind: str, least: str, most: str) -> None:
    apart = {least.replace("_min", ""), "duration_s" if kind == "blackout" else ""}  # given in their place
    entry = {key: value for key, value in FAULTS[kind].items() if key not in apart}
    with pytest.raises((BadInput, BadInputs)) as refused:
        faults_from({kind: [entry | {least: 2, most: 1}]}, "plan")
    assert f"{kind}[0]" in str(refused.value)
    assert least in str(refused.value)
    assert most in str(refused.value)


@pytest.mark.parametrize(
    ("model", "swapped"),
    [
        (CurrentLoop, {"bandwidth_hz": 1.5, "bandwidth_min_hz": 2.0, "bandwidth_max_hz": 1.0}),
        (Background, {"can_id": 0x700, "period_us": 1000, "bytes_min": 7, "bytes_max": 3}),
    ],
)
def test_swapped_bounds_of_a_bench_are_refused(model: type[BaseModel], swapped: dict[str, Any]) -> None:
    least, most = next(pairs(model))
    with pytest.raises(ValidationError, match=f"{least}|{most}"):
        model.model_validate(swapped)
    assert model.model_validate(swapped | {least: swapped[most], most: swapped[least]})
