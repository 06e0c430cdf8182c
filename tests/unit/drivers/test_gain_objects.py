"""The gains of a drive's own loops, as the files of makers tell them; numbers by hand."""

from itertools import pairwise

import pytest

from servobench.drivers.errors import BadInput
from servobench.drivers.vendors.families import gains_for, known_families, read_family
from servobench.drivers.vendors.gain_objects import LOOPS, LoopGains

MAXON, NOVANTA, NANOTEC = 0xFB, 0x29C, 0x26C
HEAD = 'vendor = 1\n[gains]\nsource = "here"\n[gains.speed]\n'


def loop(text: str, name: str = "speed") -> LoopGains:
    gains = read_family(HEAD + text, "x.toml").gains
    assert gains is not None
    return gains.loops[name]


def test_a_maker_s_raw_values_are_gains_in_si_units_and_back() -> None:
    """maxon's EPOS4 as delivered: 1171880 uV/A and 3906250 uV/(A ms), 20000 uA s/rad and 500000 uA/rad."""
    gains = gains_for(MAXON, 0, "EPOS4")
    assert gains is not None
    current, speed = gains.loops["current"], gains.loops["speed"]
    held = current.parallel({"p": 1171880, "i": 3906250})
    assert held == pytest.approx({"p": 1.17188, "i": 3906.25, "d": 0.0})
    assert current.raw({"p": 1.17188, "i": 3906.25}) == {"p": 1171880, "i": 3906250}
    assert speed.parallel({"p": 20000, "i": 500000}) == pytest.approx({"p": 0.02, "i": 0.5, "d": 0.0})
    assert (current.unit_of("p"), current.unit_of("i"), speed.unit_of("i")) == ("V/A", "V/(A s)", "A/rad")
    assert (current.rate_hz, speed.rate_hz) == (25000, 2500)


def test_an_ideal_form_is_multiplied_out() -> None:
    text = 'form = "ideal"\noutput = "torque"\n'
    objects = (
        f'{key} = {{ index = {place}, type = "REAL32", unit = 1 }}\n' for place, key in enumerate("pid", 1)
    )
    ideal = loop(text + "".join(objects))
    assert ideal.parallel({"p": 2.0, "i": 5.0, "d": 0.5}) == {"p": 2.0, "i": 10.0, "d": 1.0}
    assert ideal.raw({"p": 2.0, "i": 10.0, "d": 1.0}) == {"p": 2.0, "i": 5.0, "d": 0.5}
    with pytest.raises(ValueError, match="without P"):
        ideal.raw({"p": 0.0, "i": 1.0})
    assert (ideal.unit_of("p"), ideal.unit_of("i"), ideal.unit_of("d")) == ("N m s/rad", "1/s", "s")


def test_what_is_not_told_is_not_computed() -> None:
    nanotec = gains_for(NANOTEC, 0, "CL4-E-2-12")
    novanta = gains_for(NOVANTA, 0x2C12001, "")
    assert nanotec is not None
    assert novanta is not None
    for each in (nanotec.loops["speed"], novanta.loops["current"]):
        assert each.lack
        with pytest.raises(ValueError, match="no public document"):
            each.raw({"p": 1.0, "i": 1.0})
    assert novanta.loops["speed"].objects["p"].value(1.0) == pytest.approx(0.159155)
    assert gains_for(NOVANTA, 1, "EMCL") is None, "a drive with the EMCL registers has other objects there"


def test_one_current_p_for_both_axes_is_written_into_both() -> None:
    sheet = gains_for(0, 0x10402, "servobench")
    assert sheet is not None
    current = sheet.loops["current"]
    assert current.raw({"p": 2.0, "i": 100.0}) == {"p": 2.0, "p_d": 2.0, "i": 100.0}
    with pytest.raises(ValueError, match="differential"):
        current.raw({"p": 2.0, "d": 1.0})


def test_raw_values_stay_within_their_type() -> None:
    narrow = loop(
        'form = "parallel"\noutput = "torque"\np = { index = 8192, type = "UNSIGNED8", unit = 0.1 }\n'
    )
    assert narrow.raw({"p": 2.04})["p"] == 20
    assert (narrow.raw({"p": 1000.0})["p"], narrow.raw({"p": -1.0})["p"]) == (255, 0)
    gain = narrow.objects["p"]
    assert (gain.data(20), gain.raw(b"\x14\x00"), gain.octets) == (b"\x14", 20, 1)
    with pytest.raises(ValueError, match="no octet"):
        gain.raw(b"")


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ('[gains]\nsource = ""\n', "gains.source"),
        ('[gains]\nsource = "here"\n[gains.torque]\n', "gains.torque"),
        ('[gains]\nsource = "here"\n[gains.speed]\nform = "serial"\n', "gains.speed.form"),
        ('[gains]\nsource = "here"\n[gains.speed]\noutput = "speed"\n', "gains.speed.output"),
        ('[gains]\nsource = "here"\n[gains.speed]\nrate_hz = 0\n', "gains.speed.rate_hz"),
        ('[gains]\nsource = "here"\n[gains.speed]\nq = 1\n', "gains.speed.q"),
        ('[gains]\nsource = "here"\n[gains.speed]\np = { sub = 1 }\n', "gains.speed.p.index"),
        ('[gains]\nsource = "here"\n[gains.speed]\np = { index = 1, type = "BOOL" }\n', "gains.speed.p.type"),
        (
            '[gains]\nsource = "here"\n[gains.speed]\np = { index = 1, type = "REAL32", unit = -1 }\n',
            "gains.speed.p.unit",
        ),
    ],
)
def test_a_table_that_cannot_be_is_refused_by_its_key(text: str, key: str) -> None:
    with pytest.raises(BadInput) as caught:
        read_family(f"vendor = 1\n{text}", "bad.toml")
    assert caught.value.key == key


def test_no_object_of_a_family_has_two_gains() -> None:
    families = [family for family in known_families() if family.gains is not None]
    assert len(families) >= 6
    for family in families:
        assert family.gains is not None
        assert family.gains.loops.keys() <= LOOPS.keys()
        places = sorted((each.index, each.sub) for each in family.gains)
        assert all(one != other for one, other in pairwise(places)), family.name
