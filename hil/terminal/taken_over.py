"""The work of a parent (:mod:`servobench.hil.terminal.supervision`) in place of a failed command, and its
checks before it believes one."""

import json
import os
import select
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

from servobench.hil.machine.refusals import MachineRefused
from servobench.hil.machine.stopping import STOP_SIGNALS
from servobench.hil.rows.run_files import SUMMARY_FILE
from servobench.hil.verdict.summary import Summary, summary_without_run
from servobench.hil.verdict.verdict import ExitStatus, Finding, VerdictKind, outcome_of_status

Say = Callable[[str], None]
"""Takes a line for stderr."""
Known = Mapping[str, Any]
"""The command's reports: :func:`servobench.hil.machine.parent_process.tell_parent`."""
_LOGGER_S: Final = 120.0
"""The time for which a run waits for its logger."""


class Ended(NamedTuple):
    """How the process of a command ended."""

    returncode: int
    """Return code; -N for signal N."""
    by_parent: bool
    """True if it had closed its reporting pipe, and was killed."""

    @property
    def interrupted(self) -> bool:
        """True if its end was requested."""
        return -self.returncode in STOP_SIGNALS

    def __str__(self) -> str:
        if self.by_parent:
            return "became another program, or closed all its files"
        if self.returncode < 0:
            return f"was ended by {signal.Signals(-self.returncode).name}"
        return f"ended itself with status {self.returncode}"


def concluded(known: Known, result: Mapping[str, Any], arguments: Sequence[str], say: Say) -> tuple[int, str]:
    """Return exit status and stdout text of a command that reported its ``result``; stop drives that may not
    be at rest."""
    status, text = _believed(known, result, arguments, say)
    doubt = _damage(known, status, text, arguments)
    if doubt:
        say(f"hil: error: {doubt}")
        known = {**known, "released": False}
        status, text = ExitStatus.PEER_FAULT, ""
        if "--json" in arguments:
            text = _failed_object(doubt, status, arguments)
    for finding in () if known.get("released", True) else _stop_drives(known, say):
        say(f"hil: error: {finding.text}")
        if status != ExitStatus.DEFECT:
            status, text = ExitStatus.PEER_FAULT, _also(text, finding, arguments)
    return status, text


def _believed(known: Known, result: Mapping[str, Any], arguments: Sequence[str], say: Say) -> tuple[int, str]:
    """Return status and text that can be believed: a run has passed if its summary, read back, says so; other
    commands end with 0 if they reported so at their end."""
    told, text = known.get("concluded"), result["results"]
    # code of the user's may have put something in the place of sys.exit
    status = result["status"] if told is None else told["status"]
    if told is None and status == ExitStatus.PASSED:
        status, text, early = ExitStatus.INCOMPLETE, "", f"hil {arguments[0]} did not come to its end"
        say(f"hil: error: {early}")
        known = {**known, "error": early}
    if told is None or status != ExitStatus.PASSED:
        if text or "--json" not in arguments:
            return status, text
        return status, _failed_object(known.get("error", "see stderr"), status, arguments)
    doubt = _doubt(told) if arguments[0] == "run" else ""
    if not doubt:
        return status, text
    say(f"hil: error: {doubt}")
    return ExitStatus.NOT_RECORDED, _also(text, Finding(VerdictKind.NOT_RECORDED, doubt), arguments)


def _damage(known: Known, status: int, text: str, arguments: Sequence[str]) -> str:
    """Explain why a command's result may come from user code that replaced its functions; empty: no sign of
    that. A defect counts as one of the program only if its process has checked its own functions and found
    them unchanged."""
    if not known.get("own_code"):
        return ""
    ended = arguments[0] != "run" and "concluded" in known
    if status == ExitStatus.DEFECT and not known.get("intact") and not ended:
        return "your own code has run, and afterwards the process could not report what failed"
    if arguments[0] == "run" and "--json" in arguments and _status_in(text) != status:
        return "your own code has run, and afterwards the process reported an invalid result"
    return ""


def _status_in(text: str) -> int | None:
    try:
        status: int = json.loads(text)["verdict"]["exit_status"]
    except (ValueError, KeyError, TypeError):
        return None
    return status


def _also(text: str, finding: Finding, arguments: Sequence[str]) -> str:
    """Add a later finding to ``text`` for stdout."""
    if "--json" not in arguments:
        return text
    if arguments[0] != "run":
        return _failed_object(finding.text, finding.outcome.exit_status, arguments)
    from servobench.hil.verdict.plain_values import from_plain

    return _object(from_plain(Summary, json.loads(text)).also(finding))


def _doubt(told: Mapping[str, Any]) -> str:
    """Explain why a run that reports success has not passed; empty: it has. Its process has checked the seal
    (:func:`servobench.hil.terminal.run_object.read_back`), here only the summary is checked: nothing heavy is
    imported."""
    if not told["recording"]:
        return ""  # its figures and their digest never left its process
    path = Path(told["recording"]) / SUMMARY_FILE
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
        same = (stored["verdict"]["exit_status"], stored["digest"]) == (told["status"], told["digest"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        return f"{path} cannot be read back: {error}"
    return "" if same else f"{path} is not what was written into it"


def lost(known: Known, ended: Ended, arguments: Sequence[str], say: Say) -> tuple[int, str]:
    """Return exit status and stdout text of a command that ended without a result: stop its drives, and wait
    for its logger's recording."""
    text = f"the process of hil {arguments[0]} {ended}"
    say(f"hil: error: {text}")
    first = Finding(VerdictKind.INTERRUPTED if ended.interrupted else VerdictKind.CUT_SHORT, text)
    findings = [*_stop_drives(known, say), first]
    summary = _recorded(known)
    if summary is None:
        summary = summary_without_run(first.outcome, text)
        findings.remove(first)
        if folder := known.get("recording"):
            findings.append(Finding(VerdictKind.NOT_RECORDED, f"there is no summary: hil recover {folder}"))
    for finding in findings:
        summary = summary.also(finding)
    if advice := known.get("advice"):
        say(f"hil: note: {advice}")
    status = summary.verdict.exit_status
    if "--json" not in arguments:
        return status, ""
    return status, _object(summary) if arguments[0] == "run" else _failed_object(text, status, arguments)


def not_begun(refusal: MachineRefused, arguments: Sequence[str]) -> tuple[int, str]:
    """Return exit status and stdout text of a command for which the machine refuses a process."""
    if "--json" not in arguments:
        return refusal.exit_status, ""
    return refusal.exit_status, _failed_object(str(refusal), refusal.exit_status, arguments)


def _stop_drives(known: Known, say: Say) -> Iterator[Finding]:
    """Stop the drives as ``hil stop`` does; yield those not at rest afterwards."""
    if not known.get("nodes"):
        return
    from servobench.drivers.errors import BenchError
    from servobench.drivers.wire.adapters import parse_bus_spec
    from servobench.hil.execution.world import drive_network
    from servobench.hil.inspecting.stopping import stop_drives
    from servobench.hil.write_lists import STOP

    if parse_bus_spec(known["bus"], "--bus").simulated:
        say("hil: note: its drives were simulated in that process, and ended with it")
        return
    try:
        with drive_network(known["bus"], known["bitrate"], STOP) as network:
            stopped = stop_drives(network, known["nodes"])
    except BenchError as error:
        yield Finding(VerdictKind.PEER_FAULT, f"the drives are not known to be at rest: {error}")
        return
    for each in stopped:
        say(f"hil: node {each.node}: {each.text}")
        if not each.at_rest:
            yield Finding(VerdictKind.PEER_FAULT, f"node {each.node}: {each.text}")


def _recorded(known: Known) -> Summary | None:
    """Return the summary written by the logger, which outlives the loop."""
    if not known.get("recording"):
        return None
    from servobench.drivers.errors import BadInput
    from servobench.hil.recording.run_metadata import read_summary

    _await_end(known["logger"])
    try:
        return read_summary(Path(known["recording"]))
    except BadInput:
        return None


def _await_end(process: int) -> None:
    """Wait for the end of a process that is not a child of this one."""
    try:
        descriptor = os.pidfd_open(process)
    except ProcessLookupError:
        return
    try:
        select.select([descriptor], [], [], _LOGGER_S)
    finally:
        os.close(descriptor)


def _object(summary: Summary) -> str:
    return json.dumps(summary.as_json(), allow_nan=False) + "\n"


def _failed_object(text: str, status: int, arguments: Sequence[str]) -> str:
    """Return the object of a command without results: a run has its verdict, others their error."""
    if arguments[0] == "run":
        return _object(summary_without_run(outcome_of_status(status), text))
    return json.dumps({"error": text, "exit_status": status}) + "\n"
