"""The count of instructions: whose they are, and which rise ends with which status."""

import pytest

from tests.benchmarks.instructions import by_owner, compare

PROFILE = """\
version: 1
positions: line
events: Ir

ob=(1) /usr/lib/libpython3.11.so.1.0
fn=(1) call
12 2000
cob=(2) /there/drivers/compiled_wire__mypyc.cpython-311-x86_64-linux-gnu.so
cfn=(2) receive
calls=5 0
+1 900000

ob=(2)
fn=(2)
0 3000
* 4000

ob=(3) ???
fn=(3) 0x0000000006596000
0 5000

totals: 14000
"""


def test_an_owner_has_its_own_instructions_and_not_those_of_what_it_calls() -> None:
    assert by_owner(PROFILE) == {"compiled wire": 7, "code made at run time": 5, "libpython": 2}


@pytest.mark.parametrize(
    ("rise", "made_with", "status"),
    [(29, "this Python", 0), (31, "this Python", 1), (31, "another", 0), (-500, "this Python", 0)],
)
def test_a_rise_above_three_per_cent_with_the_same_interpreter_fails(
    rise: int, made_with: str, status: int, capsys: pytest.CaptureFixture[str]
) -> None:
    kept = {"made with": "this Python", "instructions a cycle": {"1 axis": {"libpython": 600, "libc": 400}}}
    assert compare({"1 axis": {"libpython": 600 + rise, "libc": 400}}, made_with, kept) == status
    printed = capsys.readouterr().out
    assert f"{rise / 1000:+.2%}" in printed
    assert ("made with this Python" in printed) == (made_with == "another")
