"""The witness decodes what CiA 301 has on the wire, and its judgement sees each kind of offence."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.rehearsals.made_sheet import MadeSheet
from tests.witness.allowed import documented
from tests.witness.case import Case, Ended
from tests.witness.frames import Access, Frame, NodeListener
from tests.witness.judgement import judged
from tests.witness.lateness import lateness
from tests.witness.witness import described

REQUEST, ANSWER = 0x601, 0x581
RPDO = {(0x1400, 1): (0x201).to_bytes(4, "little"), (0x1600, 0): b"\2"}
RPDO |= {(0x1600, 1): (0x60400010).to_bytes(4, "little"), (0x1600, 2): (0x22000110).to_bytes(4, "little")}


def frames(*lines: tuple[int, str]) -> Iterator[Frame]:
    """By identifier and data in hexadecimal."""
    for number, (cob_id, data) in enumerate(lines):
        yield Frame(float(number), cob_id, bytes.fromhex(data))


def heard(*lines: tuple[int, str], parameters: Any = RPDO) -> list[str]:
    """Accesses in words."""
    return [str(each) for each in NodeListener(1, dict(parameters)).accesses(frames(*lines))]


def test_a_write_in_one_frame_has_as_many_bytes_as_it_says() -> None:
    assert heard((REQUEST, "2B40600006000000"), (ANSWER, "6040600000000000")) == [
        "6040h:00 written by sdo 0600"
    ]


def test_a_write_that_is_refused_or_never_answered_is_a_write() -> None:
    refused = ((REQUEST, "2300210107000000"), (ANSWER, "8000210102000106"))
    assert heard(*refused) == ["2100h:01 written by sdo 07000000, refused with 06010002h"]
    assert heard((REQUEST, "2300210107000000")) == ["2100h:01 written by sdo 07000000"]
    again = (REQUEST, "4041600000000000"), (ANSWER, "4B41600050020000")
    assert heard(refused[0], *again) == [
        "2100h:01 written by sdo 07000000",
        "6041h:00 read by sdo 5002",
    ]


def test_a_write_in_segments_is_put_together() -> None:
    assert heard(
        (REQUEST, "2110200109000000"),
        (ANSWER, "6010200100000000"),
        (REQUEST, "0001020304050607"),
        (ANSWER, "2000000000000000"),
        (REQUEST, "1B08090000000000"),
        (ANSWER, "3000000000000000"),
    ) == ["2010h:01 written by sdo 010203040506070809"]


def test_a_write_in_blocks_counts_what_was_acknowledged_and_sent_again() -> None:
    assert heard(
        (REQUEST, "C21020010A000000"),
        (ANSWER, "A010200104000000"),
        (REQUEST, "0101020304050607"),
        (REQUEST, "8208090A00000000"),
        (ANSWER, "A201040000000000"),  # the second was lost
        (REQUEST, "8108090A00000000"),
        (ANSWER, "A201040000000000"),
        (REQUEST, "D100000000000000"),
        (ANSWER, "A100000000000000"),
    ) == ["2010h:01 written by sdo 0102030405060708090a"]


def test_reads_come_with_what_was_read_in_one_frame_and_in_segments() -> None:
    assert heard(
        (REQUEST, "4008100000000000"),
        (ANSWER, "4108100009000000"),
        (REQUEST, "6000000000000000"),
        (ANSWER, "0041424344454647"),
        (REQUEST, "7000000000000000"),
        (ANSWER, "1B48490000000000"),
    ) == ["1008h:00 read by sdo 414243444546474849"]


def test_an_rpdo_writes_what_its_mapping_says_at_that_moment() -> None:
    remapped = ((REQUEST, "2300160100108000"[:8] + "10007160"), (ANSWER, "6000160100000000"))
    assert heard(
        (0x201, "0F00FFFF"), *remapped, (0x201, "0F00FFFF"), (0x000, "8201"), (0x201, "0F00FFFF")
    ) == [
        "6040h:00 written by rpdo 0f00",
        "2200h:01 written by rpdo ffff",
        "1600h:01 written by sdo 10007160",
        "6071h:00 written by rpdo 0f00",
        "2200h:01 written by rpdo ffff",
        "6040h:00 written by rpdo 0f00",
        "2200h:01 written by rpdo ffff",
    ]


def test_identifiers_of_no_service_of_the_node_are_noted() -> None:
    listener = NodeListener(1, {**RPDO, (0x1800, 1): (0x181).to_bytes(4, "little")})
    known = (
        (0x000, "0101"),
        (0x080, ""),
        (0x081, "00" * 8),
        (0x701, "05"),
        (0x77F, "05"),
        (0x181, "00"),
        (0x201, ""),
    )
    list(listener.accesses(frames(*known, (0x7E5, "0400000000000000"), (0x123, "00"))))
    assert listener.unexplained == {0x7E5, 0x123}


def test_a_sheet_is_read_by_its_text(tmp_path: Path) -> None:
    path = tmp_path / "made.eds"
    path.write_text(MadeSheet().text())
    variables = described(path)
    assert variables[0x6041, 0].access == "ro"
    assert variables[0x1018, 1].readable
    assert (0x1018, 1) in variables
    assert variables[0x6040, 0].writable


def test_the_documents_allow_no_object_of_a_maker_to_be_written() -> None:
    allowed = documented()
    assert (0x6040, 0) in allowed.writes["run"]
    assert (0x1016, 0x7F) in allowed.writes["commission"]
    assert (0x607D, 2) not in allowed.writes["run"]
    assert not [key for keys in allowed.writes.values() for key in keys if 0x2000 <= key[0] < 0x6000]
    assert 0x3001 in allowed.maker_reads


# ---- judgement --------------------------------------------------------------------------------------------

CST = {"mode": "cyclic synchronous torque", "commission": True, "run": "cst"}
SHEET = {"obstacles": [], "usable_modes": [CST]}
DONE = {"error": None, "steps": [{"name": "bus", "verdict": "done", "reason": "", "lines": [], "faults": []}]}
LISTED = Access("sdo", True, 0x6040, 0, b"\6\0")


@pytest.fixture
def sound(tmp_path: Path) -> Case:
    """Nothing is wrong with it."""
    path = tmp_path / "made.eds"
    path.write_text(MadeSheet().text())
    case = Case(
        path, described(path), Ended((), 0, SHEET, ""), [Ended((), 0, DONE, "")], Ended((), 0, {}, "")
    )
    case.accesses = {"commission": [LISTED], "run": [LISTED]}
    return case


def wrong(case: Case, changed: frozenset[int] | None = frozenset({0x6502}), sound: bool = True) -> list[str]:
    """All that the judgement says."""
    return judged(case, changed, sound, documented()).wrong


def ended(case: Case, error: str, lines: Sequence[str] = ()) -> Case:
    """Commissioning failed so, and no run was made."""
    step = {"name": "setup", "verdict": "failed", "reason": error, "lines": list(lines), "faults": []}
    return replace(case, commissions=[Ended((), 1, {"error": error, "steps": [step]}, "")], run=None)


def test_nothing_is_wrong_with_a_sound_case(sound: Case) -> None:
    assert wrong(sound) == []


@pytest.mark.parametrize(
    "access",
    [
        Access("sdo", True, 0x2100, 1, bytes(4)),
        Access("sdo", True, 0x607D, 1, bytes(4)),
        Access("rpdo", True, 0x2200, 1, b"\0"),
        Access("sdo", False, 0x2FFF, 1, bytes(4)),
    ],
    ids=str,
)
def test_what_no_list_allows_is_named(sound: Case, access: Access) -> None:
    sound.accesses["run"].append(access)
    assert wrong(sound) == [f"run: {access}"]


def test_a_fixed_rpdo_may_hold_what_the_drive_held(sound: Case) -> None:
    sound.accesses["run"].append(Access("rpdo", True, 0x2200, 0, b"\7"))
    assert wrong(sound)
    sound.held[0x2200, 0] = b"\7"
    assert wrong(sound) == []


def test_commands_that_contradict_each_other_are_named(sound: Case) -> None:
    refused = ended(sound, "the drive takes none of the modes")
    assert wrong(refused, sound=False) == [
        "hil eds: it can serve a bench; hil commission: the drive takes none of the modes"
    ]
    none = {"obstacles": ["6502h: no mode"], "usable_modes": [{**CST, "commission": False, "run": None}]}
    cannot = replace(sound, eds=Ended((), 1, none, ""))
    assert wrong(cannot, sound=False) == [
        "hil eds: it cannot serve a bench (6502h: no mode); it was commissioned",
        "hil eds gives no mode for hil run, and it ran",
        "hil eds: it cannot serve a bench; hil run ran it",
    ]
    failed = replace(sound, run=Ended((), 3, {}, "hil: error: axis1 has no such mode"))
    assert wrong(failed) == ["commissioned, hil run leaves with 3: hil: error: axis1 has no such mode"]
    lossy = {
        "dropouts": {"lost": 1, "late": 78},
        "verdict": {"reason": "dropouts_percent_max = 10, found 10.53"},
    }
    failed = replace(sound, run=Ended((), 1, lossy, ""))
    assert wrong(failed) == [
        "commissioned, hil run leaves with 1: dropouts_percent_max = 10, found 10.53; "
        "readings: 1 lost, 78 late"
    ]


def test_a_refusal_that_hil_eds_foresees_is_no_contradiction(sound: Case) -> None:
    remark = "6083h takes 1 at most: hil commission refuses a mode that it makes too slow"
    slow = replace(sound, eds=Ended((), 0, {**SHEET, "remarks": [remark]}, ""))
    assert wrong(ended(slow, "a ramp is too slow; 6083h = 1 (0.1 rad/s^2)"), frozenset({0x6083}), False) == []
    assert len(wrong(ended(slow, "a ramp is too slow; 60C5h = 1"), frozenset({0x60C5}), False)) == 1


@pytest.mark.parametrize(
    ("reason", "said"),
    [
        ("the drive has no mode; 6041h is missing", "6041h is in the sheet"),
        ("the drive has no mode; refused with 06040041h", "no transfer was aborted with 06040041h"),
        ("606Ch scatters too much", "not what is odd in the sheet"),
    ],
)
def test_a_false_reason_is_named(sound: Case, reason: str, said: str) -> None:
    case = replace(ended(sound, reason), eds=Ended((), 1, {**SHEET, "obstacles": ["6502h: no mode"]}, ""))
    assert any(said in each for each in wrong(case, sound=False))


def test_a_motion_that_the_machine_had_no_time_for_says_nothing_of_the_drive(sound: Case) -> None:
    case = ended(sound, "460 of 2002 readings were lost")
    late = replace(
        case, commissions=[replace(case.commission, late="60 of 2002 cycles were late on the bus")]
    )
    assert len(wrong(case, frozenset())) == 4
    result = judged(late, frozenset(), True, documented())
    assert (result.wrong, len(result.late)) == ([], 4)
    assert result.is_to_be_tried_again


def test_a_motion_alone_that_is_wrong_is_tried_again_and_no_other_fault(sound: Case) -> None:
    case = ended(sound, "460 of 2002 readings were lost")
    assert judged(case, frozenset(), True, documented()).is_to_be_tried_again
    case.left.append("commission: left turning, 6064h 0 -> 4000")
    assert not judged(case, frozenset(), True, documented()).is_to_be_tried_again
    assert not judged(sound, frozenset(), True, documented()).is_to_be_tried_again


def test_what_a_late_command_wrote_said_and_left_is_judged(sound: Case) -> None:
    case = ended(sound, "the drive has no mode; 6041h is missing")
    late = replace(case, commissions=[replace(case.commission, late="an SDO answer took 900 ms")])
    late.accesses["commission"].append(Access("sdo", True, 0x2100, 1, bytes(4)))
    late.left.append("commission: left turning, 6064h 0 -> 4000")
    result = judged(late, frozenset(), True, documented())
    assert [len(each) for each in (result.unasked, result.false_reasons, result.unsafe)] == [1, 1, 1]


def cycles(periods_ms: Sequence[float], answer_ms: float = 1.0) -> list[Frame]:
    """SYNCs with the reading of node 1 after each."""
    at, heard = 0.0, []
    for period in periods_ms:
        heard += [Frame(at / 1e3, 0x080, b""), Frame((at + answer_ms) / 1e3, 0x181, bytes(8))]
        at += period
    return sorted(heard)


def unanswered(frames: list[Frame], count: int) -> list[Frame]:
    """Without so many readings in a row."""
    readings = [frame for frame in frames if frame.cob_id == 0x181]
    return sorted(set(frames) - set(readings[1000 : 1000 + count]))


def silent(pause_ms: float, controlword: str) -> list[Frame]:
    """A host that pauses, and asks before it goes on, after the controlword."""
    asked = Frame((2000.0 + pause_ms) / 1e3, 0x601, bytes(8))
    return sorted(
        [
            Frame(0.0001, 0x601, bytes.fromhex(controlword)),
            *cycles([4.0] * 500),
            *after(2.0, cycles([pause_ms + 1.0] + [4.0] * 500)),
            asked,
        ]
    )


def after(seconds: float, frames: Sequence[Frame]) -> list[Frame]:
    return [frame._replace(at_s=frame.at_s + seconds) for frame in frames]


@pytest.mark.parametrize(
    ("frames", "said"),
    [
        (cycles([4.0] * 1000), ""),
        (cycles([4.0] * 500 + [36.0] + [4.0] * 500), ""),
        (sorted([*cycles([4.0] * 500 + [2000.0] + [4.0] * 500), Frame(3.0, 0x601, bytes(8))]), ""),
        (cycles([4.0] * 500 + [104.0] + [4.0] * 500), "nothing for 104 ms between two SYNCs"),
        (cycles([4.0] * 1000 + [8.0, 4.0] * 3), "3 of 1005 cycles"),
        (cycles([4.0] * 500) + [Frame(2.0 + n / 500, 0x080, b"") for n in range(3)], "2 of 502 cycles"),
        (unanswered(cycles([4.0] * 15_000), 26), "26 cycles in a row were late"),
        (unanswered(cycles([4.0] * 15_000), 9), ""),
        (silent(110.0, "2B4060000F000000"), "nothing for 110 ms while the drive was to operate"),
        (silent(110.0, "2B40600007000000"), ""),
        (silent(50.0, "2B4060000F000000"), ""),
        (sorted([*silent(110.0, "2B4060000F000000"), Frame(2.05, 0x081, bytes(8))]), ""),
        (cycles([4.0] * 1000, answer_ms=1.9), ""),
        ([*cycles([4.0] * 900), *after(3.6, cycles([4.0] * 100, answer_ms=2.2))], "99 of 999 cycles"),
        (
            [Frame(0.0, 0x601, bytes(8)), Frame(0.1, 0x601, bytes(8)), Frame(0.3, 0x581, bytes(8))],
            "took 300 ms",
        ),
        ([Frame(0.0, 0x601, bytes(8)), Frame(0.1, 0x581, bytes(8))], ""),
    ],
)
def test_lateness_is_seen_in_the_frames(frames: list[Frame], said: str) -> None:
    told = lateness(frames, 1)
    assert said in told
    assert bool(said) is bool(told)


def test_a_run_that_stops_for_some_periods_was_kept_from_its_work() -> None:
    """A commissioning stops for five periods between two exercises without a word; a run has no reason to."""
    frames = cycles([4.0] * 500 + [20.0, 4.0] * 5 + [4.0] * 100)
    assert lateness(frames, 1) == ""
    assert lateness(frames, 1, pauses=False) == "5 of 609 cycles were late on the bus"


def test_settings_that_were_not_put_back_are_named(sound: Case) -> None:
    sound.changed.append("commission: 6085h:00 00 -> 01")
    assert wrong(sound) == ["commission: 6085h:00 00 -> 01"]
