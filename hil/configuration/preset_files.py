"""Presets: drives and motors by what their makers publish, one file each in ``presets`` beside this module.

A preset is a file of a drive or a motor with a table ``[preset]`` of its own: its ``title``, the
``documents`` by short names, and for each of its keys the document and the place in it in
``[preset.sources]``; ``assumed`` begins what no document says.
``[preset.tolerance_percent]``: how far a real one may be off. ``[preset.sheet]`` of a motor: the maker's
figures, by the options of ``hil motor new``.
"""

import re
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, Final, TypeVar

from pydantic import Field, field_validator, model_validator

from servobench.drivers.bounded_file import NamedBy, read_toml
from servobench.drivers.errors import BadInput
from servobench.hil.configuration.config_files import Section, load_file, validated

FOLDER: Final = Path(__file__).parent / "presets"
KINDS: Final = ("drives", "motors")
_NAME: Final = re.compile(r"[A-Za-z][A-Za-z0-9-]*")


class Origin(Section):
    """``[preset]``: where the figures of a preset come from."""

    title: str
    documents: dict[str, str]
    sources: dict[str, str]
    """By key, with dots: document and place, or "assumed" and why."""
    tolerance_percent: dict[str, float] = Field(default_factory=dict)
    sheet: dict[str, float] = Field(default_factory=dict)


def preset_names(kind: str) -> Sequence[str]:
    """All presets of ``kind``, one of :data:`KINDS`, by name."""
    return sorted(path.stem for path in (FOLDER / kind).glob("*.toml"))


@cache
def _read(kind: str, name: str) -> Mapping[str, Any]:
    return read_toml(FOLDER / kind / f"{name}.toml", "preset")


def preset_tables(kind: str, name: str) -> dict[str, Any]:
    """The tables of a preset; ``name``: one of :func:`preset_names`."""
    return {key: value for key, value in _read(kind, name).items() if key != "preset"}


def preset_origin(kind: str, name: str) -> Origin:
    """Where they come from."""
    return validated(Origin, _read(kind, name)["preset"], name)


def merged(below: Mapping[str, Any], above: Mapping[str, Any]) -> dict[str, Any]:
    """``above`` over ``below``, table by table."""
    tables = dict(below)
    for key, value in above.items():
        under = tables.get(key)
        tables[key] = (
            merged(under, value) if isinstance(under, Mapping) and isinstance(value, Mapping) else value
        )
    return tables


class FromPreset(Section):
    """A file, or a table, that may begin with a preset: its other keys replace the preset's."""

    KIND: ClassVar[str]

    preset: str | None = Field(default=None, description="name of a preset")
    """A preset to begin with: `hil presets` lists them."""

    @model_validator(mode="before")
    @classmethod
    def _begin(cls, tables: Any) -> Any:
        name = tables.get("preset") if isinstance(tables, Mapping) else None
        if not isinstance(name, str) or name not in preset_names(cls.KIND):
            return tables
        return merged(preset_tables(cls.KIND, name), tables)

    @field_validator("preset")
    @classmethod
    def _is_known(cls, name: str | None) -> str | None:
        names = preset_names(cls.KIND)
        if name is not None and name not in names:
            raise ValueError(f"one of {', '.join(names)}")
        return name


P = TypeVar("P", bound=FromPreset)


def could_name_a_preset(name: str) -> bool:
    """True for a word; a path has a slash or a dot."""
    return _NAME.fullmatch(name) is not None


def load_file_or_preset(model: type[P], path: Path, what: str, named_by: NamedBy | None) -> P:
    """Load the file at ``path``, or the preset that was named in its place.

    Raises BadInput or BadInputs; for a word that is neither, with the names of all presets.
    """
    named = NamedBy(str(path), "", str(path)) if named_by is None else named_by
    if not could_name_a_preset(named.text) or path.exists():
        return load_file(model, path, what, named_by)
    names = preset_names(model.KIND)
    if named.text not in names:
        near = get_close_matches(named.text, names, n=1)
        remedy = f"is {near[0]} meant?" if near else f"the path of a {what} has a dot or a slash"
        raise BadInput(named.source, named.key, named.text, f"a preset: {', '.join(names)}", remedy)
    return validated(model, {"preset": named.text}, named.text)
