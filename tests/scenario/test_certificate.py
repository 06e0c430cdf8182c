"""The certificate of a commissioning: what it says is what was found, on paper too, and the files of the
folder are those that it was signed for."""

import hashlib
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from typer.testing import CliRunner

from servobench.hil.cli import app
from servobench.hil.commissioning.certificate import CertificateTable, FiledCertificate, together, told_figure
from servobench.hil.commissioning.certificate_pdf import pages_of


def commissioned(out: Path, *options: str) -> int:
    base = ["commission", "--bus", "simulated", "--node", "1", "--rehearse", "7", "--out", str(out), "--yes"]
    return CliRunner().invoke(app, [*base, *options]).exit_code


@pytest.fixture(scope="module")
def undrawn_certificates() -> None:
    """This one is drawn."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("certificate") / "lab"
    lab = out.parent / "lab.toml"
    lab.write_text('operator = "nobody"\nsite = "Hall 3 <west>"\norder = "4711"\n')
    assert commissioned(out, "--lab", str(lab), "--operator", "A. Muster") == 0
    return out


def read(folder: Path, name: str) -> Any:
    return json.loads((folder / name).read_text())


def rows(folder: Path, title: str) -> list[dict[str, str]]:
    tables: Mapping[str, list[dict[str, str]]] = read(folder, "certificate.json")["tables"]
    return next(table for name, table in tables.items() if name.startswith(title))


def test_who_where_and_when(folder: Path) -> None:
    subject = {row["item"]: row["value"] for row in rows(folder, "Commissioning")}
    assert (subject["operator"], subject["site"], subject["order"]) == ("A. Muster", "Hall 3 <west>", "4711")
    begun, ended = subject["begun, ended"].split(", ")
    assert begun == read(folder, "figures.json")["header"]["date"] <= ended
    assert "serial number (1018h:4) 1" in subject["drive"]


def test_each_object_in_decimal_before_and_after(folder: Path) -> None:
    """By the bytes of the report."""
    written = {each["object"]: each for each in read(folder, "figures.json")["written"]}
    objects = rows(folder, "Objects that were changed; now restored")
    assert [row["object"] for row in objects] == list(written)
    assert len(objects) > 10
    for row in objects:
        bytes_of = written[row["object"]]
        for column, data in (("before", bytes_of["before"]), ("set to", bytes_of["set"])):
            number = int.from_bytes(bytes.fromhex(data), "little")
            assert re.search(rf"(^|\()({number})( |\)|$)", row[column]), row
        assert row["left at"] == row["before"]
        assert row["name"]
    assert {"1000 us", "50 ms"} <= {row["set to"] for row in objects}
    assert "1.842 N m (500)" in {row["set to"] for row in objects}


def test_figures_their_uncertainty_and_what_is_open(folder: Path) -> None:
    found = {row["quantity"]: row for row in rows(folder, "Determined")}
    assert (found["inertia"]["value"], found["inertia"]["U (k = 2)"]) == ("0.00289", "0.00035")
    budget = {row["quantity"]: row for row in rows(folder, "Uncertainty budget")}
    assert budget["inertia"]["of the torque scale"].endswith("(12 %)")
    assert budget["inertia"]["of the fit"] == "5.1e-07"
    open_ = {row["what"] for row in rows(folder, "Not determined")}
    assert "Voltage constant against the DC link" in open_
    steps = {row["step"]: row["result"] for row in rows(folder, "Steps")}
    assert steps["Voltage constant against the DC link"] == "done, nothing determined"
    assert steps["Inertia and friction"] == "done"
    text = (folder / "certificate.html").read_text()
    assert not re.search(r"\d\.\d{8,}|\de\+0", text.split("<table>", 1)[1]), "no figure with eight digits"


def test_the_manifest_is_that_of_the_folder(folder: Path) -> None:
    listed = dict(line.split("  ")[::-1] for line in (folder / "manifest.sha256").read_text().splitlines())
    files = {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}
    own = {"manifest.sha256", "certificate.html", "certificate.pdf", "certificate.json"}
    written = (folder / "certificate.pdf").read_bytes()
    assert (written[:5], b"%%EOF" in written[-8:]) == (b"%PDF-", True)
    assert set(listed) == files - own
    assert {"drive.toml", "recording/frames.arrow", "journal.jsonl"} <= set(listed)
    for name, digest in listed.items():
        assert hashlib.sha256((folder / name).read_bytes()).hexdigest() == digest
    digest = hashlib.sha256((folder / "manifest.sha256").read_bytes()).hexdigest()
    assert read(folder, "certificate.json")["manifest_sha256"] == digest
    assert digest in (folder / "certificate.html").read_text()


def test_the_page_has_verdict_first_and_a_place_to_sign(folder: Path) -> None:
    text = (folder / "certificate.html").read_text()
    places = [text.index(words) for words in ("<h1>", ">PASSED<", "Hall 3 &lt;west&gt;", "signature")]
    assert places == sorted(places)


def test_a_dry_run_has_one_that_says_so(tmp_path: Path) -> None:
    commissioned(tmp_path / "dry", "--dry-run")
    filed = read(tmp_path / "dry", "certificate.json")
    assert filed["verdict"] == read(tmp_path / "dry", "figures.json")["verdict"]
    steps = {row["result"] for row in rows(tmp_path / "dry", "Steps")}
    assert "not done" in steps
    assert rows(tmp_path / "dry", "Objects that were changed") == []


@pytest.mark.parametrize(
    ("value", "uncertainty", "expected"),
    [
        (0.002887373504933056, 3.46e-4, ("0.00289", "0.00035")),
        (0.00028670199832211843, 3.44e-5, ("2.87e-4", "0.34e-4")),
        (1048575.0, 12.4, ("1048575", "12")),
        (1048575.0, 1240.0, ("1048600", "1200")),
        (0.0995, 0.0995, ("0.100", "0.100")),
        (1048576.0, None, ("1048576", "")),
        (1.000376, None, ("1.000", "")),
        (236.0, None, ("236", "")),
        (-3.14159, 0.02, ("-3.142", "0.020")),
    ],
)
def test_a_figure_has_as_many_digits_as_its_uncertainty_allows(
    value: float, uncertainty: float | None, expected: tuple[str, str]
) -> None:
    told = told_figure(value, uncertainty)
    assert told == expected or abs(float(told[0]) - value) <= (uncertainty or 0) / 20


def test_an_uncertainty_of_which_a_part_is_unknown_is_unknown() -> None:
    assert together({"value": 2.0, "uncertainty": 0.3}) == 0.3
    assert together({"value": 2.0, "uncertainty": 0.3, "scale_uncertainty": 0.2}) == pytest.approx(0.5)
    assert together({"value": 2.0, "uncertainty": 0.3, "scale_uncertainty": None}) is None
    assert together({"value": 2.0, "uncertainty": None, "scale_uncertainty": 0.2}) is None


def test_no_text_leaves_its_page_or_its_column() -> None:
    """The widest letters that a name may have, in every cell."""
    wide = "Maximum WWWW mounting moment of machine, MW " * 6
    long = tuple(
        CertificateTable(f"Table {n}", ("one", "two", "three"), [[wide, wide, "0.1234"]] * 9, (0.3, 0.5, 0.2))
        for n in range(4)
    )
    pages = pages_of(FiledCertificate("Certificate", "NOT PASSED: " + wide, False, long, "0" * 64))
    assert len(pages) > 2
    for page in pages:
        canvas: Any = FigureCanvasAgg(page)
        canvas.draw()
        width, height = canvas.get_width_height()
        for text in page.texts:
            box = text.get_window_extent(canvas.get_renderer())
            assert 0.05 * width < box.x0 < box.x1 < 0.95 * width, text.get_text()
            assert 0.02 * height < box.y0 < box.y1 < 0.96 * height, text.get_text()
