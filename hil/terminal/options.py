"""Options shared by several commands, each declared once; node ids as typed: ``1``, ``1,2,5``, ``1-3``,
``unconfigured:3``; and serial numbers.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_args

import typer

from servobench.drivers.canopen.nmt_states import NODE_ID_MAX, UNCONFIGURED
from servobench.drivers.errors import MISSING, BadInput
from servobench.hil.terminal.output import say

if TYPE_CHECKING:
    from servobench.design.motor import PmsmParameters
    from servobench.hil.configuration.config import Foreign
    from servobench.hil.configuration.motor_file import MotorFile
    from servobench.virtual_bus.hosting.injection import Faults


def flag(name: str, text: str) -> Any:
    """Declare a flag; its help shows no value."""
    return typer.Option(name, metavar="", help=text)


def _note_unsealed(asked: bool) -> bool:
    if asked:
        say("hil: note: unsealed: no file was checked against its seal")
    return asked


def valued(
    name: str, metavar: str | None, text: str, *, min: float | None = None, max: float | None = None
) -> Any:
    """Declare an option ``name`` with a value from ``min`` to ``max``; its help shows ``metavar`` and
    ``text``."""
    return typer.Option(name, metavar=metavar, help=text, min=min, max=max)


def given(options: object, *names: str) -> dict[str, Any]:
    """Return the values of these fields of a class of options, by option, without those that are None."""
    values = {f"--{name.replace('_', '-')}": getattr(options, name) for name in names}
    return {option: value for option, value in values.items() if value is not None}


def bus_option(text: str) -> Any:
    """Declare ``--bus``; ``text``: the possible buses."""
    return typer.Option("--bus", metavar="SPEC", help=text)


def bitrate_option(text: str) -> Any:
    """Declare ``--bitrate``, bit/s."""
    return typer.Option("--bitrate", metavar="BIT/S", min=10_000, help=text)


def seed_option(text: str, most: int | None = 2**63 - 1) -> Any:
    """Declare ``--seed``; ``text``: its use."""
    return typer.Option("--seed", min=0, max=most, help=text)


def faults_option(side: str) -> Any:
    """Declare ``--faults``; ``side``: the side of the bus on which they act."""
    return typer.Option(
        "--faults", metavar="FAULTS.toml", help=f"Fault plan, on the {side}'s side of the bus."
    )


def gamma_option(least: float) -> Any:
    """Declare ``--gamma`` of an H-infinity design."""
    return typer.Option("--gamma", min=least, help="Upper bound of the norm.")


def controller_out_option(metavar: str) -> Any:
    """Declare ``--out`` of a design."""
    return typer.Option("--out", metavar=metavar, help="Write the controller, for a bench file.")


EVERY_STREAM = seed_option("Seed of every random stream.")


def json_option(text: str) -> Any:
    """Declare ``--json``; ``text``: the output."""
    return flag("--json", text)


JsonOption = Annotated[bool, json_option("Print one JSON object on stdout, all else on stderr.")]
JsonLinesOption = Annotated[bool, json_option("Print one JSON object a line on stdout, all else on stderr.")]
UnsealedOption = Annotated[
    bool,
    typer.Option(
        "--unsealed",
        metavar="",
        callback=_note_unsealed,
        help="Read files even if they do not match their seal.",
    ),
]
RunArgument = Annotated[Path, typer.Argument(metavar="RUN", help="The folder of a run.")]
DriveBusOption = Annotated[str, bus_option("hub:NAME, socketcan:can0, or INTERFACE:CHANNEL.")]
DriveNodeOption = Annotated[int, valued("--node", "N", "The drive's node id.", min=1, max=127)]
BitrateOption = Annotated[int, bitrate_option("Bit rate of the bus, bit/s.")]
SeedOption = Annotated[int | None, EVERY_STREAM]
YesOption = Annotated[bool, flag("--yes", "Do every step without asking.")]
DryRunOption = Annotated[bool, flag("--dry-run", "Only read; describe the other steps.")]
HeartbeatTimeoutOption = Annotated[
    int, valued("--heartbeat-timeout-ms", None, "Heartbeat time-out of host and drive.", min=20, max=60_000)
]
UnwatchedOption = Annotated[
    bool,
    flag(
        "--unwatched",
        "Accept a drive that cannot watch its host: motions are slow, weak and short; stand by.",
    ),
]
AllowOption = Annotated[
    list[str] | None,
    valued(
        "--allow",
        "KIND",
        "Frames that other nodes may send (guard.allow of a bench): nmt, sync, heartbeat, sdo_read, "
        "sdo_write, sdo_answer, rpdo, tpdo; repeatable. Default: sdo_read.",
    ),
]
DriveFaultsOption = Annotated[Path | None, faults_option("drive")]
SpanOption = Annotated[float | None, valued("--span", "S", "Time shown around --at; default: all.", min=1e-6)]
ControllerOutOption = Annotated[Path | None, controller_out_option("FILE")]
MotorArgument = Annotated[Path, typer.Argument(metavar="MOTOR.toml", help="The motor file.")]
DriveMotorOption = Annotated[
    Path | None, valued("--motor", "MOTOR.toml", "Motor file; default: that of [Ling2012].")
]


def motor_file(path: Path, option: str = "MOTOR.toml") -> "MotorFile":
    """Load the motor file of an argument or option. Raises BadInput or BadInputs."""
    from servobench.drivers.bounded_file import NamedBy
    from servobench.hil.configuration.motor_file import load_motor

    return load_motor(path, NamedBy(option, "", str(path)))


def rigid_motor(path: Path, knows_coupling: bool = False) -> "PmsmParameters":
    """The motor of a design, which knows no place, and no coupling unless ``knows_coupling``; what it leaves
    out is said. Raises BadInput or BadInputs."""
    motor = motor_file(path).parameters
    mechanism = motor.mechanism
    if mechanism is not None and mechanism.coupling is not None and not knows_coupling:
        found_hz = f"{mechanism.coupling.resonance_hz:.3g} Hz"
        say(f"hil: note: {path}: a rigid shaft is assumed, the coupling's resonance at {found_hz} left out")
    if mechanism is not None and mechanism.load is not None and mechanism.load.of_its_place:
        parts = ", ".join(mechanism.load.of_its_place)
        say(f"hil: note: {path}: a load that no place changes is assumed, {parts} of [load] left out")
    return motor


def fault_plan(path: Path | None) -> "Faults | None":
    """Load the plan of ``--faults``, if given. Raises BadInput or BadInputs."""
    from servobench.drivers.bounded_file import NamedBy
    from servobench.hil.configuration.bench_file import load_faults

    return load_faults(path, NamedBy("--faults", "", str(path))) if path else None


def allowed(kinds: list[str] | None) -> "tuple[Foreign, ...]":
    """Check ``--allow``. Raises BadInput."""
    from servobench.hil.configuration.config import Foreign, Guard

    known: dict[str, Foreign] = {kind: kind for kind in get_args(Foreign)}
    for kind in kinds or ():
        if kind not in known:
            raise BadInput("--allow", "", kind, f"one of {', '.join(known)}")
    return Guard().allow if kinds is None else tuple(known[kind] for kind in kinds)


SERIAL_MAX = 0xFFFF_FFFF
SERIAL_DIGITS_MAX = 12
"""32 bits are ten digits, and as many with 0x."""


def node_ids(texts: Sequence[str], option: str = "--node") -> list[int]:
    """Parse the node ids of all ``texts``, in order. Raises BadInput for an invalid or repeated one."""
    nodes: list[int] = []
    for text in texts:
        for part in text.split(","):
            nodes.extend(_range(part.strip(), option))
    if not nodes:
        raise BadInput(option, "", MISSING, f"a node id 1..{NODE_ID_MAX}, e.g. {option} 1 or {option} 1-3")
    for node in nodes:
        if node != UNCONFIGURED and nodes.count(node) > 1:
            raise BadInput(option, "", node, "each node id once")
    return nodes


def drive_ids(texts: Sequence[str]) -> list[int]:
    """Parse node ids of devices that have one; see :func:`node_ids`."""
    nodes = node_ids(texts)
    if UNCONFIGURED in nodes:
        expected = f"a node id 1..{NODE_ID_MAX}"
        raise BadInput("--node", "", "unconfigured", expected, "hil scan --assign gives one")
    return nodes


def _number(digits: str) -> int:
    """Parse a number; one with too many digits becomes too large."""
    return int(digits) if len(digits) < 10 else NODE_ID_MAX + 1


def serial_numbers(texts: Sequence[str], count: int) -> list[int]:
    """Return a serial number for each of ``count`` devices; from a single one the others count up. Empty:
    none.

    Raises BadInput for an invalid or repeated one, and for too few or too many.
    """
    typed = [_serial(part.strip()) for text in texts for part in text.split(",")]
    if len(typed) == 1:
        typed = [_serial(str(typed[0] + place)) for place in range(count)]
    if typed and (len(typed) != count or len(set(typed)) != count):
        expected = f"a serial number for each of {count} nodes, each once; or one"
        raise BadInput("--serial", "", ",".join(texts), expected)
    return typed


def _serial(text: str) -> int:
    base = 16 if text.lower().startswith("0x") else 10
    try:
        number = int(text, base) if len(text) <= SERIAL_DIGITS_MAX else -1
    except ValueError:
        number = -1
    if not 0 <= number <= SERIAL_MAX:
        raise BadInput("--serial", "", text, f"serial numbers 0..{SERIAL_MAX}, decimal or with 0x")
    return number


def _range(text: str, option: str) -> Sequence[int]:
    name, colon, many = text.partition(":")
    if name in ("unconfigured", str(UNCONFIGURED)):
        if colon and not (many.isdecimal() and 1 <= _number(many) <= NODE_ID_MAX):
            raise BadInput(option, "", text, f"how many nodes without id, 1..{NODE_ID_MAX}: unconfigured:3")
        return [UNCONFIGURED] * (_number(many) if colon else 1)
    first, dash, last = text.partition("-")
    if not first.isdecimal() or (dash and not last.isdecimal()):
        raise BadInput(option, "", text, f"a node id 1..{NODE_ID_MAX}, a list 1,2 or a range 1-3")
    low, high = _number(first), _number(last if dash else first)
    if not 1 <= low <= high <= NODE_ID_MAX:
        raise BadInput(option, "", text, f"node ids within 1..{NODE_ID_MAX}, the smaller first")
    return range(low, high + 1)
