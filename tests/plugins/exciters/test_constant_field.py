from __future__ import annotations

import pytest
from component_harness import Bench
from pydantic import ValidationError

from pgexcite.plugins.exciters.constant import ConstantField

_SEEN = {"v_t": 1.0, "i_fd": 2.0}


@pytest.mark.parametrize(("asked", "given"), [(1.9, 1.9), (4.0, 3.2), (-4.0, -3.2), (3.2, 3.2)])
def test_ceilings(asked, given):
    bench = Bench(ConstantField(E_MIN=-3.2, E_MAX=3.2))
    assert bench(_SEEN | {"e_fd_ref": asked}).out["e_fd"] == given


def test_starts_from_what_the_machine_needs():
    known = {"e_fd": 5.0, "v_t": 1.0, "i_fd": 5.0, "t_m": 0.8}
    exciter = ConstantField(E_MAX=3.0)
    assert exciter.guess(None, known) == {"e_fd_ref": 5.0}
    point = Bench(exciter, released=True)(_SEEN | exciter.guess(None, known))
    assert point.out["e_fd"] == 5.0
    assert point.limits["field voltage"] == (5.0, -1000.0, 3.0)


def test_crossed_ceilings_are_refused():
    with pytest.raises(ValidationError, match=r"E_MIN = 4.0 must be below E_MAX = 3.0"):
        ConstantField(E_MIN=4.0, E_MAX=3.0)
