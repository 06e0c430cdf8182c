"""What the pages of a code host read of the repository: templates of issues, the citation, the version."""

import re
import tomllib
from pathlib import Path

import yaml
from setuptools.config.pyprojecttoml import read_configuration  # type: ignore[import-untyped]

ROOT = Path(__file__).parents[1]


def test_the_citation_has_version_and_licence_of_the_project() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert (str(citation["version"]), citation["license"]) == (project["version"], project["license"])
    assert citation["authors"]


def test_a_template_of_an_issue_has_a_name_and_fields_that_are_told_apart() -> None:
    forms = [
        yaml.safe_load(path.read_text(encoding="utf-8"))
        for path in sorted((ROOT / ".github/ISSUE_TEMPLATE").glob("*.yml"))
        if path.name != "config.yml"
    ]
    assert forms
    for form in forms:
        assert {"name", "description", "body"} <= form.keys()
        names = [field["id"] for field in form["body"]]
        assert len(names) == len(set(names))
        assert all(field["attributes"]["label"] for field in form["body"])


def test_what_security_and_releases_name_is_there() -> None:
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    for page in ("SECURITY.md", "CONTRIBUTING.md"):
        text = (ROOT / page).read_text(encoding="utf-8")
        links = re.findall(r"\]\(([^):#]+)", text)
        assert links
        assert [link for link in links if not (ROOT / link).exists()] == []
        asked = set(re.findall(r"`make ([a-z-]+)", text))
        assert [target for target in asked if not re.search(rf"^{target}:", makefile, re.MULTILINE)] == []


def test_a_folder_of_data_is_no_package() -> None:
    """For one without a module an editable install puts an entry into sys.path, for every program there."""
    project = read_configuration(ROOT / "pyproject.toml", expand=True)
    packages = project["tool"]["setuptools"]["packages"]
    assert "servobench.hil.configuration" in packages
    assert [name for name in packages if not (ROOT / name.replace(".", "/") / "__init__.py").exists()] == []
