"""Options that name a file or folder that cannot be written, refused before anything else is done."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from servobench.drivers.errors import BadInput
from servobench.hil.cli import app
from servobench.hil.studies.drawing import draw_all


def refused(*arguments: str) -> str:
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 2, result.output
    return " ".join(result.stderr.split())


@pytest.mark.parametrize("option", ["--out", "--faults-out", "--picture"])
@pytest.mark.parametrize("name", ["none/file.png", "."])
def test_a_measurement_names_the_option_whose_file_cannot_be(tmp_path: Path, option: str, name: str) -> None:
    told = refused("measure", "--bus", "hub:nobody", "--node", "1", option, str(tmp_path / name))
    assert option in told
    assert "a file in an existing folder" in told


def test_a_picture_has_a_format_that_can_be_drawn(tmp_path: Path) -> None:
    for name in ("file.bmp", "file"):
        told = refused("measure", "--bus", "hub:nobody", "--node", "1", "--picture", str(tmp_path / name))
        assert "a file that ends in .png, .svg, .pdf" in told


@pytest.mark.parametrize("name", ["none/page.rrd", "page.txt"])
def test_a_comparison_names_a_page_that_cannot_be(tmp_path: Path, name: str) -> None:
    told = refused("compare", str(tmp_path), str(tmp_path), "--rrd", str(tmp_path / name))
    assert "a .rrd file in an existing folder" in told


def test_one_run_is_not_compared(tmp_path: Path) -> None:
    assert "a second run, or --baseline" in refused("compare", str(tmp_path))


def test_pictures_go_into_a_folder_that_is_made_and_not_into_a_file(tmp_path: Path) -> None:
    drawn: list[Path] = []
    files = {"one.png": drawn.append, "two.png": drawn.append}
    folder = tmp_path / "deep" / "folder"
    assert draw_all(folder, files) == drawn == [folder / "one.png", folder / "two.png"]
    assert draw_all(folder, {}) == [], "it may be there"
    (tmp_path / "file").touch()
    with pytest.raises(BadInput, match=r"--figures.*a folder"):
        draw_all(tmp_path / "file", files)
