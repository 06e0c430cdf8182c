"""``hil docs``: the documentation where only the package is installed."""

import re
from difflib import get_close_matches
from typing import Annotated

import typer

from servobench.drivers.errors import BadInput
from servobench.hil.machine.extras import docs_folder

_COMMENT = re.compile(r"^<!--.*?-->\n", re.MULTILINE | re.DOTALL)
"""What the tests of the documentation read."""


def docs(
    page: Annotated[
        str | None, typer.Argument(metavar="PAGE", help="A name of the list; default: the list.")
    ] = None,
) -> None:
    """Print a page of the documentation as Markdown, or list the pages.

    Examples:
      hil docs
      hil docs exit-status
    """
    folder = docs_folder()
    pages = {
        path.relative_to(folder).with_suffix("").as_posix(): path.read_text(encoding="utf-8")
        for path in sorted(folder.rglob("*.md"), key=lambda path: (len(path.relative_to(folder).parts), path))
    }
    if page is None:
        for name, text in pages.items():
            typer.echo(f"{name:<28}  {text.partition(chr(10))[0].lstrip('# ')}")
        typer.echo(f"\nAll of them lie in {folder}")
        return
    name = page.removeprefix("docs/").removesuffix(".md")
    if name not in pages:
        near = [each for each in pages if each.startswith(name)] or get_close_matches(
            name, pages, n=1, cutoff=0.7
        )
        remedy = f"is {' or '.join(near)} meant?" if near else ""
        raise BadInput("PAGE", "", page, "a page that hil docs lists", remedy)
    typer.echo(_COMMENT.sub("", pages[name]), nl=False)
