"""What ``make docs`` does beside mkdocs: pages that are made, formulas, links out of docs/."""

import re
import runpy
from pathlib import Path
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[2]
API = """# Python

What `from servobench import ...` has. Everything else may change from one version to the next.

::: servobench
    options:
      show_root_heading: false
      show_root_toc_entry: false
      members_order: alphabetical
      show_source: false
"""
_drawn = runpy.run_path(str(ROOT / "docs/site/mathematics.py"))["drawn"]
_UPWARDS = re.compile(r"\[([^\]]+)\]\(((?:\.\./)+)(?!#)([^)]+)\)")
"""A link that leaves its folder: to another page, or to a file of the repository that is none."""
_CODE = re.compile(r"<code>[^<\n]*</code>")
_OPTION = re.compile(r"(?<![\w-])(--[\w-]+)")
_OF_README = re.compile(r"\]\((?:docs/([^)]+)|([^):#]+))\)")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are made."""
    pages = {
        path: made() for path, made in runpy.run_path(str(ROOT / "docs/site/reference.py"))["PAGES"].items()
    }
    pages["reference/python.md"] = API
    pages["index.md"] = _OF_README.sub(_readme_link, (ROOT / "README.md").read_text())
    pages["changelog.md"] = _OF_README.sub(_readme_link, (ROOT / "CHANGELOG.md").read_text())
    pages["contributing.md"] = _OF_README.sub(_readme_link, (ROOT / "CONTRIBUTING.md").read_text())
    for path, text in pages.items():
        files.append(File.generated(config, path, content=text))
    return files


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """Replace a link to what is no page by the name of the file."""
    depth = page.file.src_uri.count("/")

    def link(found: re.Match[str]) -> str:
        text, upwards, path = found.groups()
        return found[0] if upwards.count("/") <= depth else _file_link(text, path)

    return _UPWARDS.sub(link, markdown)


def on_page_content(html: str, page: Page, **_: Any) -> str:
    """Draw the formulas; options are broken nowhere, names of tables behind their points."""
    try:
        drawn = str(_drawn(html))
    except ValueError as error:
        raise PluginError(f"{page.file.src_path}: {error}") from error
    for entry in page.toc:
        for each in (entry, *entry.children):
            each.title = each.title.replace(".", ".<wbr>") if each.title.startswith("[") else each.title
    return _CODE.sub(lambda code: _OPTION.sub(r'<span class="option">\1</span>', code[0]), drawn)


def _readme_link(found: re.Match[str]) -> str:
    page, outside = found.groups()
    if page is not None:
        return f"]({page})"
    known = {"CHANGELOG.md": "changelog.md", "CONTRIBUTING.md": "contributing.md"}
    return f"]({known[outside]})" if outside in known else f"](../{outside})"


def _file_link(text: str, path: str) -> str:
    bare = text.strip("`")
    return f"`{path}`" if bare in path else f"{text} (`{path}`)"
