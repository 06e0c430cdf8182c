"""Common parts of every configuration file: reading its tables, the rules for them, and their errors.

A validator's messages become errors that a user can act on. Every fault of a file is reported at once: one
:class:`servobench.drivers.errors.BadInput` each, with the file, the dotted key, the value found and what was
expected.

Writes plain tables as TOML text, which the standard library reads but does not write.

tomlkit takes 40 ms to load: only a writer, or an error about a bad key, waits for it.
"""

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NoReturn, TypeVar, get_origin

from pydantic import BaseModel, ConfigDict, ValidationError
from pydantic_core import ErrorDetails

from servobench.drivers.bounded_file import NamedBy, read_toml
from servobench.drivers.errors import MISSING, BadInput, BenchError
from servobench.drivers.key_advice import UnknownKey, unknown_key


def toml_text(tables: Mapping[str, Any]) -> str:
    """Return ``tables`` as TOML v1.0: reading it back gives an equal mapping.

    Values: bool, int, float, str, and lists and tables of them. Raises TypeError for another type.
    """
    import tomlkit

    return tomlkit.dumps(tables)


def key_text(key: str) -> str:
    """Return one key, in quotes if it needs them."""
    import tomlkit

    return tomlkit.key(key).as_string()


Location = tuple[int | str, ...]

VALUE_SHOWN_MAX = 60
"""Characters: a message names file and key before the value, in one line."""
KEY_ITSELF = "[key]"
"""The validator's last step where the name of a table is wrong, not its value."""
NAME_EXPECTED = "a name of letters, digits and _, a letter first"
DEFAULT_NOT_MADE = "default_factory_not_called"
"""A default that depends on another key, which has its own error."""


class BadInputs(BenchError):
    """Several bad values: all that were found."""

    exit_status = 2

    def __init__(self, errors: Sequence[BadInput]) -> None:
        super().__init__(*errors)
        self.errors = tuple(errors)

    def __str__(self) -> str:
        return "\n".join(str(error) for error in self.errors)


def bad_inputs_of(error: BenchError) -> list[BadInput]:
    """Return the single errors inside ``error``; empty if it is of another branch."""
    if isinstance(error, BadInputs):
        return list(error.errors)
    return [error] if isinstance(error, BadInput) else []


def raise_all(errors: Sequence[BadInput]) -> NoReturn:
    """Raise one error as itself, several as a group; ``errors``: not empty."""
    raise errors[0] if len(errors) == 1 else BadInputs(errors)


_DESCRIBED: Final = {
    "string_pattern_mismatch",
    "model_type",
    "model_attributes_type",
    "too_short",
    "too_long",
}
"""Errors for which the field's own description says more than the validator's."""


_NO_TABLE: Final = {"tuple_type", "dict_type", "model_type", "model_attributes_type"}


def translate(
    error: ValidationError, source: str, raw: Mapping[str, Any], model: type[BaseModel]
) -> list[BadInput]:
    """Return the faults of ``raw``, read from ``source``, as found by ``model``."""
    needed = _required(model) or set(model.model_fields)
    if other := other_kind(raw, needed):
        expected = f"a file with {', '.join(f'[{key}]' for key in sorted(needed))}"
        return [BadInput(source, "", f"a {other}", expected)]
    details = [
        item
        for item in error.errors(include_url=False)
        if item["type"] != DEFAULT_NOT_MADE and not _lacks_valid_items(item)
    ]
    errors = [_translate_one(detail, source, raw, model) for detail in details]
    meant = {key for item in errors if (key := _meant_key(item))}
    return [item for item in errors if not (item.value is MISSING and item.key in meant)]


_KINDS: Final = {
    "bench file": {"bench", "drive"},
    "motor file": {"motor", "mechanics", "rating"},
    "sweep": {"campaign"},
    "network file": {"network"},
}
"""Kind of file -> the tables that it holds, and no other kind all of them."""


def other_kind(raw: Mapping[str, Any], known: Collection[str] = ()) -> str:
    """Return the kind of file that ``raw`` is, if it holds no table of ``known``; else empty."""
    if set(raw) & set(known):
        return ""
    return next((kind for kind, tables in _KINDS.items() if tables <= set(raw)), "")


def _required(model: type[BaseModel]) -> set[str]:
    return {name for name, field in model.model_fields.items() if field.is_required()}


def _lacks_valid_items(detail: ErrorDetails) -> bool:
    """Return True if a list is called too short only because of invalid items, which are reported."""
    return detail["type"] == "too_short" and len(detail["input"]) >= detail["ctx"]["min_length"]


def _meant_key(item: BadInput) -> str | None:
    """Return the key that a misspelt one means: it is not reported as missing a second time."""
    if not isinstance(item, UnknownKey) or item.meant is None:
        return None
    parent, _, _ = item.key.rpartition(".")
    return f"{parent}.{item.meant}" if parent else item.meant


def shown(value: Any) -> Any:
    """Return ``value`` itself, or a short word for a table or list that is too long for a line."""
    if isinstance(value, Mapping):
        keys = f"{len(value)} keys" if len(value) != 1 else "one key"
        return f"a table of {keys}" if len(repr(value)) > VALUE_SHOWN_MAX else dict(value)
    if isinstance(value, list) and len(repr(value)) > VALUE_SHOWN_MAX:
        return f"a list of {len(value)}"
    return value


def _translate_one(
    detail: ErrorDetails, source: str, raw: Mapping[str, Any], model: type[BaseModel]
) -> BadInput:
    kind, location = detail["type"], detail["loc"]
    if location[-1] == KEY_ITSELF:
        return BadInput(source, dotted(location[:-2]), location[-2], NAME_EXPECTED)
    path = path_in_file(location, raw)
    key = dotted(path)
    if kind == "missing":
        return BadInput(source, key, MISSING, _described(path, raw, model) or "a value: the key is required")
    if kind == "extra_forbidden":
        known = sorted(fields_at(path[:-1], raw, model))
        elsewhere = tables_with(path[-1], model)
        if any(_is_of(path[:-1], heading) for heading in elsewhere):
            elsewhere = []  # this very table has it, where it is of another kind
        return unknown_key(source, key, shown(detail["input"]), known, elsewhere)
    if kind in {"union_tag_not_found", "union_tag_invalid"}:
        kinds = [repr(name) for item in models_at(path, raw, model) for name in _kinds(item)]
        given = detail["input"].get("kind", MISSING) if isinstance(detail["input"], Mapping) else MISSING
        return BadInput(source, f"{key}.kind", shown(given), f"one of {_listed(kinds)}")
    expected = _heading(path, raw, model, detail) if kind in _NO_TABLE else None
    expected = expected or (_described(path, raw, model) if kind in _DESCRIBED else None)
    return BadInput(source, key, shown(detail["input"]), expected or _expected(detail))


def found_and_expected(detail: ErrorDetails) -> str:
    """Return what is wrong with a value of the command line."""
    _, _, choices = detail["msg"].partition(" is not one of ")
    expected = f"one of {choices.removesuffix('.')}" if choices else _expected(detail)
    return f"found {detail['input']!r}, expected {expected}"


def _expected(detail: ErrorDetails) -> str:
    """Return the accepted values in the words of this project."""
    plain = {
        "int_type": "a whole number",
        "int_parsing": "a whole number",
        "float_parsing": "a number",
        "int_from_float": "a whole number",
        "float_type": "a number",
        "finite_number": "a finite number",
        "string_type": "text in quotes",
        "bool_type": "true or false",
        "tuple_type": "a list",
        "dict_type": "a table",
        "model_type": "a table",
        "model_attributes_type": "a table",
    }
    kind, context = detail["type"], detail.get("ctx", {})
    if kind in plain:
        return plain[kind]
    if kind in {"too_short", "too_long"}:
        least = kind == "too_short"
        return (
            f"a list of at {'least' if least else 'most'} {context['min_length' if least else 'max_length']}"
        )
    bounds = {"greater_than": ">", "greater_than_equal": ">=", "less_than": "<", "less_than_equal": "<="}
    limit_of = {"greater_than": "gt", "greater_than_equal": "ge", "less_than": "lt", "less_than_equal": "le"}
    if kind in bounds:
        return f"a value {bounds[kind]} {context[limit_of[kind]]}"
    if kind in {"literal_error", "enum"}:
        return f"one of {context['expected']}"
    return detail["msg"].removeprefix("Value error, ")


def path_in_file(location: Location, raw: Mapping[str, Any]) -> Location:
    """Return ``location`` without the validator's own steps (tags of unions), as a path of keys of the
    file."""
    path: list[int | str] = []
    node: Any = raw
    for index, step in enumerate(location):
        last = index == len(location) - 1
        if isinstance(step, str) and isinstance(node, Mapping) and step not in node and not last:
            continue
        path.append(step)
        node = _child(node, step)
    return tuple(path)


def _child(node: Any, step: int | str) -> Any:
    if isinstance(step, str):
        return node.get(step) if isinstance(node, Mapping) else None
    return node[step] if isinstance(node, list) and step < len(node) else None


def dotted(path: Location) -> str:
    """Convert ``("load", "axis1", 0, "at_s")`` to ``load.axis1[0].at_s``."""
    text = ""
    for step in path:
        if isinstance(step, int):
            text += f"[{step}]"
        else:
            text += f".{key_text(step)}" if text else key_text(step)
    return text


def _described(path: Location, raw: Mapping[str, Any], model: type[BaseModel]) -> str | None:
    """Return the description of the field at ``path``, for the user who fills it in."""
    name = path[-1]
    if not isinstance(name, str):
        return None
    fields = (item.model_fields.get(name) for item in models_at(path[:-1], raw, model))
    return next((field.description for field in fields if field and field.description), None)


def _heading(
    path: Location, raw: Mapping[str, Any], model: type[BaseModel], detail: ErrorDetails
) -> str | None:
    """Return how the tables at ``path`` are headed, where the table that holds them names each; else
    None."""
    if len(path) < 2 or not all(isinstance(step, str) for step in path):
        return None
    holders = [item.model_fields.get(str(path[-2])) for item in models_at(path[:-2], raw, model)]
    if not any(field and _names_tables(field.annotation) for field in holders):
        return None
    # What is no table is a key of one whose name was left out.
    name = dotted(path) if isinstance(detail["input"], Mapping) else f"{dotted(path[:-1])}.NAME"
    return f"tables, each headed [[{name}]]" if detail["type"] == "tuple_type" else f"a table headed [{name}]"


def _names_tables(annotation: Any) -> bool:
    return get_origin(annotation) is dict and bool(models_in(annotation))


def tables_with(name: int | str, model: type[BaseModel]) -> list[str]:
    """Return the headings of a file's tables with the key ``name``, the outermost first:
    ``drive.NAME.limits``."""
    found: list[str] = []
    waiting: list[tuple[str, type[BaseModel]]] = [("", model)]
    seen: set[type[BaseModel]] = set()
    for heading, table in waiting:
        if table in seen:
            continue
        seen.add(table)
        if name in table.model_fields and heading not in found:
            found.append(heading)
        for key, field in table.model_fields.items():
            inner = f"{heading}.{key}".removeprefix(".") + (".NAME" * _names_tables(field.annotation))
            waiting.extend((inner, each) for each in models_in(field.annotation))
    return found


def _is_of(path: Location, heading: str) -> bool:
    """Return True if ``heading`` is that of the table at ``path``."""
    steps, names = [step for step in path if isinstance(step, str)], heading.split(".") if heading else []
    return len(steps) == len(names) and all(
        name in (step, "NAME") for step, name in zip(steps, names, strict=True)
    )


def fields_at(path: Location, raw: Mapping[str, Any], model: type[BaseModel]) -> set[str]:
    """Return the keys that the table at ``path`` may hold."""
    return {name for item in models_at(path, raw, model) for name in item.model_fields}


def models_at(path: Location, raw: Mapping[str, Any], model: type[BaseModel]) -> Sequence[type[BaseModel]]:
    """Return the models that may describe the table at ``path``: several if the file leaves a union open."""
    candidates: Sequence[type[BaseModel]] = [model]
    node: Any = raw
    for step in path:
        node = _child(node, step)
        steps = [
            inner
            for candidate in candidates
            if isinstance(step, str) and step in candidate.model_fields
            for inner in models_in(candidate.model_fields[step].annotation)
        ]
        candidates = _of_kind(steps or candidates, node)
    return candidates


def _of_kind(candidates: Sequence[type[BaseModel]], node: Any) -> Sequence[type[BaseModel]]:
    """Return the models of a union whose ``kind`` is the one in the file."""
    if len(candidates) < 2 or not isinstance(node, Mapping):
        return candidates
    kind = node.get("kind")
    return [item for item in candidates if kind in _kinds(item)] or candidates


def _kinds(model: type[BaseModel]) -> tuple[Any, ...]:
    field = model.model_fields.get("kind")
    return getattr(field.annotation, "__args__", ()) if field else ()


def models_in(annotation: Any) -> list[type[BaseModel]]:
    """Return every model inside an annotation such as ``dict[str, tuple[A | B, ...]]``."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for part in getattr(annotation, "__args__", ()) for model in models_in(part)]


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names)


class Section(BaseModel):
    """A table of a file of the bench: immutable, without unknown keys, silent conversion or nan."""

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        strict=True,
        allow_inf_nan=False,
        arbitrary_types_allowed=True,
        defer_build=True,  # until a file is read: what a file holds is built with it, once
    )


F = TypeVar("F", bound=Section)


def load_file(model: type[F], path: Path, kind: str, named_by: NamedBy | None) -> F:
    """Load the file at ``path``; ``kind``: its kind, ``named_by``: its source. Raises BadInput or
    BadInputs."""
    return validated(model, read_toml(path, kind, named_by), str(path))


def validated(model: type[F], tables: Mapping[str, Any], source: str) -> F:
    """Validate the ``tables`` of the file ``source``. Raises BadInput or BadInputs."""
    try:
        return model.model_validate(tables)
    except ValidationError as error:
        raise_all(translate(error, source, tables, model))
