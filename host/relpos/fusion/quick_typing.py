"""What spares numba's type inference most of its searching; no kernel gets other types by it.

Numba tries its rules for an operator one after another, those for sets, strings and ufuncs among
them, and most take half a millisecond to find that they do not apply: over all kernels a sixth of
the time to compile. Rules for one processor's kind of target are tried before the general ones:
those here are of that kind, and say of plain numbers and arrays what numba's own would say.
"""

# Numba's extension interface has no types.
# mypy: disable-error-code="no-untyped-call, untyped-decorator, misc"

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping
from typing import Any

from numba.core import types
from numba.core.typing.arraydecl import GetItemBuffer, SetItemBuffer
from numba.core.typing.templates import AbstractTemplate, infer_global, signature

FIRST: dict[Any, Any] = {"target": "cpu"}
"""Metadata of a rule that is tried before the general ones."""

_ARITHMETIC = (
    operator.add, operator.sub, operator.mul, operator.iadd, operator.isub, operator.imul,
)  # fmt: skip
_DIVISIONS = (operator.truediv, operator.itruediv)
_COMPARISONS = (
    operator.lt, operator.le, operator.gt, operator.ge, operator.eq, operator.ne,
)  # fmt: skip


def _numbers_first(
    operators: tuple[Callable[..., object], ...], results: Mapping[Any, Any]
) -> None:
    """Two numbers of a type that ``results`` names give its result; others are numba's."""

    class Template(AbstractTemplate):
        metadata = FIRST

        def generic(self, args: Any, kws: Any) -> Any:
            of, *rest = args
            return signature(results[of], *args) if rest == [of] and of in results else None

    for one in operators:
        infer_global(one)(type(f"Numbers_{one.__name__}", (Template,), {}))


_numbers_first(_ARITHMETIC, {types.float64: types.float64, types.int64: types.int64})
_numbers_first(_DIVISIONS, {types.float64: types.float64})
_numbers_first(_COMPARISONS, {types.float64: types.boolean, types.int64: types.boolean})


@infer_global(operator.getitem)
class _TakeFirst(GetItemBuffer):
    metadata = FIRST


@infer_global(operator.setitem)
class _PutFirst(SetItemBuffer):
    metadata = FIRST
