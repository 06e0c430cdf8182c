"""What the README tells a user to type does work, and names only what is there."""

import os
import re
import subprocess
import sysconfig
from pathlib import Path

import pytest

from tests.readme import Block, blocks, make_targets

ROOT = Path(__file__).parents[2]
SCRIPTS = Path(sysconfig.get_path("scripts"))
BLOCKS = blocks((ROOT / "README.md").read_text(encoding="utf-8"))
TIMEOUT_S = 100
GROUPS = ("analyse", "design", "reproduce")
"""Commands that have commands."""

SAMPLE = """
```sh
make demo   # seconds
cd x && hil run a.toml \\
    --json
```
<!-- runs -->
```sh
hil doctor
```
```toml
[bench]
```
"""


def environment() -> dict[str, str]:
    """The user's environment with the tools of this venv first."""
    return {**os.environ, "PATH": f"{SCRIPTS}{os.pathsep}{os.environ['PATH']}", "CI": "true"}


def help_of(*command: str) -> str:
    """What ``hil COMMAND --help`` prints."""
    done = subprocess.run(
        [SCRIPTS / "hil", *command, "--help"],
        env={**environment(), "COLUMNS": "200", "NO_COLOR": "1"},
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        check=False,
    )
    assert done.returncode == 0, f"hil {' '.join(command)}: {done.stderr}"
    return done.stdout


def test_commands_are_found_in_a_document() -> None:
    first, second = blocks(SAMPLE)
    assert (first.runs, second.runs) == (False, True)
    assert first.commands() == [["make", "demo"], ["cd", "x"], ["hil", "run", "a.toml", "--json"]]
    assert second.commands() == [["hil", "doctor"]]


def test_the_readme_shows_commands_that_are_run() -> None:
    assert any(block.runs for block in BLOCKS)


def test_every_target_and_file_named_is_there() -> None:
    targets = make_targets((ROOT / "Makefile").read_text(encoding="utf-8"))
    words = [command for block in BLOCKS for command in block.commands()]

    unknown = {
        target for command in words if command[0] == "make" for target in command[1:] if "=" not in target
    }
    assert unknown - targets == set()
    files = {word for command in words for word in command if re.match(r"(?:examples|docs|\.ci)/", word)}
    assert {file for file in files if not (ROOT / file).exists()} == set()


def test_every_subcommand_and_option_named_is_there() -> None:
    used: dict[tuple[str, ...], set[str]] = {}
    for block in BLOCKS:
        for command in block.commands():
            if command[0].endswith("hil") and len(command) > 1 and not command[1].startswith("-"):
                named = 3 if command[1] in GROUPS else 2
                options = {word.partition("=")[0] for word in command[named:] if word.startswith("--")}
                used.setdefault(tuple(command[1:named]), set()).update(options)

    shown = {name: set(re.findall(r"--[a-z-]+", help_of(*name))) for name in used}
    assert {name: options - shown[name] for name, options in used.items() if options - shown[name]} == {}


@pytest.mark.parametrize(
    "block", [block for block in BLOCKS if block.runs], ids=lambda block: block.text.strip()
)
def test_a_block_marked_so_runs_as_printed(block: Block, tmp_path: Path) -> None:
    for name in ("examples", "docs", ".ci", "README.md"):
        (tmp_path / name).symlink_to(ROOT / name)
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", block.text],
        cwd=tmp_path,
        env=environment(),
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
