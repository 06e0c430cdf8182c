"""Output of commissioning for ``hil run`` and ``hil design``: drive, motor, network, a bench, and a DCF."""

import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

from canopen.objectdictionary import ObjectDictionary, ODVariable

from servobench.drivers.canopen.objects301 import MANDATORY, MANUFACTURER, DataType
from servobench.drivers.cia402.drive_setup import Identity
from servobench.drivers.cia402.objects402 import Object
from servobench.drivers.cia402.profile import BENCH_MODES, Mode, QuickStopOption, run_words
from servobench.drivers.rotation import RAD_S_PER_RPM, RPM_PER_RAD_S
from servobench.drivers.sheets.dictionary import value_text
from servobench.hil.commissioning.findings import LOSSES_MAX, Findings
from servobench.hil.commissioning.rehearsal import (
    copied_files,
    sheet_name,
    simulation_table,
    ways_to_run,
)
from servobench.hil.commissioning.session import Session
from servobench.hil.commissioning.steps_design import rounded, suggested_limits
from servobench.hil.commissioning.torque_scale import torque_scale
from servobench.hil.configuration.config_files import toml_text
from servobench.hil.configuration.network_file import NETWORK_FILE, network_text
from servobench.hil.restoring.journal import SET_POINTS, ObjectKey
from servobench.hil.restoring.settings import pdo_of
from servobench.hil.rows.run_files import BENCH_FILE, COMMISSIONED_FILE

MOTOR_FILE: Final = "motor.toml"
DCF_FILE: Final = "drive.dcf"

_EXERCISE: Final = frozenset({*SET_POINTS, Object.HOMING_METHOD, Object.HOMING_SPEEDS})
"""Objects used by the steps only."""
_ERROR_SHARE: Final = 0.25
"""Rms error as a share of the reference: exceeded by a wrong sign or unit, not by a busy machine."""
_REFERENCE_SHARE: Final = 0.4
"""Share of the limits of speed and travel: overshoots stay within them."""
_UP_S: Final = 0.4
"""Time from rest to the speed of the reference."""
_CORNER_S: Final = 0.2
"""A path of positions starts at full speed; the drive may take a fifth of the path's second for it."""
_SETTINGS: Final = (Object.POLARITY,)
"""Settings that a run needs beyond its own writes."""

_UNSIGNED: Final = {
    1: DataType.UNSIGNED8, 2: DataType.UNSIGNED16, 4: DataType.UNSIGNED32, 8: DataType.UNSIGNED64
}  # fmt: skip
"""Data types by length, for objects without a data sheet."""


def write_files(session: Session) -> None:
    """Write the files that can be written."""
    out = session.request.out
    texts: dict[str, str] = {}
    findings = session.found
    if findings.identity is not None and findings.told is not None:
        text = f"The drive as commissioning found it.{_rests(session)}"
        texts[COMMISSIONED_FILE] = _headed(text, drive_tables(session))
    if findings.mechanics is not None:
        texts[MOTOR_FILE] = _motor_text(session)
    if findings.network is not None:
        texts[NETWORK_FILE] = (
            f"# What the bus does to readings and commands, measured.\n\n{network_text(findings.network)}"
        )
    journal = session.network.journal
    if journal is not None and journal.contents.changes:
        assert findings.identity is not None  # the journal names whose it is
        texts[DCF_FILE] = dcf_text(
            findings.settings,
            {ObjectKey(*place): held for place, held in findings.dump.items()} | findings.originals,
            session.dictionary,
            session.request.node,
            session.request.bitrate_bit_s,
            findings.identity,
        )
    mode = _mode_to_run(session, MOTOR_FILE in texts)
    if mode is not None:
        served = "the suggested controller" if mode == "cst" else f'set-points in mode "{mode}"'
        lines = [
            f"A bench for this drive, with {served} and limits.{_rests(session)}",
            *ways_to_run(session.request, Path()),
        ]
        texts[BENCH_FILE] = _headed("\n# ".join(lines), _bench_tables(session, mode))
        texts |= copied_files(session.request)
    for name, text in texts.items():
        (out / name).write_text(text, encoding="utf-8")


def _mode_to_run(session: Session, shaft_known: bool) -> str | None:
    """Return the ``mode`` of a bench for this drive: that of the suggested controller, or if the drive lacks
    it, one of speeds or positions. None, with a message, if no bench can be made."""
    modes = session.found.modes
    if Mode.CYCLIC_SYNCHRONOUS_TORQUE in modes:
        return "cst" if session.found.controller and shaft_known else None
    mode = next((key for key, each in BENCH_MODES.items() if each in modes), None)
    if mode is not None and shaft_known and session.configured:
        return mode
    if modes:
        why = run_words(modes) if mode is None else "inertia and friction of the shaft were not found"
        session.dialog.tell(f"no {BENCH_FILE}: {why}")
    return None


def set_objects(session: Session) -> dict[ObjectKey, bytes]:
    """Return the settings written, except unchanged ones and those used by the steps only."""
    journal = session.network.journal
    if journal is None:
        return {}
    originals = journal.contents.originals()
    plan = session.found.plan
    planned = set() if plan is None else {pdo.communication_index for pdo in plan}
    return {
        key: value
        for key, value in session.network.taken.get(session.request.node, {}).items()
        if value != originals.get(key, value)
        and key.index not in _EXERCISE
        and pdo_of(key.index) in (None, *planned)
    }


def drive_tables(session: Session) -> dict[str, Any]:
    """Return the tables of ``drive.toml``."""
    findings = session.found
    identity, override = findings.identity, findings.override
    assert identity is not None
    tables: dict[str, Any] = {
        "drive": {
            "node": session.request.node,
            "name": identity.device_name,
            "vendor": identity.vendor,
            "product": identity.product,
            "revision": identity.revision,
            "serial": identity.serial,
        },
        "scale": {
            key: value
            for key in ("position_rad", "velocity_rad_s", "acceleration_rad_s2", "rated_torque_nm")
            if (value := getattr(override, key)) is not None
        },
    }
    if override.torque_sign < 0.0 or override.velocity_sign < 0.0:
        tables["signs"] = {"torque": int(override.torque_sign), "velocity": int(override.velocity_sign)}
    if findings.quick_stop_option is not QuickStopOption.QUICK_STOP_RAMP:
        tables["stop"] = {"option": int(findings.quick_stop_option)}
    if findings.current_bandwidth_hz is not None:
        tables["current_loop"] = {"order": 1, "bandwidth_hz": findings.current_bandwidth_hz}
    own_ramp = findings.quick_stop_rad_s2 is not None
    objects = [
        {"index": key.index, "sub": key.sub, "bytes": value.hex()}
        for key, value in findings.settings.items()
        if key.index in _SETTINGS or (key.index == Object.QUICK_STOP_DECELERATION and own_ramp)
    ]
    if objects:
        tables["object"] = objects
    limits = suggested_limits(session)
    if limits:
        tables["limits"] = limits
    if findings.controller:
        tables["controller"] = findings.controller
    return tables


def _motor_text(session: Session) -> str:
    """Return ``motor.toml``: measured where possible, else from the nameplate, else a stand-in marked as
    such."""
    findings, plate = session.found, session.request.nameplate
    mechanics = session.mechanics
    rated_nm = session.drive.rated_torque_nm
    rating = plate.rating
    guesses = []
    pole_pairs = int(findings.value("pole_pairs") or 1)
    constant = findings.torque_constant_nm_a or findings.value("torque_constant_nm_a")
    if constant is None:
        constant = 1.0
        guesses.append("the flux is that of 1 N m per A rms")
    lag_s = 1e-6 * (findings.torque_lag_us or 500.0)
    resistance = findings.value("resistance_ohm") or 1.0
    inductance = findings.value("inductance_q_h") or resistance * lag_s
    if not {"resistance_ohm", "inductance_q_h"} <= findings.stated.keys():
        guesses.append("resistance and inductance are stand-ins with the measured lag of the torque")
    if "pole_pairs" not in findings.stated:
        guesses.append("the number of pole pairs is not known")
    speed_rpm = rating.speed_rpm or 2.0 * session.limits.speed_rad_s * RPM_PER_RAD_S
    current_a = rated_nm / constant
    # Rms to amplitude; the torque per amplitude of the amplitude-invariant transform is 3/2 n_p phi.
    flux = constant / math.sqrt(2.0) / (1.5 * pole_pairs)
    voltage = rating.dc_bus_voltage_v
    if voltage is None:
        voltage = 2.0 * math.sqrt(3.0) * pole_pairs * flux * speed_rpm * RAD_S_PER_RPM
        guesses.append("the DC bus voltage is twice what the rated speed needs")
    tables = {
        "motor": {
            "name": plate.motor.name,
            "resistance_ohm": resistance,
            "inductance_d_h": findings.value("inductance_d_h") or inductance,
            "inductance_q_h": inductance,
            "flux_linkage_wb": flux,
            "pole_pairs": pole_pairs,
            "transform": "amplitude_invariant",
        },
        "mechanics": {
            "inertia_kg_m2": mechanics.inertia_kg_m2,
            "viscous_friction_nm_s": max(0.0, mechanics.viscous_friction_nm_s),
            "coulomb_friction_nm": max(0.0, mechanics.coulomb_friction_nm),
        },
        "rating": {
            "torque_nm": rated_nm,
            "speed_rpm": speed_rpm,
            "current_max_a": math.sqrt(2.0) * (rating.current_max_a or 2.0 * current_a),
            "dc_bus_voltage_v": voltage,
        },
    }
    measured = (
        "Inertia, friction and torque constant" if findings.torque_constant_nm_a else "Inertia and friction"
    )
    notes = [f"{measured} are measured; they include the load on the shaft.{_rests(session)}"]
    notes += _by_word(findings)
    notes += [f"Not known: {guess}." for guess in guesses]
    return _headed(" ".join(notes), tables)


def _rests(session: Session) -> str:
    """Name the basis of every figure in N m and kg m^2, as a sentence to append."""
    scale = torque_scale(session.found, session.request.nameplate)
    return "" if scale is None else f" Each figure in N m or kg m^2 {scale.sentence}."


def _by_word(findings: Findings) -> list[str]:
    """Name the figures that rest on a statement alone."""
    words = {"resistance": "resistance_ohm", "inductance": "inductance_q_h", "pole pairs": "pole_pairs"}
    if findings.torque_constant_nm_a is None:
        words["torque constant"] = "torque_constant_nm_a"
    stated = {name: findings.stated[key] for name, key in words.items() if key in findings.stated}
    by_drive = {name: each.by for name, each in stated.items() if each.told}
    named = [name for name in stated if name not in by_drive]
    notes = [f"Not measurable over CiA 402, by the nameplate: {', '.join(named)}."] if named else []
    return notes + [f"Not measured: {name}, {by}." for name, by in by_drive.items()]


def _bench_tables(session: Session, mode: str) -> dict[str, Any]:
    findings = session.found
    limits = suggested_limits(session)
    controller: dict[str, Any] = findings.controller
    if mode != "cst":
        controller = {"kind": "stream"}
        del limits["torque_slew_max_nm_s"]
        limits["set_acceleration_max_rpm_s"] = rounded(_acceleration(session) * RPM_PER_RAD_S)
    drive: dict[str, Any] = {
        "node": session.request.node,
        **({} if mode == "cst" else {"mode": mode}),
        "motor": MOTOR_FILE,
        "commissioned": COMMISSIONED_FILE,
        **_heartbeats(session),
        **({"eds": sheet} if (sheet := sheet_name(session.request)) else {}),
        **({"unwatched": True} if session.unwatched else {}),
        **({"simulation": simulation} if (simulation := simulation_table(session.request)) else {}),
        "limits": limits,
        "controller": controller,
    }
    asked, error = _reference(session, mode)
    return {
        "bench": {"name": "commissioned", "duration_s": 3.0},
        "bus": {"spec": session.request.bus, "bitrate_bit_s": session.request.bitrate_bit_s},
        "host": _heartbeats(session),
        "loop": {"period_us": round(findings.period / 1000)},
        "drive": {"axis1": drive},
        "reference": {"axis1": asked},
        "verdict": {**error, "dropouts_percent_max": 100.0 * LOSSES_MAX},
    }


def _acceleration(session: Session) -> float:
    """Return the acceleration of set-points, rad/s^2: at most half of the allowed torque for the inertia."""
    limits = session.limits
    return min(limits.acceleration_rad_s2, 0.5 * limits.torque_nm / session.mechanics.inertia_kg_m2)


def _reference(session: Session, mode: str) -> tuple[list[dict[str, Any]], dict[str, float]]:
    """Return a reference to and fro, within half of the drive's own ramps, and the limit of the error."""
    speed = _REFERENCE_SHARE * session.limits.speed_rad_s
    rate = math.inf if mode == "cst" else 0.5 * _acceleration(session)
    if mode in ("csp", "ip"):
        way = rounded(min(speed, _REFERENCE_SHARE * session.limits.travel_rad, rate * _CORNER_S))
        to, fro = (
            {"kind": "ramp", "at_s": at_s, "position_rad": end, "over_s": 1.0}
            for at_s, end in ((0.2, way), (1.5, 0.0))
        )
        return [to, fro], {"position_error_rms_rad_max": rounded(_ERROR_SHARE * way)}
    rpm = float(max(1, round(min(speed, rate * _UP_S) * RPM_PER_RAD_S)))
    return [
        {"kind": "ramp", "at_s": 0.2, "speed_rpm": rpm, "over_s": _UP_S},
        {"kind": "ramp", "at_s": 1.5, "speed_rpm": -rpm, "over_s": 2.0 * _UP_S},
    ], {"speed_error_rms_rad_s_max": rounded(_ERROR_SHARE * rpm * RAD_S_PER_RPM)}


def _heartbeats(session: Session) -> dict[str, int]:
    request = session.request
    return {"heartbeat_ms": request.heartbeat_ms, "heartbeat_timeout_ms": request.heartbeat_timeout_ms}


def _headed(text: str, tables: dict[str, Any]) -> str:
    return f"# {text}\n\n{toml_text(tables)}"


def dcf_text(
    values: dict[ObjectKey, bytes],
    defaults: dict[ObjectKey, bytes],
    dictionary: ObjectDictionary | None,
    node: int,
    bitrate_bit_s: int,
    identity: Identity,
) -> str:
    """Return a device configuration file (CiA 306-1).

    ``values`` as ParameterValue and what was there before as DefaultValue; ``defaults`` of mandatory objects
    are written even if they were not set.
    """
    shown: dict[ObjectKey, bytes | None] = {key: None for key in defaults if key.index in MANDATORY}
    shown |= values
    indices = sorted({key.index for key in shown})
    device = {
        "ProductName": identity.device_name,
        "VendorNumber": f"0x{identity.vendor:08X}",
        "ProductNumber": f"0x{identity.product:08X}",
        "RevisionNumber": f"0x{identity.revision:08X}",
    }
    lines = [
        *_section("FileInfo", {"FileName": "drive.dcf", "FileVersion": 1, "EDSVersion": "4.0"}),
        *_section("DeviceInfo", device),
        *_section(
            "DeviceComissioning", {"NodeID": node, "Baudrate": bitrate_bit_s // 1000, "NodeName": "drive"}
        ),
    ]
    for title, members in (
        ("MandatoryObjects", [index for index in indices if index in MANDATORY]),
        ("OptionalObjects", [i for i in indices if i not in MANDATORY and i not in MANUFACTURER]),
        ("ManufacturerObjects", [index for index in indices if index in MANUFACTURER]),
    ):
        listed = {str(number): f"0x{index:04X}" for number, index in enumerate(members, start=1)}
        lines += _section(title, {"SupportedObjects": len(members), **listed})
    for index in indices:
        own = {key: value for key, value in shown.items() if key.index == index}
        lines += _object(index, own, defaults, dictionary)
    return "\n".join(lines) + "\n"


def _object(
    index: int,
    values: dict[ObjectKey, bytes | None],
    defaults: dict[ObjectKey, bytes],
    dictionary: ObjectDictionary | None,
) -> Iterable[str]:
    entry: Any = dictionary.get(index) if dictionary is not None else None
    plain = isinstance(entry, ODVariable) or (entry is None and all(key.sub == 0 for key in values))
    if plain:
        key = ObjectKey(index, 0)
        yield from _variable(f"{index:04X}", f"Object {index:04X}h", values[key], defaults.get(key), entry)
        return
    name = getattr(entry, "name", f"Object {index:04X}h")
    yield from _section(
        f"{index:04X}", {"ParameterName": name, "ObjectType": "0x9", "SubNumber": len(values)}
    )
    for key, value in sorted(values.items()):
        member = entry.subindices.get(key.sub) if entry is not None else None
        title = f"{index:04X}sub{key.sub:X}"
        yield from _variable(title, f"Sub-index {key.sub}", value, defaults.get(key), member)


def _variable(title: str, name: str, value: bytes | None, default: bytes | None, entry: Any) -> list[str]:
    width = len(value if value is not None else default or b"")
    data_type = getattr(entry, "data_type", None) or _UNSIGNED.get(width, DataType.OCTET_STRING)
    entries: dict[str, Any] = {
        "ParameterName": getattr(entry, "name", name),
        "ObjectType": "0x7",
        "DataType": f"0x{data_type:04X}",
        "AccessType": getattr(entry, "access_type", "rw" if value is not None else "ro"),
        "DefaultValue": "" if default is None else value_text(default, data_type),
    }
    if value is not None:
        entries["ParameterValue"] = value_text(value, data_type)
    return _section(title, {**entries, "PDOMapping": 0})


def _section(title: str, entries: dict[str, Any]) -> list[str]:
    return [f"[{title}]", *(f"{key}={value}" for key, value in entries.items()), ""]
