"""The documentation as a site: what `make docs` builds, read back from its HTML."""

import os
import re
import runpy
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import pytest

pytestmark = [pytest.mark.long, pytest.mark.timeout(400)]

ROOT = Path(__file__).parents[2]
CODE = re.compile(r"^( *)(```|~~~).*?^\1\2|^ {4,}(?!\$).*?$|`[^`\n]*`", re.DOTALL | re.MULTILINE)
FORMULA = re.compile(r"\$\$(.+?)\$\$|\$(?! )([^$\n]+?)\$", re.DOTALL)


KINDS = ["Tutorials", "How-to guides", "Reference", "Explanation"]
TABS = re.compile(r'<li class="md-tabs__item( md-tabs__item--active)?">\s*<a [^>]*>(.*?)</a>', re.DOTALL)


class Page(HTMLParser):
    """Formulas, texts beside code, and what a browser would fetch from elsewhere."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.formulas = 0
        self.text = ""
        self.fetched: list[str] = []
        self._inside: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.formulas += tag == "math"
        places = dict(attrs)
        source = places.get("src") or (places.get("href") if tag == "link" else None) or ""
        if source.startswith(("http:", "https:", "//")) and places.get("rel") != "canonical":
            self.fetched.append(source)
        if tag in ("pre", "code", "math", "script", "style"):
            self._inside.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if self._inside and self._inside[-1] == tag:
            self._inside.pop()

    def handle_data(self, data: str) -> None:
        if not self._inside:
            self.text += data


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built site."""
    out = tmp_path_factory.mktemp("site")
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--quiet", "--site-dir", str(out)],
        cwd=ROOT, env={**os.environ, "NO_MKDOCS_2_WARNING": "1", "PYTHONPATH": str(ROOT)},
        capture_output=True, text=True, timeout=380, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return out


def built(site: Path, path: Path) -> Page:
    """The page that was made of a Markdown file in docs/."""
    inside = path.relative_to(ROOT / "docs")
    place = site / inside.parent if inside.stem == "README" else site / inside.with_suffix("")
    return Page((place / "index.html").read_text(encoding="utf-8"))


def test_every_formula_is_drawn(site: Path) -> None:
    written, drawn, left = {}, {}, {}
    for path in sorted((ROOT / "docs").rglob("*.md")):
        text = CODE.sub("", path.read_text(encoding="utf-8"))
        page = built(site, path)
        written[path.name] = len(FORMULA.findall(text))
        drawn[path.name] = page.formulas
        left[path.name] = re.findall(r"\$[^$\n]*\\[^$\n]*\$|\\\(|\\\[", page.text)
    assert sum(written.values()) > 50
    assert drawn == written
    assert {name: found for name, found in left.items() if found} == {}


def test_a_page_fetches_nothing_from_elsewhere(site: Path) -> None:
    fetched = {
        str(path.relative_to(site)): found
        for path in site.rglob("*.html")
        if (found := Page(path.read_text(encoding="utf-8")).fetched)
    }
    assert fetched == {}


def test_every_page_is_of_one_of_four_kinds(site: Path) -> None:
    kinds: dict[str, list[str]] = {}
    for path in site.rglob("index.html"):
        tabs = [(bool(active), name.strip()) for active, name in TABS.findall(path.read_text("utf-8"))]
        assert [name for _, name in tabs] == ["servobench", *KINDS]
        kinds[str(path.parent.relative_to(site))] = [name for active, name in tabs if active]
    assert kinds.pop(".") == ["servobench"]
    decisions = {page: kinds.pop(page) for page in list(kinds) if page.startswith("decisions/0")}
    assert decisions["decisions/0019-no-pi-with-observer"] == [], "their list leads to them, no menu does"
    assert {page: kind for page, kind in kinds.items() if len(kind) != 1 or kind[0] not in KINDS} == {}
    assert kinds["tutorial-pytest"] == ["Tutorials"]
    assert {kind for page, (kind,) in kinds.items() if page.startswith("reference/")} == {"Reference"}


def test_a_page_in_a_folder_links_to_one_above(site: Path) -> None:
    page = (site / "reference/columns/index.html").read_text(encoding="utf-8")
    assert '<a href="../../recording/">the recording</a>' in page


def test_a_formula_with_an_unknown_command_is_refused() -> None:
    drawn = runpy.run_path(str(ROOT / "docs/site/mathematics.py"))["drawn"]
    made = drawn(r'<p><span class="arithmatex">\(\hat T &lt; 1\)</span></p>')
    assert made.startswith("<p><math ")
    assert "&lt;" in made or "&#x0003C;" in made
    with pytest.raises(ValueError, match=r"latex2mathml"):
        drawn(r'<div class="arithmatex">\[\nosuchcommand x\]</div>')
