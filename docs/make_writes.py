"""Write docs/writes.md, what each command writes to a drive: ``python docs/make_writes.py``."""

from collections.abc import Iterator
from pathlib import Path

from servobench.drivers.canopen.write_list import ListedWrite
from servobench.hil.write_lists import COMMANDS

PAGE = Path(__file__).with_name("writes.md")
_HEAD = """\
# What is written to a drive

By SDO a command writes the objects of this table and no other. Every request of the master passes one
place, which knows the list of its command: an object that is not listed ends the command before a frame is
sent. The table is made from the lists themselves, by `python docs/make_writes.py`; a test holds the page
against them.

2000h to 5FFFh belong to the maker of a drive (CiA 301): one index means another thing in each make. Such an
object is written only after 1018h and 1008h have said that the drive is the product named with it. That is
today the simulated drive, whose load machine is 2100h, and for `hil phase` and `hil tune` a drive whose
maker's file in `drivers/vendors` has a table `[commutation]` or `[gains]`: the objects named there.

`hil params load` and `clone` write the parameters that the file or the other drive names, 2000h to 5FFFh too,
beside 6040h and, with `--store`, 1010h; 1018h has said before that the drive is the file's.

`hil restore`, and the end of `hil commission`, `hil jog`, `hil homing`, `hil brake`, `hil phase`,
`hil tune` and
`hil measure`, put back what the journal names, but for what `--apply` keeps; of the other objects they write
6040h and 1003h alone. A drive file's `[[object]]` may name an object of the list of `hil run`. `hil eds`,
`hil motor`, `hil trace` and `hil scan` write nothing; `hil scan --assign` gives node-IDs by LSS.

A fixture of pytest has the objects of the set-up and those of profile moves and homing (607Ch, 6081h,
6083h, 6084h, 6087h, 6098h to 609Ah). `rig.allow_write(index, sub)` adds one that the test itself writes.
A `CanopenNetwork` that is made without a list writes nothing.

Beside SDO a drive gets NMT commands, SYNC, heartbeat or guarding, and its RPDOs: controlword and set-point.
Where a drive's mapping is fixed and carries further objects, the RPDO holds for them what the drive held
when it was set up.

"""


def main() -> None:
    """Command line."""
    PAGE.write_text(page(), encoding="utf-8")


def page() -> str:
    """The page as it is to be."""
    return _HEAD + "\n".join(_lines()) + "\n"


def _lines() -> Iterator[str]:
    commands: dict[ListedWrite, list[str]] = {}
    for command, writes in COMMANDS.items():
        for write in writes:
            commands.setdefault(write, []).append(command)
    yield "| object | name | why | when | commands |"
    yield "|---|---|---|---|---|"
    for write in sorted(commands, key=lambda each: (each.indices.start, each.subs, each.when)):
        name = write.name if write.product is None else f"{write.name} of the {write.product.device_name}"
        yield f"| {write.objects} | {name} | {write.why} | {write.when} | {', '.join(commands[write])} |"


if __name__ == "__main__":
    main()
