"""Steps that only listen and read: bus, identity, dictionary (with a data sheet or without one), units."""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import ClassVar, Final

import numpy as np
from canopen.objectdictionary import ObjectDictionary, ODVariable

from servobench.drivers.canopen.network import CanopenNetwork
from servobench.drivers.canopen.objects301 import Cia301, DataType
from servobench.drivers.cia402.drive_setup import read_scaling
from servobench.drivers.cia402.judgement import judge, told_by_drive
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import Mode
from servobench.drivers.cia402.scaling import ScaleOverride, Scaling, UnitNotTold
from servobench.drivers.errors import TransferAborted
from servobench.drivers.rotation import RAD_S_PER_RPM
from servobench.drivers.sheets.dictionary import told_identity, variables_in
from servobench.hil.commissioning.drive_port import QUANTITY_OF_MODE
from servobench.hil.commissioning.findings import StepFailed, StepOutcome
from servobench.hil.commissioning.nameplate import (
    compare_ratings,
    doubt_plate,
    keeps_motor,
    read_motor,
    settle_winding,
)
from servobench.hil.commissioning.request import motion_limits
from servobench.hil.commissioning.sequence import Step
from servobench.hil.commissioning.session import Session
from servobench.hil.restoring.journal import Journal
from servobench.hil.restoring.restore import head_of

Dump = dict[tuple[int, int], bytes]

_COMMUNICATION: Final = (
    *range(0x1000, 0x101A),
    0x1029,
    0x1200,
    *(first + number for first in (0x1400, 0x1600, 0x1800, 0x1A00) for number in range(8)),
)
_RECORDS: Final = (
    0x1003,
    0x1010,
    0x1011,
    0x1014,
    0x1016,
    0x1018,
    0x1029,
    0x1200,
    *range(0x1400, 0x1B00),
    Object.POSITION_RANGE_LIMIT,
    Object.SOFTWARE_POSITION_LIMIT,
    0x608F,
    *range(0x6090, 0x6098),
    0x6099,
    Object.PROFILE_JERK,
    Object.INTERPOLATION_TIME_PERIOD,
    Object.TOUCH_PROBE_SOURCE,
    Object.SUPPORTED_HOMING_METHODS,
    Object.ADDITIONAL_POSITION,
)
_PROFILE: Final = (
    *(
        int(entry) for entry in Object if entry is not Object.COMMUTATION_ANGLE
    ),  # no setting, and seldom there
    0x6403,
    0x6404,
)
_WRITE_ONLY: Final = "wo"


def dump(
    network: CanopenNetwork, node: int, dictionary: ObjectDictionary | None, idle: Callable[[], None]
) -> Dump:
    """Read the bytes of every readable object; ``idle`` is called in between and may raise.

    Without a data sheet: the objects of CiA 301 and CiA 402 that drives have.
    """
    held: Dump = {}
    listed = ((each.index, each.subindex) for each in _readable(dictionary)) if dictionary else None
    for number, (index, sub) in enumerate(listed or _usual(network, node)):
        with suppress(TransferAborted):
            held[index, sub] = network.upload(node, index, sub)
        if number % 16 == 0:
            idle()
    return held


def _readable(dictionary: ObjectDictionary) -> Iterator[ODVariable]:
    for variable in variables_in(dictionary):
        if variable.access_type != _WRITE_ONLY and variable.data_type != DataType.DOMAIN:
            yield variable


def _usual(network: CanopenNetwork, node: int) -> Iterator[tuple[int, int]]:
    for index in sorted({*_COMMUNICATION, *_PROFILE}):
        yield index, 0
        if index not in _RECORDS:
            continue
        try:
            count = network.upload(node, index, 0)
        except TransferAborted:
            continue
        for sub in range(1, min(count[0] if count else 0, 64) + 1):
            yield index, sub


def differing(held_objects: Dump, dictionary: ObjectDictionary) -> list[str]:
    """List settings that differ from the data sheet's defaults, in words."""
    lines = []
    for variable in variables_in(dictionary):
        held = held_objects.get((variable.index, variable.subindex))
        default = variable.default
        if held is None or not isinstance(default, int) or variable.access_type in ("ro", "const"):
            continue
        if not variable.writable or len(held) > 8 or not held:
            continue
        mask = (1 << 8 * len(held)) - 1
        if int.from_bytes(held, "little") != default & mask:
            value = int.from_bytes(held, "little", signed=default < 0)
            lines.append(
                f"{variable.index:04X}h:{variable.subindex:02X} {variable.name}: {value}, default {default}"
            )
    return lines


def missing(held: Dump, dictionary: ObjectDictionary) -> list[str]:
    """List objects of the data sheet that could not be read from the drive."""
    return [
        f"{variable.index:04X}h:{variable.subindex:02X} {variable.name}"
        for variable in _readable(dictionary)
        if (variable.index, variable.subindex) not in held
    ]


CONNECT_LIMIT_S = 5.0
"""A drive that was just switched on boots in a second or two."""
LISTEN_S = 0.5
ROUND_TRIPS = 20
"""Their median does not move if the host is busy for a moment."""
_SHOWN = 40
"""Number of differing settings shown; parameters.txt holds them all."""
_REMEDIES = {
    "torque": "6076h tells none: give rating.torque_nm in the nameplate (--motor)",
    "position": "608Fh, 6092h and 60A8h tell none: give encoder.counts_per_revolution, the position units in "
    "one turn, in the nameplate (--motor)",
    "velocity": "60A9h, and 6096h with the position unit, tell none: this drive cannot be commissioned",
    "acceleration": "60AAh, and 6097h with the position unit, tell none: this drive cannot be commissioned",
}
_OVERRIDES = {
    "torque": "rated_torque_nm",
    "position": "position_rad",
    "velocity": "velocity_rad_s",
    "acceleration": "acceleration_rad_s2",
}
"""Field of an override that gives the unit."""
_UNKNOWN = 1e-3
"""Replaces an unknown unit, to find what else is missing."""
_COARSEST_RAD = 1.01 * math.tau / 6.0
"""Hall sensors of one pole pair: a coarser position unit is an unset resolution."""


class BusCheck(Step):
    """Listens to the bus, and times the node's answers."""

    name = "bus"
    title = "Adapter and bus"
    limit = "there are error frames, or the node does not answer"
    essential = True

    def plan(self, session: Session, /) -> str:
        return (
            f"listen for {LISTEN_S:g} s, then ask node {session.request.node} {ROUND_TRIPS} times for 1000h"
        )

    def run(self, session: Session, outcome: StepOutcome) -> None:
        network = session.network
        began = session.clock_now
        before = network.link.received_frames
        session.wait(LISTEN_S)
        heard = network.link.received_frames - before
        load = session.world.load_percent(began, session.clock_now)
        session.drive.connect(session.deadline(CONNECT_LIMIT_S))
        trips_us = []
        for _ in range(ROUND_TRIPS):
            asked_at = session.clock_now
            network.upload(session.request.node, Cia301.DEVICE_TYPE)
            trips_us.append((session.clock_now - asked_at) / 1e3)
        errors = session.world.error_frames()
        frames = f"{heard} frame{'' if heard == 1 else 's'}"
        outcome.say(f"{frames} in {LISTEN_S:g} s, bus load {load:.1f} %, {errors} error frames")
        outcome.say(f"answers after {np.median(trips_us):.0f} us, at most {max(trips_us):.0f} us")
        outcome.figures = {"frames": heard, "error_frames": errors, "sdo_us": float(np.median(trips_us))}
        if errors:
            raise StepFailed(f"{errors} error frames on the bus", "", "check bit rate, termination and cable")


class IdentityCheck(Step):
    """Identifies the drive, and checks that the data sheet belongs to it."""

    name = "identity"
    title = "Identity against the data sheet"
    limit = "the data sheet is of another device"
    needs = ("bus",)
    essential = True

    def plan(self, session: Session, /) -> str:
        sheet = session.request.eds
        return "read 1000h, 1008h and 1018h" + (
            f", and compare with {sheet.name}" if sheet else "; no data sheet"
        )

    def run(self, session: Session, outcome: StepOutcome) -> None:
        identity = session.drive.connect(session.deadline(CONNECT_LIMIT_S))
        session.found.identity = identity
        versions = {"hardware (1009h)": Cia301.HARDWARE_VERSION, "firmware (100Ah)": Cia301.SOFTWARE_VERSION}
        told = {name: session.objects.read_text(index) for name, index in versions.items()}
        session.found.versions = {name: text for name, text in told.items() if text}
        outcome.say(str(identity))
        outcome.figures = identity._asdict() | {"versions": session.found.versions}
        dictionary = session.dictionary
        if dictionary is not None:
            sheet = told_identity(dictionary)
            for part, of_sheet, of_drive in sheet.strangers(
                identity.vendor, identity.product, identity.revision
            ):
                if part != "revision":
                    raise StepFailed(
                        f"the data sheet is of another device: {part} {of_sheet:08X}h",
                        f"the drive says {of_drive:08X}h",
                        "give the data sheet of this drive, or none",
                    )
                outcome.say(f"revision {of_drive:08X}h, the data sheet is for {of_sheet:08X}h")
        if not session.request.dry_run:
            head = head_of(session.objects, session.request.bus, session.request.bitrate_bit_s, identity)
            session.network.begin_journal(Journal(session.request.journal, head))


class DumpStep(Step):
    """Reads everything, and lists differences from the factory settings."""

    name = "dump"
    title = "All parameters"
    needs = ("identity",)

    def plan(self, session: Session, /) -> str:
        if session.dictionary is None:
            return "read the objects of CiA 301 and CiA 402 into parameters.txt"
        return "read every object of the data sheet into parameters.txt, and compare with its defaults"

    def run(self, session: Session, outcome: StepOutcome) -> None:
        objects = dump(session.network, session.request.node, session.dictionary, session.check_stop)
        session.found.dump = objects
        lines = [f"{index:04X}h:{sub:02X} {value.hex()}" for (index, sub), value in sorted(objects.items())]
        (session.request.out / "parameters.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
        outcome.say(f"{len(objects)} objects read into parameters.txt")
        outcome.figures = {"objects": len(objects)}
        if session.dictionary is not None:
            others = differing(objects, session.dictionary)
            outcome.say(f"{len(others)} settings differ from the data sheet's defaults")
            outcome.lines += [f"- {line}" for line in others[:_SHOWN]]
            gone = missing(objects, session.dictionary)
            if gone:
                outcome.say(f"{len(gone)} objects of the data sheet cannot be read: {', '.join(gone[:5])}")
            outcome.figures |= {"differing": len(others), "missing": len(gone)}


class UnitsTold(Step):
    """Reads the drive's own units, and compares them with the nameplate."""

    name = "units"
    title = "Units as told"
    limit = "a unit or a usable mode is not told, or nameplate and drive contradict each other by far"
    needs = ("identity",)
    essential = True
    modes: ClassVar[tuple[Mode, ...]] = tuple(QUANTITY_OF_MODE)
    """Modes of which the drive has to have one."""

    def plan(self, session: Session, /) -> str:
        motor = ", the motor by its maker's objects" if keeps_motor(session) else ""
        return (
            f"read ratings, resolutions, gear, feed, unit words and polarity{motor}, and compare with the "
            "nameplate"
        )

    def run(self, session: Session, outcome: StepOutcome) -> None:
        findings, plate, objects = session.found, session.request.nameplate, session.objects
        findings.told, findings.override = told, _ = _units(session, outcome)
        self.compare(session, outcome, told)
        for name, value, unit in (
            ("position", told.position_rad, "rad"),
            ("velocity", told.velocity_rad_s, "rad/s"),
            ("torque", told.torque_nm, "N m"),
        ):
            outcome.say(f"one {name} unit is {value:.6g} {unit} ({told.sources.get(name, 'told')})")
        polarity = objects.read_if_there(Object.POLARITY, 0, "B")
        outcome.say("no polarity object 607Eh" if polarity is None else f"polarity 607Eh is {polarity:02X}h")
        outcome.figures |= {
            "position_rad": told.position_rad,
            "velocity_rad_s": told.velocity_rad_s,
            "rated_torque_nm": told.rated_torque_nm,
            "polarity": polarity,
        }
        _judge(session, outcome, self.modes)
        rpm = objects.read_if_there(Object.MAX_MOTOR_SPEED)
        findings.limits = limits = motion_limits(plate, session.rated_torque_nm, rpm)
        outcome.say(
            f"host limits: {limits.torque_nm:.4g} N m, {limits.speed_rad_s / RAD_S_PER_RPM:.0f} r/min, "
            f"{limits.power_w:.4g} W, {limits.energy_j:.4g} J a step"
        )
        mode = session.motion_mode()
        if mode is not None:
            findings.period, load = session.choose_period(mode)
            outcome.say(f"period {findings.period / 1e3:.0f} us, at most {load:.0f} % bus load")

    def compare(self, session: Session, outcome: StepOutcome, told: Scaling) -> None:
        """Compare the drive with the nameplate, and read its motor's data."""
        doubt_plate(session, outcome)
        read_motor(session, outcome)
        compare_ratings(session, outcome, told.rated_torque_nm)
        settle_winding(session, outcome)


def _units(session: Session, outcome: StepOutcome) -> tuple[Scaling, ScaleOverride]:
    """Return the units by the drive, completed by the nameplate.

    Raises StepFailed that asks for everything still missing.
    """
    plate, override, missing = session.request.nameplate, ScaleOverride(), list[UnitNotTold]()
    torque_nm, counts = plate.rating.torque_nm, plate.encoder.counts_per_revolution
    if torque_nm and not session.objects.read_if_there(Object.MOTOR_RATED_TORQUE):
        override = ScaleOverride(rated_torque_nm=torque_nm)
        outcome.say(f"6076h tells no rated torque; the nameplate's {torque_nm:g} N m is taken")
    while True:
        try:
            told = read_scaling(session.objects, override)
            if override.position_rad is None:
                _plausible(told)
            break
        except UnitNotTold as error:
            known = _UNKNOWN
            if error.unit == "position" and counts is not None:
                known = math.tau / counts
                outcome.faults.append(f"{error.summary}; the nameplate's {counts} counts per turn are taken")
            else:
                missing.append(error)
            override = replace(override, **{_OVERRIDES[error.unit]: known})
    if missing:
        evidence = "; ".join(error.evidence for error in missing if error.evidence)
        remedy = "; ".join(_REMEDIES[error.unit] for error in missing)
        raise StepFailed("; ".join(error.summary for error in missing), evidence, remedy)
    return told, override


def _plausible(told: Scaling) -> Scaling:
    """Return ``told``. Raises UnitNotTold for a position unit too coarse to control any shaft."""
    if told.position_rad > _COARSEST_RAD:
        raise UnitNotTold(
            f"one position unit would be {told.position_rad:.4g} rad",
            f"{told.sources.get('position', 'the drive')} was never set",
            unit="position",
        )
    return told


def _judge(session: Session, outcome: StepOutcome, asked: Sequence[Mode]) -> None:
    """Find the modes in which the drive can be commanded. Raises StepFailed if there is none, or it is no
    drive."""
    identity = session.found.identity
    assert identity is not None, "the step 'identity' comes first"
    told = told_by_drive(session.objects, identity.device_type, session.sheet_told)
    judgement = judge(told, session.request.node, asked)
    session.found.modes = judgement.usable
    named = ", ".join(mode.title for mode in judgement.usable) or "none of use here"
    outcome.say(f"modes{'' if judgement.modes_told else ' to be tried, as 6502h tells none'}: {named}")
    outcome.lines += [f"{each.mode.title}: {each.reason}" for each in judgement.modes if each.reason]
    if judgement.obstacles:
        raise StepFailed(
            "the drive cannot be commissioned", "; ".join(judgement.obstacles), "hil eds tells it of a sheet"
        )
