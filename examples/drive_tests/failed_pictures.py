"""Draw the recordings of the tests that failed, by a JUnit report: failed_pictures.py REPORT DIR."""

import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree  # of a report that this machine wrote itself


def failed_recordings(report: Path) -> list[Path]:
    """The folders of the runs of tests that failed or broke."""
    cases = ElementTree.parse(report).getroot().iter("testcase")
    failed = [case for case in cases if case.find("failure") is not None or case.find("error") is not None]
    return [
        Path(item.get("value", ""))
        for case in failed
        for item in case.iter("property")
        if item.get("name") == "recording"
    ]


def main(report: Path, pictures: Path) -> None:
    """Draw them."""
    pictures.mkdir(parents=True, exist_ok=True)
    for run in failed_recordings(report):
        picture = pictures / f"{run.parent.name}-{run.name}.png"
        subprocess.run(["hil", "picture", str(run), str(picture)], check=False)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
