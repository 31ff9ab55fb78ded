"""A limiter nobody listens to, or one that acts where it is not made to, is refused: such a run would mean nothing."""

from __future__ import annotations

import pytest
from plants import regulated

from pgexcite.core.assemble import assemble
from pgexcite.core.config import load
from pgexcite.core.errors import AssemblyError, ConfigError
from pgexcite.plugins.exciters.constant import ConstantField
from pgexcite.plugins.exciters.sexs import SEXS
from pgexcite.plugins.exciters.st1a import ST1A
from pgexcite.plugins.limiters.oel import OEL
from pgexcite.plugins.limiters.scl import SCL
from pgexcite.plugins.limiters.uel1 import UEL1

TAKING_OVER, SUMMED = OEL(I_LIM=2.0), OEL(I_LIM=2.0, acts="summing")
REFUSED = {
    "no position": (ST1A(), {"oel": TAKING_OVER}, r"limiter.oel: drives v_oel, .* takes nowhere; set its oel_position"),
    "no position, under": (ST1A(), {"uel": UEL1()}, r"limiter.uel: drives v_uel, .* set its uel_position"),
    "a gate's at a sum": (
        ST1A(oel_position=1),
        {"oel": TAKING_OVER},
        r"made to be selected by a gate, .* has it summed",
    ),
    "a sum's at a gate": (ST1A(oel_position=3), {"oel": SUMMED}, r"made to be summed .*, .* has it selected by a gate"),
    "a gate's at a sum, under": (ST1A(uel_position=1), {"uel": UEL1()}, r"made to be selected by a gate"),
    "an exciter that sums": (SEXS(), {"oel": TAKING_OVER}, r"made to be selected by a gate"),
    "an exciter without": (ConstantField(), {"scl": SCL()}, r"drives v_scl, which this unit's exciter does not have"),
    "a gate without": (ST1A(uel_position=2), {}, r"exciter: is to have v_uel selected .* set uel_position = 0"),
    "a sum without": (ST1A(oel_position=1), {}, r"exciter: is to have v_oel summed .* set oel_position = 0"),
}


def unit(exciter, limiters):
    return regulated(exciter=exciter, **{f"limiter.{name}": limiter for name, limiter in limiters.items()})


@pytest.mark.parametrize("case", REFUSED)
def test_what_does_not_fit_is_refused(case):
    exciter, limiters, told = REFUSED[case]
    with pytest.raises(AssemblyError, match=told):
        assemble(unit(exciter, limiters))


@pytest.mark.parametrize(
    ("exciter", "limiters"),
    [
        (ST1A(), {}),
        (ST1A(oel_position=2, uel_position=3), {"oel": TAKING_OVER, "uel": UEL1(), "scl": SCL()}),
        (ST1A(oel_position=1, uel_position=1), {"oel": SUMMED, "uel": UEL1(V_UIMIN=0.0)}),
        (SEXS(), {"oel": SUMMED, "uel": UEL1(V_UIMIN=0.0), "scl": SCL()}),
    ],
)
def test_what_fits_is_assembled(exciter, limiters):
    assert assemble(unit(exciter, limiters)).x_names


def test_a_configuration_names_all_of_them_at_once(tmp_path):
    file = tmp_path / "case.toml"
    file.write_text(
        """
        simulation = {t_end = 1.0, h = 0.01}
        system = {S_base = 100.0, f_n = 50.0}
        bus = {A = {}, B = {}}
        infinite_bus.grid = {bus = "B", V = 1.0}
        [line.L]
        from = "A"
        to = "B"
        X = 0.2
        [unit.G]
        bus = "A"
        S_n = 100.0
        P = 50.0
        V = 1.0
        machine.model = "genrou"
        exciter = {model = "st1a", uel_position = 2}
        governor.model = "constant_torque"
        limiter.over = {model = "oel", I_LIM = 2.0}
        """
    )
    with pytest.raises(ConfigError) as raised:
        load(file)
    assert {problem.path for problem in raised.value.problems} == {"unit.G.limiter.over", "unit.G.exciter"}
