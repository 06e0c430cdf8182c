"""The numbers of CANopen and CiA 402 beside python-canopen's, and as the standards print them.

The client and the simulated drive speak by the same tables: a wrong number there agrees with itself.
"""

from pathlib import Path

import canopen.nmt
from canopen.lss import LssMaster
from canopen.objectdictionary import datatypes
from canopen.profiles.p402 import OperationMode

from servobench.drivers.canopen import cob_ids
from servobench.drivers.canopen.error_codes import ErrorRegister
from servobench.drivers.canopen.nmt_states import NmtCommand, NmtState
from servobench.drivers.canopen.objects301 import REAL_BITS, SIGNED_BITS, UNSIGNED_BITS, DataType
from servobench.drivers.cia402 import profile
from servobench.drivers.cia402.objects402 import Object, Unit
from tests.told import hold

TOLD = Path(__file__).with_name("told")


def test_data_types_are_those_of_python_canopen() -> None:
    shared = {kind.name: int(kind) for kind in DataType}
    assert shared == {name: getattr(datatypes, name) for name in shared}
    lengths = SIGNED_BITS | UNSIGNED_BITS | REAL_BITS
    counted = {getattr(datatypes, name) for name in dir(datatypes) if name[-1].isdigit()} | {1}
    assert {int(kind) for kind in lengths} == counted
    for kind, bits in lengths.items():
        assert DataType(kind).name == "BOOLEAN" if bits == 1 else DataType(kind).name.endswith(f"{bits}")


def test_network_management_is_that_of_python_canopen() -> None:
    states = {name.replace("-", "_"): number for number, name in canopen.nmt.NMT_STATES.items()}
    assert {state.name: int(state) for state in NmtState} == {
        name: number for name, number in states.items() if name not in ("SLEEP", "STANDBY")
    }
    theirs = canopen.nmt.NMT_COMMANDS
    assert [int(command) for command in NmtCommand] == [
        theirs[name] for name in ("OPERATIONAL", "STOPPED", "PRE-OPERATIONAL", "RESET", "RESET COMMUNICATION")
    ]


def test_modes_of_operation_are_those_of_python_canopen() -> None:
    names = {
        number: name for number, name in OperationMode.CODE2NAME.items() if name in OperationMode.SUPPORTED
    }
    newer = profile.Mode.CYCLIC_SYNCHRONOUS_TORQUE_WITH_ANGLE
    assert {*profile.Mode} == {*names, newer}
    for number, name in names.items():
        assert profile.supported_mode_bit(profile.Mode(number)) == OperationMode.SUPPORTED[name]
    assert profile.supported_mode_bit(newer) == 1 << 10


def test_identifiers_of_a_node_are_those_of_python_canopen() -> None:
    node = canopen.RemoteNode(5, canopen.ObjectDictionary())  # type: ignore[no-untyped-call]
    assert (node.sdo.rx_cobid, node.sdo.tx_cobid) == (cob_ids.SDO_REQUEST + 5, cob_ids.SDO_ANSWER + 5)
    assert (LssMaster.LSS_TX_COBID, LssMaster.LSS_RX_COBID) == (cob_ids.LSS_REQUEST, cob_ids.LSS_ANSWER)


def test_what_the_standards_print() -> None:
    """CiA 301, CiA 402-2 and CiA 303-2; the objects' names beside those in six makers' data sheets, once."""
    options = [kind for name, kind in vars(profile).items() if name.endswith("Option")]
    lines = [f"{one:04X}h {one.title}" for one in Object]
    for kind in (Unit, ErrorRegister, profile.Mode, *options):
        lines += [f"== {kind.__name__}", *(f"{int(one):02X}h {one.name}" for one in kind)]
    for name, value in sorted(vars(cob_ids).items()):
        if name.isupper() and not name.startswith("_"):
            shown = value if isinstance(value, int) else sorted(value.items())
            lines.append(f"{name} {shown:03X}h" if isinstance(shown, int) else f"{name} {shown}")
    hold("\n".join(lines), TOLD / "vocabulary.txt")
