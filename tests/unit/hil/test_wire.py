"""Frames on the wire, patterns of them, and what a test may claim."""

from collections.abc import Callable
from pathlib import Path

import pytest

from servobench.drivers.canopen.cob_ids import frame_name
from servobench.drivers.cia402.pdo_planner import all_modes_plan, mode_plan, plan_pdos
from servobench.drivers.cia402.pdo_plans import PlanWish
from servobench.drivers.cia402.profile import Mode
from servobench.drivers.sheets.capability import capability_of
from servobench.drivers.sheets.dictionary import load_dictionary
from servobench.drivers.timebase import NS_PER_MS, Instant
from servobench.hil.configuration.config_checks import standard_plan
from servobench.hil.rows.records_file import RecordsWriter
from servobench.hil.testing.wire import Controlword, SeenFrame, Wire, intended_frames, pdo_plans, read_wire
from tests.recorded_frames import write_frames
from tests.unit.drivers.eds_maker import four_pdos, sheet_text
from tests.unit.hil.made_runs import BENCH

PLAN = mode_plan(1, PlanWish())
INTENDED = intended_frames(127, 1, PLAN)
STATUS = "181#3712000000000000"


def wire(*texts: str) -> Wire:
    """Frames in candump's form, 1 ms apart; those of the master by their identifiers."""
    found = Wire()
    for number, text in enumerate(texts, start=1):
        identifier, _, data = text.partition("#")
        can_id = int(identifier, 16)
        sent = can_id in (0x000, 0x080) or can_id & 0x780 in (0x200, 0x300, 0x400, 0x600) or can_id == 0x77F
        found.take(
            "tx" if sent else "rx",
            can_id,
            b"" if data == "R" else bytes.fromhex(data),
            len(identifier) > 3,
            data == "R",
            Instant(number * NS_PER_MS),
        )
    return found


def test_a_frame_is_written_as_candump_does() -> None:
    texts = ["080#", "201#0F00F401", "1ABCDEF0#01", "701#R"]
    assert [frame.text for frame in wire(*texts).frames] == texts


@pytest.mark.parametrize(
    ("pattern", "count"),
    [("201#*", 2), ("201#0F00*", 1), ("2..#*", 2), ("201#....", 1), (".*", 4), ("701#05", 1), ("7..#", 0)],
)
def test_patterns(pattern: str, count: int) -> None:
    seen = wire("000#0101", "201#0F00F401", "201#0600", "701#05")
    assert len(seen.find(pattern)) == count


@pytest.mark.parametrize("pattern", ["", "201", "2011#00", "201#0", "201#0F*0", "xyz#00", "201#GG"])
def test_what_is_no_pattern_is_refused(pattern: str) -> None:
    with pytest.raises(ValueError, match="no pattern of a frame"):
        wire().find(pattern)


def test_seen_and_none_count_and_list() -> None:
    seen = wire("080#", "201#0F000000", "080#")
    seen.assert_seen("080#")
    seen.assert_seen("080#", times=2)
    seen.assert_none("081#*")
    seen.assert_none("080#", sent=False)
    with pytest.raises(AssertionError, match=r"2 frames 080#, 1 expected:\n  0.001000 s sent 080# \(SYNC\)"):
        seen.assert_seen("080#", times=1)
    with pytest.raises(AssertionError, match=r"no frame 081#.. among 3"):
        seen.assert_seen("081#..")
    with pytest.raises(AssertionError, match=r"1 frames 201#\*, none expected"):
        seen.assert_none("201#*")


def test_a_sequence_allows_others_between_but_no_other_order() -> None:
    seen = wire("000#0101", "080#", "701#05", "201#0F000000")
    seen.assert_sequence("000#01..", "701#05", "201#0F00*")
    with pytest.raises(AssertionError, match=r"no frame 000#01.. after 701#05; there are, too early:"):
        seen.assert_sequence("701#05", "000#01..")
    with pytest.raises(AssertionError, match="no frame 080# after 080#"):
        seen.assert_sequence("080#", "080#")


@pytest.mark.parametrize(
    "stray",
    [
        "081#1043090000000000",  # EMCY
        "201#0F00F40100",  # RPDO1, a byte too long
        "301#0F0000000000",  # an RPDO that the plan has not
        "202#0F000000",  # another node's
        "705#05",
        "1ABCDEF0#01",
        "181#R",
        "123#",
    ],
)
def test_what_does_not_belong_to_the_plan_is_unintended(stray: str) -> None:
    usual = ["000#0101", "080#", STATUS, "281#0000000000000000", "201#0F000000", "77F#05", "701#05"]
    usual += ["601#4041600000000000", "581#4B41600037120000"]
    wire(*usual).assert_only(INTENDED)
    with pytest.raises(AssertionError, match=rf"1 unintended of 10 frames:\n  0.010000 s .* {stray} "):
        wire(*usual, stray).assert_only(INTENDED)
    wire(*usual, stray).assert_only(INTENDED, allow=[stray])


def test_a_master_s_frame_from_another_node_is_unintended() -> None:
    seen = Wire()
    seen.take("rx", 0x201, bytes(4), False, False, Instant(0))
    with pytest.raises(AssertionError, match="received 201#00000000"):
        seen.assert_only(INTENDED)


def test_controlwords_of_every_rpdo_and_of_sdo_in_order() -> None:
    plan = all_modes_plan(1)
    seen = wire(
        "601#2B40600006000000",
        "201#0F000000",
        "301#0F0000000000",
        "401#1F0000000000",
        "601#2B4060000F010000",
        "601#2B60600008000000",  # 6060h, no controlword
        "602#2B40600002000000",  # another node's
        "201#0200",  # too short for its mapping: the drive takes nothing from it
    )
    assert [found.word for found in seen.controlwords(1, plan)] == [0x06, 0x0F, 0x1F, 0x10F]


def test_a_window_of_time() -> None:
    seen = wire("080#", "181#00", "080#").between(0.002, 0.003)
    assert [frame.text for frame in seen.frames] == ["181#00"]


@pytest.mark.parametrize(("count", "more"), [(1, ""), (5, ""), (6, "\n  and 1 more"), (9, "\n  and 4 more")])
def test_five_frames_are_listed_and_the_others_counted(count: int, more: str) -> None:
    seen = wire(*["701#05"] * count)
    seen.zero, seen.recording = Instant(NS_PER_MS), Path("run")
    listed = "".join(
        f"\n  {1e-3 * place:.6f} s received 701#05 (heartbeat of node 1)" for place in range(min(count, 5))
    )
    claims: list[Callable[[], None]] = [
        lambda: seen.assert_none("7..#*"),
        lambda: seen.assert_seen("7..#*", times=0),
    ]
    for claim in claims:
        with pytest.raises(AssertionError) as caught:
            claim()
        _, found = str(caught.value).split(":", 1)
        assert found == f"{listed}{more}\nrecording: run"
    with pytest.raises(AssertionError) as caught:
        seen.assert_seen("081#*", times=1)
    assert str(caught.value) == "0 frames 081#*, 1 expected\nrecording: run"


def test_frames_are_the_host_s_or_the_others_where_that_is_asked() -> None:
    seen = wire("701#05", "000#0101", "701#05")
    seen.frames.append(SeenFrame(Instant(9), True, 0x701, b"\x05"))
    assert [len(seen.find("7..#*", sent=sent)) for sent in (None, True, False)] == [3, 1, 2]
    seen.assert_seen("701#05", times=1, sent=True)
    seen.assert_sequence("000#*", "701#05", sent=True)
    with pytest.raises(AssertionError) as caught:
        seen.assert_sequence("701#05", "000#*", sent=True)
    assert str(caught.value) == (
        "no frame 000#* after 701#05; there are, too early:\n  0.002000 s sent 000#0101 (NMT command)"
    )
    with pytest.raises(AssertionError, match=r"^no frame 080#$"):
        seen.assert_sequence("080#")
    seen.clear()
    assert seen.frames == []
    with pytest.raises(ValueError, match="assert_sequence: no patterns given, at least one expected"):
        seen.assert_sequence()


def test_a_window_begins_with_its_first_instant_and_keeps_where_it_was() -> None:
    seen = wire("080#", "081#", "082#", "083#")
    seen.zero, seen.recording = Instant(NS_PER_MS), Path("run")
    part = seen.between(0.001, 0.003)
    assert [frame.can_id for frame in part.frames] == [0x081, 0x082]
    assert (part.zero, part.recording) == (seen.zero, seen.recording)


def test_a_controlword_counts_where_the_host_wrote_it_whole() -> None:
    words = wire(
        "201#0F000000",
        "201#0F000000",
        "581#2B40600006000000",  # an answer
        "601#2B40600106000000",  # another sub-index
        "601#4040600006000000",  # an upload
        "601#2340600007000000",  # four bytes are written, of which two are its own
        "601#",
    )
    received = SeenFrame(Instant(0), False, 0x201, bytes.fromhex("1F000000"))
    words.frames.insert(0, received)
    found = words.controlwords(1, PLAN)
    assert found == [Controlword(Instant(NS_PER_MS), 0x0F), Controlword(Instant(6 * NS_PER_MS), 0x07)]


@pytest.mark.parametrize("actuation", ["on_sync", "immediate"])
@pytest.mark.parametrize("every", [1, 7])
def test_the_plan_of_an_axis_is_that_of_its_sheet(tmp_path: Path, actuation: str, every: int) -> None:
    path = tmp_path / "drive.eds"
    path.write_text(sheet_text(four_pdos()))
    drive = BENCH.drive["axis1"].model_copy(update={"eds": str(path), "mode": "csv"})
    loop = BENCH.loop.model_copy(update={"position_every_cycles": every, "actuation": actuation})
    bench = BENCH.model_copy(update={"drive": {"axis1": drive}, "loop": loop})
    wish = PlanWish(Mode.CYCLIC_SYNCHRONOUS_VELOCITY, actuation == "on_sync", every, coherent=every == 1)
    expected = plan_pdos(capability_of(load_dictionary(path, drive.node)), drive.node, wish).plan
    assert pdo_plans(bench) == {"axis1": expected}


def test_an_axis_without_a_sheet_has_the_standard_plan() -> None:
    assert pdo_plans(BENCH) == {"axis1": standard_plan(BENCH, "axis1")}


def test_a_recorded_wire_is_read_back_in_run_time(tmp_path: Path) -> None:
    write_frames(
        tmp_path,
        "(0000000005.000100) simulated 601#4041600000000000\n"
        "(0000000005.000200) simulated 18ABCDEF#0102\n"
        "(0000000005.000300) simulated 701#R\n",
        "TRR",
    )
    writer = RecordsWriter(tmp_path / "records.arrow")
    writer.begin({"first_cycle_epoch_ns": "5000000000"}, Instant(0))
    writer.close()
    found = read_wire(tmp_path)
    assert [(frame.at, frame.sent, frame.text) for frame in found.frames] == [
        (100_000, True, "601#4041600000000000"),
        (200_000, False, "18ABCDEF#0102"),
        (300_000, False, "701#R"),
    ]
    assert (found.zero, found.recording) == (0, tmp_path)
    (tmp_path / "frames.arrow").unlink()
    (tmp_path / "frames.log").write_text("nonsense\n")
    with pytest.raises(ValueError, match="no line of a candump log") as caught:
        read_wire(tmp_path)
    assert str(caught.value).startswith(f"{tmp_path / 'frames.log'}: ")


@pytest.mark.parametrize(
    ("can_id", "data", "name"),
    [
        (0x000, b"\x01\x01", "NMT command"),
        (0x081, b"\x10\x43", "EMCY of node 1, 4310h excess temperature of the drive"),
        (0x3FF, b"", "TPDO3 of node 127"),
        (0x280, b"", "no identifier of CANopen"),
        (0x7E4, b"", "LSS answer"),
        (0x1801234, b"", "no identifier of CANopen"),
        (0x20000080, bytes(8), "error frame"),
    ],
)
def test_frames_have_names(can_id: int, data: bytes, name: str) -> None:
    assert frame_name(can_id, data) == name
