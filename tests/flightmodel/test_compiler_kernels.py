"""What is left out of numba's compiler changes no answer."""

import operator
import os

import numba
import numpy as np
import pytest
from numba.core import compiler as numba_compiler
from numba.core import ir
from numba.core.types.functions import BaseFunction

from flightmodel import _compiler_kernels as compiler
from flightmodel._kernels import Part, inlined

pytestmark = pytest.mark.skipif("NUMBA_DISABLE_JIT" in os.environ, reason="about the compiler itself")


@inlined
def share(a, k, count):
    return a[k % len(a)] * k / count if k > 1 and count != 0 else -a[0]


@inlined
def filled(a, k, flag):
    a[k] = share(a, k, 7) + share(a, 2 * k, 3) + (1 if flag else 0.5)
    return a[k] // 1.0 + (k << 2) ** 2


def several(a, n):
    total = 0.0
    for k in range(n):
        total += filled(a, k, k % 2 == 0)
    return total


def written_out(a, n):
    total = 0.0
    for k in range(n):
        a[k] = a[n - 1 - k] * k / 3 + (1 if k > 2 and a[k] != 0 else 0.5)
        total += a[k] // 0.125 + (k << 2) ** 2 + total * 0.5
    return total


def test_parts_in_a_kernel_do_what_they_do_alone():
    inside, alone = np.linspace(1.0, 2.0, 6), np.linspace(1.0, 2.0, 6)
    assert numba.njit(error_model="numpy")(several)(inside, 6) == pytest.approx(several(alone, 6), rel=1e-14)
    np.testing.assert_allclose(inside, alone, rtol=1e-14)
    assert isinstance(share, Part)
    assert len(share.overloads) == 1  # though it is called with two constants


def test_operators_are_looked_up_once_and_mean_the_same(monkeypatch):
    looked_up = []
    plain = BaseFunction.get_call_type

    def counted(self, context, args, kws):
        looked_up.append(self.typing_key)
        return plain(self, context, args, kws)

    monkeypatch.setattr(BaseFunction, "get_call_type", counted)
    arrays = [np.linspace(1.0, 2.0, 6) for _ in range(3)]
    every_time = numba.njit(written_out)(arrays[0], 6)
    before, looked_up[:] = looked_up.count(operator.getitem), []
    compiler.remember_operators()
    once = numba.njit(written_out)(arrays[1], 6)
    assert looked_up.count(operator.getitem) < before
    assert once == every_time == pytest.approx(written_out(arrays[2], 6), rel=1e-14)
    np.testing.assert_array_equal(arrays[0], arrays[1])


def test_variables_are_listed_as_numba_lists_them(monkeypatch):
    function = numba_compiler.run_frontend(written_out)
    statements = [statement for block in function.blocks.values() for statement in block.body]
    before = [statement.list_vars() for statement in statements]
    nested = {"a": [before[0], ("text", None, {"b": before[-1]})], "c": 1}
    listed = statements[0]._rec_list_vars(nested)
    monkeypatch.setattr(ir.Inst, "_rec_list_vars", ir.Inst._rec_list_vars)  # put back afterwards
    compiler.list_variables_by_type()
    assert [statement.list_vars() for statement in statements] == before
    assert statements[0]._rec_list_vars(nested) == listed == before[0] + before[-1]
    assert sum(map(len, before)) > 20
