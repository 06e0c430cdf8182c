"""``hil presets``: the drives and motors that come with the package, and where their figures are from."""

from collections.abc import Iterator, Mapping
from typing import Annotated, Any

import typer

from servobench.drivers.errors import BadInput
from servobench.hil.terminal.options import JsonOption
from servobench.hil.terminal.output import put


def presets(
    name: Annotated[
        str | None, typer.Argument(metavar="[NAME]", help="A name of the list; default: the list.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """List the presets of drives and motors, or the figures of one with document and place.

    Drives: --like of hil simulate, simulation.like of a bench. Motors: wherever a motor file is.

    Examples:
      hil presets
      hil presets epos4-50-5
    """
    from servobench.hil.configuration.preset_files import KINDS, preset_names, preset_origin, preset_tables

    kinds = {each: kind for kind in KINDS for each in preset_names(kind)}
    if name is None:
        listed = [
            {"preset": each, "kind": kind.removesuffix("s"), "title": preset_origin(kind, each).title}
            for each, kind in kinds.items()
        ]
        put({"presets": listed}, as_json, lambda _figures: _print(listed))
        return
    if name not in kinds:
        raise BadInput("NAME", "", name, f"a preset: {', '.join(kinds)}")
    origin = preset_origin(kinds[name], name)
    figures = [
        {
            "key": key,
            "value": value,
            "tolerance_percent": origin.tolerance_percent.get(key),
            "source": origin.sources.get(key, ""),
        }
        for key, value in _leaves(preset_tables(kinds[name], name), "")
    ]
    told = {"title": origin.title, "documents": origin.documents, "figures": figures}
    put(told, as_json, lambda _figures: _print_one(origin.title, origin.documents, figures))


def _leaves(table: Mapping[str, Any], before: str) -> Iterator[tuple[str, Any]]:
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{before}{key}.")
        else:
            yield before + key, value


def _print(listed: list[dict[str, str]]) -> None:
    for row in listed:
        typer.echo(f"{row['preset']:<26}{row['kind']:<7}{row['title']}")


def _print_one(title: str, documents: Mapping[str, str], figures: list[dict[str, Any]]) -> None:
    typer.echo(title)
    for short, document in documents.items():
        typer.echo(f"  {short}: {document}")
    for row in figures:
        off = row["tolerance_percent"]
        said = "" if off is None else f", +-{off:g} %"
        typer.echo(f"{row['key'] + ' = ' + str(row['value']) + said:<52}{row['source']}")
