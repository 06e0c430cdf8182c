"""What is wrong with what came of a sheet: unasked writes, contradictions between commands, false reasons.

No judgement asks the commands' own code: it rests on the frames, on the sheet's text, and on what the traits
of a made-up sheet changed in it.
"""

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Final

from tests.rehearsals.rehearsal import went_on
from tests.witness.allowed import MAKERS, Documented
from tests.witness.case import Case, Ended, mode_to_run
from tests.witness.frames import Access

Complaint = tuple[Ended, str]
"""A command, and what is wrong with how it ended."""
_NAMED: Final = re.compile(r"\b([0-9A-F]{4})h(?::([0-9A-F]{2}))?")
_ABSENT: Final = re.compile(
    r"(?:\bno (?:[a-z ]*[a-z] )?|\bwithout |\blacks )([0-9A-F]{4})h(?!:|\s*=| in a | beside )"
    r"|(?<!or )\b([0-9A-F]{4})h(?::00)?(?: [a-z ,]*)? (?:is|are) (?:missing|not in the dictionary)"
)
"""Statements that a drive has no such object."""
_AT_MOST: Final = re.compile(r"([0-9A-F]{4})h takes \d+ at most: hil commission refuses")
_ABORT: Final = re.compile(r"\b(0[568][0-9A-F]{6})h")
_SHOWN: Final = 5
"""Accesses of a command that are named."""
WORDS: Final[dict[int, str]] = {
    0x1000: r"profile|servo drive|device type",
    0x6040: r"controlword|axis|axes",
    0x6041: r"statusword",
    0x6060: r"\bmodes?\b",
    0x6061: r"\bmodes?\b",
    0x6502: r"\bmodes?\b|homing|inertia",  # without torques to command, the drive's ramps have to tell it
    0x60C5: r"inertia",
    0x6087: r"inertia",
    0x6071: r"torque",
    0x6076: r"torque",
    0x608F: r"position unit|counts",
    0x1600: r"RPDO",
    0x1A00: r"TPDO",
    0x1800: r"TPDO",
    0x1400: r"RPDO",
}
"""What a reason may say instead of an object's index, by CiA 301 and CiA 402-2."""


@dataclass
class Judged:
    """What is wrong with one case; all empty: nothing."""

    unasked: list[str] = field(default_factory=list)
    contradictions: list[str] = field(default_factory=list)
    false_reasons: list[str] = field(default_factory=list)
    unsafe: list[str] = field(default_factory=list)
    late: list[str] = field(default_factory=list)
    """How commands ended that the machine had no time for, by the frames: it says nothing of the drive."""
    motion: list[str] = field(default_factory=list)
    """What is wrong, and of motion alone: frames do not show all that a busy machine keeps from a host."""

    @property
    def is_to_be_tried_again(self) -> bool:
        """Nothing is wrong but motion, if that."""
        return bool(self.late or self.motion) and len(self.wrong) == len(self.motion)

    @property
    def wrong(self) -> list[str]:
        """All of it, in words."""
        return [*self.unasked, *self.contradictions, *self.false_reasons, *self.unsafe]

    def in_time(self, complaints: Iterable[Complaint]) -> Iterator[str]:
        """Complaints about commands that had the time they need; the others are kept as ``late``."""
        for ended, text in complaints:
            if ended.late:
                self.late.append(f"{text} ({ended.late})")
            else:
                self.motion.append(text)
                yield text


def judged(case: Case, changed: frozenset[int] | None, sound: bool, documented: Documented) -> Judged:
    """``changed``: objects that the sheet's traits touch; None: nobody knows what is odd in it.
    ``sound``: nothing in the sheet keeps a bench from commissioning the drive.
    """
    result = Judged(unsafe=[*case.changed, *case.left])
    result.unasked += _unasked(case, documented)
    result.false_reasons += _absences(case)
    result.false_reasons += _aborts(case)
    result.contradictions += result.in_time(_contradictions(case))
    result.false_reasons += result.in_time(_beside_the_sheet(case, changed, sound))
    return result


def _unasked(case: Case, documented: Documented) -> Iterator[str]:
    for command, accesses in case.accesses.items():
        wrong = {str(access) for access in accesses if not _is_asked(access, command, case, documented)}
        yield from (f"{command}: {text}" for text in sorted(wrong)[:_SHOWN])
    yield from (f"identifier {each:03X}h on the bus" for each in sorted(case.unexplained))


def _is_asked(access: Access, command: str, case: Case, documented: Documented) -> bool:
    """A commissioning reads all that the sheet has; a fixed RPDO may carry what the drive held before."""
    key = (access.index, access.sub)
    if not access.writes:
        listed = access.index in documented.maker_reads or (command == "commission" and key in case.variables)
        return access.index not in MAKERS or listed or key in case.carried
    if access.way == "rpdo" and case.held.get(key) == access.data:
        return True
    return key in documented.writes[command]


# ---- contradictions -------------------------------------------------------------------------------------


def _contradictions(case: Case) -> Iterator[Complaint]:
    eds, commission, run = case.eds, case.commission, case.run
    serves = eds.status == 0
    if eds.status not in (0, 1):
        yield eds, f"hil eds leaves with {eds.status}: {eds.reason}"
    if not commission.figures.get("steps"):
        yield (
            commission,
            f"hil commission leaves with {commission.status} and tells no steps: {commission.reason}",
        )
        return
    commissioned = not commission.figures.get("error")
    if serves and not commissioned and not _is_foreseen(eds, commission):
        yield commission, f"hil eds: it can serve a bench; hil commission: {commission.reason}"
    if not serves and commissioned:
        why = "; ".join(eds.figures["obstacles"])
        yield eds, f"hil eds: it cannot serve a bench ({why}); it was commissioned"
    if commissioned:
        yield from ((eds, text) for text in _other_modes(case))
    if run is None:
        return
    runs = run.status == 0 or went_on(run.figures)
    if commissioned and mode_to_run(eds) and not runs:
        dropouts = ", ".join(f"{count} {cause}" for cause, count in run.figures.get("dropouts", {}).items())
        told = f"; readings: {dropouts}" if dropouts else ""
        yield run, f"commissioned, hil run leaves with {run.status}: {run.reason}{told}"
    if runs and not mode_to_run(eds):
        yield eds, "hil eds gives no mode for hil run, and it ran"
    if not serves and runs:
        yield eds, "hil eds: it cannot serve a bench; hil run ran it"


def _is_foreseen(eds: Ended, commission: Ended) -> bool:
    """hil eds named the object that it was refused by: the nameplate decides whether its value is enough."""
    said = [match[1] for text in eds.figures.get("remarks", ()) if (match := _AT_MOST.match(text))]
    return any(f"{index}h" in commission.reason for index in said)


def _other_modes(case: Case) -> Iterator[str]:
    """The mode in which the shaft was turned, if it is none that hil eds gave for it."""
    given = {each["mode"] for each in case.eds.figures.get("usable_modes", ()) if each["commission"]}
    lines = [line for step in case.commission.figures["steps"] for line in step["lines"]]
    used = [match[1] for line in lines if (match := re.match(r"mode ([a-z ]+(?: \([a-z]+\))?);", line))]
    yield from (f"commissioned in {mode}, which hil eds does not give" for mode in used if mode not in given)


# ---- reasons --------------------------------------------------------------------------------------------


def _texts(case: Case) -> Iterator[str]:
    """All that the commands said about the drive."""
    yield from case.eds.figures.get("obstacles", ())
    yield from case.eds.figures.get("remarks", ())
    for ended in (*case.commissions, case.run):
        if ended is None:
            continue
        yield ended.reason
        for step in ended.figures.get("steps", ()):
            yield from (step["reason"], *step["lines"], *step["faults"])


def _absences(case: Case) -> Iterator[str]:
    there = {index for index, _ in case.variables}
    for text in sorted(set(_texts(case))):
        for match in _ABSENT.finditer(text):
            index = int(match[1] or match[2], 16)
            if index in there:
                yield f"{index:04X}h is in the sheet: {text!r}"


def _aborts(case: Case) -> Iterator[str]:
    seen = {access.abort for accesses in case.accesses.values() for access in accesses}
    for text in sorted(set(_texts(case))):
        for match in _ABORT.finditer(text):
            if int(match[1], 16) not in seen:
                yield f"no transfer was aborted with {match[1]}h: {text!r}"


def _beside_the_sheet(case: Case, changed: frozenset[int] | None, sound: bool) -> Iterator[Complaint]:
    """Reasons for what was not done that have nothing to do with what is odd in the sheet."""
    commission = case.commission
    error = commission.figures.get("error")
    if sound and error:
        yield commission, f"was to be commissioned, and ended: {error}"
    if changed is None:
        return
    told = [(case.eds, each) for each in case.eds.figures.get("obstacles", ())]
    told += [(commission, error)] if error else []
    for ended, each in told:
        if not _about(each, changed):
            yield ended, f"not what is odd in the sheet: {each!r}"
    steps = {step["name"]: step for step in commission.figures.get("steps", ())}
    for name, step in steps.items():
        if step["verdict"] == "done":
            continue
        if step["reason"] and not _about(step["reason"], changed) and not _rests(step["reason"], steps):
            text = f"step {name} {step['verdict']}, not by what is odd in the sheet: {step['reason']!r}"
            yield commission, text


def _rests(reason: str, steps: dict[str, dict[str, str]]) -> bool:
    match = re.fullmatch(r"it rests on ([a-z_ ,]+)", reason)
    return match is not None and any(
        steps.get(name, {}).get("verdict") != "done" for name in match[1].split(", ")
    )


def _about(text: str, changed: frozenset[int]) -> bool:
    named = {int(match[1], 16) for match in _NAMED.finditer(text)}
    bases = {index & ~0x1FF if 0x1400 <= index < 0x1C00 else index for index in changed}
    return bool(named & changed) or any(
        re.search(WORDS[index], text) for index in (changed | bases) & WORDS.keys()
    )
