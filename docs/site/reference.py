"""The reference pages of the documentation, made from what they describe: models of files, the program.

``make docs`` puts them into the site. A key's words are its ``description`` or the docstring below it.
"""

import ast
import inspect
import re
import textwrap
import types
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import typer
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from servobench.hil.campaign.plan import CampaignPlan
from servobench.hil.campaign.store import schema_of
from servobench.hil.cli import app
from servobench.hil.configuration.config import BenchConfig
from servobench.hil.configuration.motor_file import MotorFile
from servobench.hil.loop.cycle_record import COLUMNS
from servobench.hil.rows.differences import DIFFERENCES
from servobench.hil.rows.records_file import PHASE_COLUMN
from servobench.hil.verdict.metrics import LIMITED
from servobench.virtual_bus.faults.register import TABLES

_ROOT = Path(__file__).resolve().parents[2]
_FILES = (
    "The tables `motor`, `commissioned`, `controller` and `current_control.controller` and the lists "
    "`faults.plan` and `background` may stand in files of their own: the key is then the path of the file, "
    "relative to the bench file. `[faults]` holds the tables of a [fault plan](faults.md), or `plan`, the "
    "path of one or of a run's `faults.arrow`."
)
_EXAMPLES = re.compile(r"^Examples:\n((?: +\S.*\n)+)", re.MULTILINE)
_BOUNDS = {"gt": ">", "ge": ">=", "lt": "<", "le": "<="}


def bench_page() -> str:
    """Every table and key of a bench file."""
    lines = ["# Bench file", "", _words(BenchConfig), "", _FILES, "", *_tables(BenchConfig, "", set())]
    return "\n".join(lines)


def motor_page() -> str:
    """Every key of a motor file."""
    return "\n".join(["# Motor file", "", *_tables(MotorFile, "", set())])


def faults_page() -> str:
    """Every kind of fault with its keys."""
    lines = ["# Fault plan", "", "Each table as often as wanted; all act at once.", ""]
    for name, table in TABLES.items():
        lines += [f"## [[{name}]]", "", _words(table), "", *_keys(table)]
    return "\n".join(lines)


def limits_page() -> str:
    """Every limit of a verdict, and the figure that it is held against."""
    lines = [
        "# Verdict limits",
        "",
        "Keys of `[verdict]` in a bench file, each an upper limit, each optional.",
    ]
    lines += ["What makes a run pass beside them: [verdict](../verdict.md).", ""]
    lines += ["| key | value | figure | meaning |", "|---|---|---|---|"]
    for name, limited in LIMITED.items():
        bounds = ", ".join(f"{_BOUNDS[bound]} {value}" for bound, value in limited.bounds.items())
        lines.append(f"| `{name}` | number {bounds} | {limited.heading} | {limited.meaning} |")
    return "\n".join([*lines, ""])


def columns_page() -> str:
    """Every column of a recording and of a campaign."""
    lines = ["# Columns", "", "## records.arrow", ""]
    lines += [
        "A row is a planned cycle of one axis; what is not known is null ([the recording](../recording.md)).",
        "",
    ]
    lines += ["| column | type | unit | |", "|---|---|---|---|"]
    for column in (*COLUMNS, PHASE_COLUMN):
        names = column.codes if column is PHASE_COLUMN else map(" ".join, _numbered(column.codes))
        meaning = ": ".join(part for part in (column.meaning, ", ".join(names)) if part)
        meaning += f"; in the file `{DIFFERENCES[column.name]}`" if column.name in DIFFERENCES else ""
        lines.append(f"| `{column.name}` | {column.kind} | {column.unit} | {meaning} |")
    plan = CampaignPlan.load(_ROOT / "examples/campaigns/ling2012.toml")
    lines += ["", "## runs of a campaign", ""]
    lines += [
        "A row is a run ([campaigns](../campaigns.md#the-table)). Each key that varies has a column as well.",
        "",
    ]
    lines += ["| column | type | unit | |", "|---|---|---|---|"]
    for field in schema_of(plan):
        if field.name not in plan.run(0).labels:
            told = {key.decode(): value.decode() for key, value in (field.metadata or {}).items()}
            lines.append(f"| `{field.name}` | {field.type} | {told.get('unit', '')} | {told['meaning']} |")
    return "\n".join([*lines, ""])


def _numbered(codes: tuple[str, ...]) -> Iterator[tuple[str, str]]:
    return ((str(number), code) for number, code in enumerate(codes))


def commands_page() -> str:
    """Every command with its arguments and options."""
    lines = ["# Commands", "", "`hil COMMAND --help` says the same.", ""]
    for words, command in _commands(typer.main.get_command(app), ("hil",)):
        text = re.sub(r"\\\[", "[", inspect.cleandoc(command.help or ""))
        text = _EXAMPLES.sub(lambda found: f"```sh\n{textwrap.dedent(found[1])}```\n", f"{text}\n")
        lines += [f"## {' '.join(words)}", "", text, ""]
        rows = [_parameter(item) for item in command.params if item.name != "help"]
        if rows:
            lines += ["| option | meaning |", "|---|---|", *rows, ""]
    return "\n".join(lines)


def _commands(command: Any, words: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    inner = getattr(command, "commands", None)
    if inner is None:
        yield words, command
        return
    for name in sorted(inner):
        yield from _commands(inner[name], (*words, name))


def _parameter(item: Any) -> str:
    names = ", ".join(f"`{name}`" for name in (*item.opts, *item.secondary_opts))
    if not item.opts or not item.opts[0].startswith("-"):
        names = f"`{item.metavar or item.name.upper()}`"
    elif item.metavar and not getattr(item, "is_flag", False):
        names += f" `{item.metavar}`"
    text = (getattr(item, "help", None) or "").replace("|", "\\|").replace("\\[", "[")
    default = item.default
    shown = isinstance(default, str | int | float) and not isinstance(default, bool)
    return f"| {names} | {text}{f' Default: `{default}`.' if shown else ''} |"


def _tables(model: type[BaseModel], place: str, seen: set[str]) -> Iterator[str]:
    """The tables below a model, each once, as the file writes them."""
    for name, field in model.model_fields.items():
        for inner, shape in _models(field.annotation):
            below = ".".join(part for part in (place, name, "NAME" if "dict" in shape else "") if part)
            kind = _kind(inner)
            title = (f"[[{below}]]" if "list" in shape else f"[{below}]") + (f" with {kind}" if kind else "")
            if title not in seen:
                seen.add(title)
                words = _words(inner)
                words = "" if words.strip("`[]") == below else words
                yield from (f"## {title}", "", words, "", *_keys(inner))
                yield from _tables(inner, below, seen)


def _kind(model: type[BaseModel]) -> str:
    field = model.model_fields.get("kind")
    if field is None or get_origin(field.annotation) is not Literal:
        return ""
    return f'kind = "{get_args(field.annotation)[0]}"'


def _models(
    annotation: Any, shape: tuple[str, ...] = ()
) -> Iterator[tuple[type[BaseModel], tuple[str, ...]]]:
    """Models within an annotation, and in which of ``list`` and ``dict`` they stand."""
    origin = get_origin(annotation)
    if inspect.isclass(annotation) and issubclass(annotation, BaseModel):
        yield annotation, shape
    elif origin in (tuple, list):
        for part in get_args(annotation):
            yield from _models(part, (*shape, "list"))
    elif origin is dict:
        yield from _models(get_args(annotation)[1], (*shape, "dict"))
    elif origin in (Annotated, Union, types.UnionType):
        for part in get_args(annotation)[:1] if origin is Annotated else get_args(annotation):
            yield from _models(part, shape)


def _keys(model: type[BaseModel]) -> Iterator[str]:
    rows = [
        f"| `{name}` | {_type(field)} | {_default(field)} | {_text(model, name, field)} |"
        for name, field in model.model_fields.items()
        if name != "kind" and not list(_models(field.annotation))
    ]
    if rows:
        yield from ("| key | value | default | meaning |", "|---|---|---|---|", *rows, "")


def _type(field: FieldInfo) -> str:
    annotation = field.annotation
    bounds = [f"{sign} {getattr(item, name)}" for item in _metadata(field) for name, sign in _BOUNDS.items()
              if getattr(item, name, None) is not None]  # fmt: skip
    return " ".join([_type_name(annotation), ", ".join(bounds)]).strip().replace("|", "\\|")


def _metadata(field: FieldInfo) -> Iterator[Any]:
    yield from field.metadata
    for part in get_args(field.annotation):
        if get_origin(part) is Annotated:
            for item in part.__metadata__:
                yield from item.metadata if isinstance(item, FieldInfo) else (item,)


def _type_name(annotation: Any) -> str:
    origin = get_origin(annotation)
    if origin is Literal:
        return " or ".join(f"`{value!r}`".replace("'", '"') for value in get_args(annotation))
    if origin is Annotated:
        return _type_name(get_args(annotation)[0])
    if origin in (tuple, list):
        inner = next((_type_name(part) for part in get_args(annotation) if part is not Ellipsis), "")
        return f"list of {inner}"
    if origin is dict:
        return "table"
    if origin in (Union, types.UnionType):
        return " or ".join(_type_name(part) for part in get_args(annotation) if part is not types.NoneType)
    return {"float": "number", "int": "integer", "str": "text", "bool": "true or false", "Path": "path"}.get(
        getattr(annotation, "__name__", ""), getattr(annotation, "__name__", "any")
    )


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "required"
    if field.default_factory is not None:
        return "from others"
    value = field.default
    if value is None or value == () or value == {}:
        return "none"
    return f"`{str(value).lower() if isinstance(value, bool) else value}`"


def _text(model: type[BaseModel], name: str, field: FieldInfo) -> str:
    words = next((texts[name] for texts in map(_docstrings, model.__mro__) if name in texts), "")
    text = words or field.description or ""
    return " ".join(_plain(text).split()).replace("|", "\\|")


@cache  # the source of a class is found by parsing its whole file
def _docstrings(model: type) -> dict[str, str]:
    """Attribute -> the string below it."""
    if not issubclass(model, BaseModel) or model is BaseModel:
        return {}
    body = ast.parse(textwrap.dedent(inspect.getsource(model))).body[0]
    assert isinstance(body, ast.ClassDef)
    found = {}
    for before, after in zip(body.body, body.body[1:], strict=False):
        if (
            isinstance(before, ast.AnnAssign)
            and isinstance(before.target, ast.Name)
            and isinstance(after, ast.Expr)
            and isinstance(after.value, ast.Constant)
        ):
            found[before.target.id] = str(after.value.value)
    return found


def _words(model: type[BaseModel]) -> str:
    return _plain(inspect.cleandoc(model.__doc__ or ""))


def _plain(text: str) -> str:
    """reStructuredText's marks of code as Markdown's."""
    text = re.sub(r":[a-z]+:`([^`]+)`", r"`\1`", text)
    return text.replace("``", "`")


PAGES = {
    "reference/bench.md": bench_page,
    "reference/motor.md": motor_page,
    "reference/faults.md": faults_page,
    "reference/commands.md": commands_page,
    "reference/verdict.md": limits_page,
    "reference/columns.md": columns_page,
}
