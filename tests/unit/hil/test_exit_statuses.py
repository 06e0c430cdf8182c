"""Which error ends a command with which status: docs/exit-status.md says what each means."""

import importlib
import pkgutil
import re
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import servobench.drivers
import servobench.hil
from servobench.drivers.errors import BenchError
from servobench.hil.verdict.verdict import ExitStatus, VerdictKind

STATUSES = {
    ExitStatus.FAILED: {"Abandoned"},
    ExitStatus.BAD_INPUT: {
        "BadInput", "BadInputs", "DesignRefused", "ImpossiblePlate", "MissingExtra", "NoSuchFile",
        "RunRefused", "UnknownKey", "UnlistedWrite", "WeightRefused",
    },
    ExitStatus.PEER_FAULT: {
        "AnswersTwice", "BusDown", "ClusterLost", "DriveInFault", "EmergencyStopped", "ForeignTraffic",
        "HostStoodStill", "LimitExceeded", "ModeRefused", "NoAnswer", "NotObservable", "OwnCodeFailed",
        "OwnCodeRaised", "PeerFault", "PlanImpossible", "PowerLost", "RampTooSlow", "ReadingsLost",
        "SettingRefused", "StepFailed", "TransferAborted", "UnitNotTold", "WrongSetPoint",
    },
    ExitStatus.NOT_RECORDED: {"DiskFull", "RecordingFailed"},
    ExitStatus.INCOMPLETE: {"MachineRefused", "NothingCertified", "WorkerDied"},
    ExitStatus.COUNTER_EXAMPLE: {"CounterExample"},
    ExitStatus.DEFECT: {"NotTheSame"},
    ExitStatus.INTERRUPTED: {"Interrupted"},
}  # fmt: skip


def below(kind: type[BenchError]) -> Iterator[type[BenchError]]:
    for each in kind.__subclasses__():
        yield each
        yield from below(each)


def test_every_error_ends_a_command_with_the_status_of_its_kind() -> None:
    for room in (servobench.drivers, servobench.hil):
        for module in pkgutil.walk_packages(room.__path__, f"{room.__name__}."):
            importlib.import_module(module.name)
    told = defaultdict(set)
    for error in below(BenchError):
        if error.__module__.startswith("servobench."):
            told[error.exit_status].add(error.__name__)
    assert told == {int(status): names for status, names in STATUSES.items()}


def test_statuses_are_those_of_the_documents() -> None:
    assert [int(status) for status in ExitStatus] == [0, 1, 2, 3, 4, 5, 6, 7, 70, 130]


def test_the_page_of_statuses_is_that_of_the_code() -> None:
    """A line for each outcome that a run may have, with its status; every status has a line."""
    page = (Path(__file__).parents[3] / "docs/exit-status.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (\d+) \| (?:`([^`]+)`)? ?\|", page, re.MULTILINE)
    outcomes = {(str(int(kind.exit_status)), str(kind)) for kind in VerdictKind}
    of_a_finding = (str(int(VerdictKind.DISTURBED.exit_status)), str(VerdictKind.DISTURBED))
    assert {row for row in rows if row[1]} == outcomes - {of_a_finding}
    assert {status for status, _ in rows} == {str(int(status)) for status in ExitStatus}
