"""Node ids and serial numbers as they are typed, and what is said of those that are none."""

import pytest

from servobench.drivers.errors import MISSING, BadInput
from servobench.hil.terminal.options import drive_ids, node_ids, serial_numbers


def refusal(call: object, *arguments: object) -> tuple[object, ...]:
    assert callable(call)
    with pytest.raises(BadInput) as caught:
        call(*arguments)
    bad = caught.value
    return bad.source, bad.key, bad.value, bad.expected, bad.remedy


@pytest.mark.parametrize(
    ("texts", "nodes"),
    [
        (["1"], [1]),
        (["127"], [127]),
        (["1,2,5"], [1, 2, 5]),
        (["5, 2", "1"], [5, 2, 1]),
        (["1-3"], [1, 2, 3]),
        (["7-7"], [7]),
        (["126-127", "3-4"], [126, 127, 3, 4]),
        (["001"], [1]),
        (["unconfigured"], [255]),
        (["255"], [255]),
        (["unconfigured:1"], [255]),
        (["255:3,2"], [255, 255, 255, 2]),
        (["unconfigured:127"], [255] * 127),
    ],
)
def test_node_ids_are_told_one_by_one_as_lists_and_as_ranges(texts: list[str], nodes: list[int]) -> None:
    assert node_ids(texts) == nodes
    if 255 not in nodes:
        assert drive_ids(texts) == nodes


ONE = "a node id 1..127, a list 1,2 or a range 1-3"
WITHIN = "node ids within 1..127, the smaller first"
MANY = "how many nodes without id, 1..127: unconfigured:3"


@pytest.mark.parametrize(
    ("text", "value", "expected"),
    [
        ("", "", ONE),
        ("x", "x", ONE),
        ("-1", "-1", ONE),
        ("1-", "1-", ONE),
        ("1-x", "1-x", ONE),
        ("1,,2", "", ONE),
        ("0", "0", WITHIN),
        ("128", "128", WITHIN),
        ("254", "254", WITHIN),
        ("0-3", "0-3", WITHIN),
        ("3-2", "3-2", WITHIN),
        ("126-128", "126-128", WITHIN),
        ("1" * 9, "1" * 9, WITHIN),
        ("0" * 9 + "1", "0" * 9 + "1", WITHIN),  # of ten digits none is looked at
        ("unconfigured:", "unconfigured:", MANY),
        ("unconfigured:0", "unconfigured:0", MANY),
        ("unconfigured:128", "unconfigured:128", MANY),
        ("unconfigured:x", "unconfigured:x", MANY),
        ("255:-1", "255:-1", MANY),
        ("3,2,3", 3, "each node id once"),
        ("1-3,2", 2, "each node id once"),
    ],
)
def test_what_is_no_node_id_is_refused(text: str, value: str | int, expected: str) -> None:
    for call in (node_ids, drive_ids):
        assert refusal(call, [text]) == ("--node", "", value, expected, "")
    assert refusal(node_ids, [text], "--load") == ("--load", "", value, expected, "")


def test_at_least_one_node_is_needed_and_a_drive_has_an_id() -> None:
    expected = "a node id 1..127, e.g. --load 1 or --load 1-3"
    assert refusal(node_ids, [], "--load") == ("--load", "", MISSING, expected, "")
    assert refusal(drive_ids, ["1,255"]) == (
        "--node", "", "unconfigured", "a node id 1..127", "hil scan --assign gives one"
    )  # fmt: skip


@pytest.mark.parametrize(
    ("texts", "numbers"),
    [
        ([], []),
        (["0"], [0, 1]),
        (["0xff"], [255, 256]),
        (["0XFF, 7"], [255, 7]),
        (["9", "3"], [9, 3]),
        (["4294967294"], [0xFFFF_FFFE, 0xFFFF_FFFF]),
        (["000000000012"], [12, 13]),
    ],
)
def test_serial_numbers_of_two_devices(texts: list[str], numbers: list[int]) -> None:
    assert serial_numbers(texts, 2) == numbers


NUMBER = "serial numbers 0..4294967295, decimal or with 0x"


@pytest.mark.parametrize("text", ["", "x", "-1", "4294967296", "0x100000000", "0000000000012", "ff"])
def test_what_is_no_serial_number_is_refused(text: str) -> None:
    assert refusal(serial_numbers, [text], 1) == ("--serial", "", text, NUMBER, "")
    assert refusal(serial_numbers, ["1", text], 2) == ("--serial", "", text, NUMBER, "")


def test_counting_up_ends_with_the_last_serial_number() -> None:
    assert refusal(serial_numbers, ["4294967295"], 2) == ("--serial", "", "4294967296", NUMBER, "")


@pytest.mark.parametrize(("texts", "count"), [(["1,2"], 3), (["1,2", "3"], 2), (["5,5"], 2), (["1,2"], 1)])
def test_serial_numbers_are_as_many_as_devices_each_once(texts: list[str], count: int) -> None:
    expected = f"a serial number for each of {count} nodes, each once; or one"
    assert refusal(serial_numbers, texts, count) == ("--serial", "", ",".join(texts), expected, "")
