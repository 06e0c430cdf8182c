"""What the README and the pages in docs/ tell a user to type does work, and names only what is there."""

import os
import re
import shutil
import signal
import subprocess
import sysconfig
import tempfile
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import typer

from servobench.hil.cli import app
from tests.draws import few_of
from tests.readme import INDENTED, Block, blocks, make_targets, script, shell_blocks, squeezed
from tests.stillness import Untrue
from tests.warm.start import folder

ROOT = Path(__file__).parents[2]
SCRIPTS = Path(sysconfig.get_path("scripts"))
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
STRANGER = os.environ.get("STRANGER")
"""Scripts of an environment with an installed wheel, from which hil is taken (``make stranger``)."""
FOLLOWED = [
    path for path in DOCUMENTS if any(block.runs for block in blocks(path.read_text(encoding="utf-8")))
]
"""The README, then the others: of those ``make stranger`` types all, ``make test`` none."""
TUTORIALS = {"tutorial-pytest.md", "tutorial-commissioning.md", "tutorial-review.md", "box-to-axis.md"}
REAL_TIME = {"tutorial-commissioning.md", "tutorial-pytest.md", "box-to-axis.md"}
"""They use a hub: not beside what else is measured in real time."""
TIMEOUT_S = 600 if STRANGER else 110
"""The stranger's wheel is interpreted, and each of its commands is a process of its own."""
MISUSE: type[Exception] = typer.BadParameter.__bases__[0]

SAMPLE = """
```sh
make demo   # seconds
cd x && hil run a.toml \\
    --json
```
<!-- runs -->
```sh
hil doctor
hil review "a b"   # not passed, status 1
```
<!-- file a.toml -->
```toml
[bench]
```
<!-- printed -->
```text
│ one   two │
...
```
"""


@pytest.fixture(scope="module")
def unviewed_recordings() -> None:
    """None: documents show what a recording has."""


def environment() -> dict[str, str]:
    """The user's environment with the tools of this venv first, but for ``hil``, which is forked."""
    if STRANGER:
        kept = {
            name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "VIRTUAL"))
        }
        return {**kept, "PATH": os.pathsep.join([STRANGER, os.environ["PATH"]]), "CI": "true"}
    places = [str(folder()), str(SCRIPTS), os.environ["PATH"]]
    return {**os.environ, "PATH": os.pathsep.join(places), "CI": "true"}


def name(path: Path) -> str:
    """Of a document."""
    return str(path.relative_to(ROOT))


def commands_of(path: Path) -> list[list[str]]:
    """All commands of a document."""
    return [
        command for block in shell_blocks(path.read_text(encoding="utf-8")) for command in block.commands()
    ]


def test_commands_are_found_in_a_document() -> None:
    first, second, file, printed = blocks(SAMPLE)
    assert [block.runs for block in (first, second, file, printed)] == [False, True, False, False]
    assert first.commands() == [["make", "demo"], ["cd", "x"], ["hil", "run", "a.toml", "--json"]]
    assert second.commands() == [["hil", "doctor"], ["hil", "review", "a b"]]
    assert file.file == "a.toml"
    assert printed.printed() == ["onetwo"]
    assert shell_blocks(SAMPLE) == [first, second]


@pytest.mark.parametrize(
    ("line", "status"),
    [
        ("true", 0),
        ("false", 1),
        ("false   # status 1", 0),
        ("true   # status 1", 1),
        ("(exit 3)   # stopped: status 3", 0),
        ("sleep 60 &", 0),
    ],
)
def test_a_command_is_held_to_its_status(line: str, status: int, tmp_path: Path) -> None:
    parts = [Block(f"{line}\n", "sh", "runs"), Block("one\n", "toml", "file x", "x")]
    parts += [Block("two\n", "toml", "append x", "x"), Block("grep -c . x\n", "sh", "runs")]
    done = subprocess.run(
        ["bash", "-c", script(parts)], cwd=tmp_path, env={**os.environ, "TYPED": "typed"},
        capture_output=True, text=True, timeout=20, check=False,
    )  # fmt: skip
    assert done.returncode == status, done
    told = (tmp_path / "typed").read_text("utf-8") if status == 0 else ""
    assert [each.partition(" s  ")[2] for each in told.splitlines()] == (
        [line.partition("   #")[0], "grep -c . x"] if status == 0 else []
    )
    assert ("2" in done.stdout.split()) == (status == 0)


def test_the_readme_and_the_tutorials_show_commands_that_are_run() -> None:
    assert {"README.md", *TUTORIALS} <= {path.name for path in FOLLOWED}


def test_every_target_and_file_named_is_there() -> None:
    targets = make_targets((ROOT / "Makefile").read_text(encoding="utf-8"))
    words = [command for path in DOCUMENTS for command in commands_of(path)]
    unknown = {
        target for command in words if command[0] == "make" for target in command[1:] if "=" not in target
    }
    assert unknown - targets == set()
    named = {word for command in words for word in command if re.match(r"(?:examples|docs|\.ci)/", word)}
    assert {file for file in named if not (ROOT / file).exists()} == set()


def test_every_command_is_one_that_the_program_takes(pytestconfig: pytest.Config) -> None:
    wrong = {}
    for command in (command for path in DOCUMENTS for command in commands_of(path)):
        try:
            if Path(command[0]).name == "hil":
                parse(command[1:])
            elif command[0] == "pytest":
                for word in command[1:]:
                    if word.startswith("--"):
                        pytestconfig.getoption(word.partition("=")[0])
        except (MISUSE, ValueError) as error:
            wrong[" ".join(command)] = getattr(error, "message", str(error))
    assert wrong == {}


@pytest.mark.parametrize(
    "line", ["hil no-such", "hil run", "hil run x.toml --bad", "hil export r --to xls", "hil design nothing"]
)
def test_a_command_that_the_program_refuses_is_seen(line: str) -> None:
    with pytest.raises(MISUSE):
        parse(line.split()[1:])


def test_no_command_escapes_for_want_of_a_fence() -> None:
    assert [path for path in DOCUMENTS if INDENTED.findall(path.read_text(encoding="utf-8"))] == []


@cache
def program() -> Any:
    """Return all commands of ``hil``, made once."""
    return typer.main.get_command(app)


def parse(words: list[str]) -> None:
    """Hold a command's words against the program; raises MISUSE. Nothing is run."""
    command: Any = program()
    context = None
    try:
        while hasattr(command, "resolve_command"):
            context = command.make_context("hil", list(words), parent=context)
            _, command, words = command.resolve_command(context, [*context._protected_args, *context.args])
        command.make_context(command.name, list(words), parent=context)
    except typer.Exit:  # --help, --version
        return


@pytest.fixture
def examples(tmp_path: Path) -> Path:
    """A folder with a copy of the examples, to work in."""
    if STRANGER:
        subprocess.run(
            [f"{STRANGER}/hil", "init", "--examples"], cwd=tmp_path, env=environment(), check=True, timeout=60
        )
        return tmp_path
    ignored = shutil.ignore_patterns("__pycache__", ".pytest_cache", "runs")
    shutil.copytree(ROOT / "examples", tmp_path / "examples", ignore=ignored)
    return tmp_path


def typed(commands: str, folder: Path, seconds: float = TIMEOUT_S) -> str:
    """Have bash run ``commands``, with a folder of its own for hubs; return what was printed."""
    with (
        tempfile.TemporaryDirectory(prefix="hub-") as place,  # a socket's path has to be short
        subprocess.Popen(
            ["bash", "-c", commands],
            cwd=folder,
            env={**environment(), "XDG_RUNTIME_DIR": place},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        ) as shell,
    ):
        try:
            printed, _ = shell.communicate(timeout=seconds)
        except subprocess.TimeoutExpired:
            os.killpg(shell.pid, signal.SIGKILL)  # what it has in the background too
            raise
    if "\nstatus 2, not 0: " in printed:  # bad input: of that no machine is to blame, however slow
        raise Untrue(printed)
    assert shell.returncode == 0, f"{commands}\n{printed}"
    assert "Exception ignored" not in printed, printed
    return printed


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, marks=[pytest.mark.xdist_group("real time")] if path.name in REAL_TIME else [])
        for path in (FOLLOWED if STRANGER else few_of(FOLLOWED, 1))
    ],
    ids=name,
)
def test_a_document_is_followed_word_by_word(path: Path, examples: Path) -> None:
    parts = blocks(path.read_text(encoding="utf-8"))
    printed = typed(script(parts), examples)
    said = {squeezed(line) for line in printed.splitlines()}
    missing = [
        line for block in parts if block.mark == "printed" for line in block.printed() if line not in said
    ]
    assert missing == [], f"{printed}\nnot said: {missing}"


NOT_RUN = (
    "a real drive",
    "a real bus",
    "a window",
    "a browser",
    "some minutes",
    "a plant of your own",
    "was killed",
    "Ctrl-C",
)
"""Ends of the comments behind examples of ``--help`` that need what a bare machine has not."""

WRITTEN_BY = ("--out", "--nameplate", "--export-eds", "--record", "new", "save")
"""Words in front of a file that an example writes."""
PANELS = [("Run", "Inspect", "Review"), ("Commission", "Design")]


def examples_of_help(command: Any, panels: tuple[str, ...]) -> list[str]:
    """What ``--help`` of the commands of these panels shows typed, in the order of ``hil --help``."""
    context = command.make_context("hil", ["--version"], resilient_parsing=True)
    lines = []
    for name in command.list_commands(context):
        if command.panel_of(name) in panels:
            inner = command.commands[name]
            for each in getattr(inner, "commands", {name: inner}).values():
                lines += re.findall(r"^ +(hil .*)$", each.help or "", re.MULTILINE)
    return [line for line in lines if not line.endswith(NOT_RUN)]


def first_of_help() -> list[str]:
    """Return the examples that those of every panel begin with: files, runs recorded, a drive to speak to."""
    lines = examples_of_help(program(), PANELS[0])
    shared = [line for line in lines if "--record runs/" in line or line.startswith("hil simulate ")]
    return ["hil init", "hil init --examples", *shared]


@pytest.mark.parametrize("panels", PANELS, ids=lambda panels: panels[0])
def test_what_help_shows_read_is_what_init_or_an_example_before_it_has_written(
    panels: tuple[str, ...],
) -> None:
    written = {path.name for path in (ROOT / "examples" / "first").iterdir()}
    missing = []
    for line in [*first_of_help(), *examples_of_help(program(), panels)]:
        words = line.partition(" #")[0].split()
        for before, word in pairwise(words):
            started = words[-1] == "&" and word.startswith("hub:")
            if started or before in WRITTEN_BY:
                written.add(word)
            elif word.startswith(("runs/", "hub:")) or (
                Path(word).suffix in (".toml", ".eds", ".dcf") and not word.startswith("examples/")
            ):
                missing += [line] if word not in written else []
    assert missing == []


@pytest.mark.skipif(STRANGER is None, reason="make stranger types them")
@pytest.mark.timeout(620)
@pytest.mark.parametrize("panels", PANELS, ids=lambda panels: panels[0])
@pytest.mark.xdist_group("real time")
def test_what_help_shows_typed_works_in_an_empty_folder(panels: tuple[str, ...], tmp_path: Path) -> None:
    first = first_of_help()
    lines = [*first, *(line for line in examples_of_help(program(), panels) if line not in first)]
    typed(script([Block("\n".join(lines) + "\n", "sh", "runs")]), tmp_path)


def test_what_hil_init_tells_to_type_works(tmp_path: Path) -> None:
    told = typed("hil init mybench", tmp_path)
    commands = re.findall(r"^  (\S.*?)   ", told, re.MULTILINE)
    assert [command.split()[0] for command in commands] == ["hil", "pytest", "hil"]
    typed(script([Block("\n".join(commands) + "\n", "sh", "runs")]), tmp_path / "mybench")


@pytest.mark.skipif(STRANGER is None, reason="an installed wheel is what make stranger makes")
def test_the_stranger_has_nothing_of_the_checkout(tmp_path: Path) -> None:
    where = "import servobench.hil.cli as cli, sys; print(cli.__file__, *sys.path)"
    done = subprocess.run(
        [f"{STRANGER}/python", "-c", where],
        cwd=tmp_path, env=environment(), capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert str(STRANGER).removesuffix("/bin") in done.stdout.split()[0]
    assert str(ROOT / "hil") not in done.stdout.split()[0]
    assert str(ROOT) not in done.stdout.split()[1:]
