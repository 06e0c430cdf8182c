"""Files that a user names are there as a whole or as they were; devices and links stay what they are."""

import errno
import os
import stat
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from servobench.drivers.errors import BadInput
from servobench.drivers.written_file import DiskFull, write_file, written


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_file_is_replaced_with_its_mode_kept(tmp_path: Path) -> None:
    place = tmp_path / "out.toml"
    place.write_text("before")
    place.chmod(0o640)
    write_file("--out", place, "after")
    assert (place.read_text(), stat.S_IMODE(place.stat().st_mode)) == ("after", 0o640)
    assert names(tmp_path) == ["out.toml"]


def test_who_has_the_file_open_reads_on_what_was_there(tmp_path: Path) -> None:
    """At no moment is a part of the new content under its name."""
    place = tmp_path / "out.toml"
    place.write_text("before")
    with place.open(encoding="utf-8") as reader:
        write_file("--out", place, "after")
        assert reader.read() == "before"
    assert place.read_text() == "after"


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EDQUOT])
def test_what_fails_on_the_way_leaves_the_file_as_it_was(tmp_path: Path, number: int) -> None:
    place = tmp_path / "out.csv"
    place.write_text("before")

    def fail() -> None:
        with written("--out", place) as part:
            part.write_text("half of")
            raise OSError(number, os.strerror(number))

    with pytest.raises(DiskFull, match=f"--out: {place}: ") as caught:
        fail()
    assert (caught.value.exit_status, place.read_text(), names(tmp_path)) == (5, "before", ["out.csv"])


def test_a_writer_goes_by_the_ending(tmp_path: Path) -> None:
    with written("--out", tmp_path / "out.svg") as part:
        assert part.suffix == ".svg"
        part.touch()
    with written("--out", tmp_path / "out.bin", ".mf4") as part:
        assert part.suffix == ".mf4"
        part.touch()
    assert names(tmp_path) == ["out.bin", "out.svg"]


@pytest.mark.parametrize("there", [True, False])
def test_a_link_stays_one_and_leads_to_the_new_content(tmp_path: Path, there: bool) -> None:
    target, link = tmp_path / "target", tmp_path / "link"
    if there:
        target.write_text("before")
    link.symlink_to(target.name)
    write_file("--out", link, "after")
    assert link.is_symlink()
    assert target.read_text() == "after"


def test_a_fifo_gets_the_content(tmp_path: Path) -> None:
    place, read = tmp_path / "fifo", list[bytes]()
    os.mkfifo(place)
    reader = threading.Thread(target=lambda: read.append(place.read_bytes()))
    reader.start()
    write_file("--out", place, "content")
    reader.join()
    assert read == [b"content"]
    assert stat.S_ISFIFO(place.stat().st_mode)


def test_a_device_stays_one(tmp_path: Path) -> None:
    link = tmp_path / "link"
    link.symlink_to("/dev/null")
    for place in (Path("/dev/null"), link):
        write_file("--out", place, "content")
    assert stat.S_ISCHR(os.stat("/dev/null").st_mode)
    assert link.is_symlink()
    with pytest.raises(DiskFull):
        write_file("--out", Path("/dev/full"), "content")


@pytest.mark.parametrize("redirected", ["pipe", "file"])
def test_stdout_goes_where_the_shell_has_led_it(tmp_path: Path, redirected: str) -> None:
    code = (
        "import sys; from pathlib import Path; from servobench.drivers.written_file import write_file\n"
        "print('first', flush=True); write_file('--out', Path('/dev/stdout'), 'second\\n')"
    )
    with (tmp_path / "out").open("wb") as file:
        into = subprocess.PIPE if redirected == "pipe" else file
        done = subprocess.run([sys.executable, "-c", code], stdout=into, check=True)
    said = done.stdout if redirected == "pipe" else (tmp_path / "out").read_bytes()
    assert said == b"first\nsecond\n"


@pytest.mark.parametrize("name", ["", "none/out"])
def test_a_place_that_takes_no_file_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(BadInput, match=r"--out: found .*, expected a place to write to"):
        write_file("--out", tmp_path / name, "content")
    assert names(tmp_path) == []
