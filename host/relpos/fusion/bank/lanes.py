"""Eight hypotheses at once: a vector type for compiled kernels.

A compiler makes a loop over hypotheses into vector instructions only where it can prove that no
two arrays overlap, and gives up on most of what a filter does. Here the eight are one value: what
is written as for one number (``a * b + c``, ``sqrt``, ``exp``) is done for all of them, in single
instructions where the processor has AVX-512, in two or four with AVX2 or NEON.

``load`` and ``store`` take them from arrays whose last axis is ``LANES``, counted in such rows
from the array's beginning; no index is checked. A comparison gives a mask for ``select``.
"""

# Numba's extension interface has no types.
# mypy: disable-error-code="no-untyped-call, untyped-decorator, misc"

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from typing import Any, cast

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.extending import intrinsic, lower_builtin, models, register_model

from relpos.fusion import vectormath
from relpos.fusion.arrays import Floats
from relpos.fusion.compiled import compiled, inner

LANES = 8
"""Doubles in a vector register of AVX-512, and in a line of the cache."""

Lanes = Any
"""In annotations: eight numbers. (Operators on them are known to numba alone.)"""

_I32, _I64 = ir.IntType(32), ir.IntType(64)
_DOUBLES = ir.VectorType(ir.DoubleType(), LANES)
_BITS = ir.VectorType(ir.IntType(1), LANES)
_LONGS = ir.VectorType(_I64, LANES)
_INTS = ir.VectorType(_I32, LANES)


def blocks_of(count: int) -> int:
    """Give how many blocks of ``LANES`` hold so many hypotheses."""
    return -(-count // LANES)


@compiled
def working_lines(rows: int) -> Floats:
    """Give an empty array (rows, LANES) that begins at a line of the cache.

    Every vector that lies across two lines costs two accesses.
    """
    space = np.empty((rows + 1) * LANES)
    off = (-(space.ctypes.data // 8)) % LANES
    return space[off : off + rows * LANES].reshape(rows, LANES)


def empty_lines(*shape: int) -> Floats:
    """As ``working_lines``, of any shape (..., LANES)."""
    return working_lines(math.prod(shape)).reshape(*shape, LANES)


# -- the two types ---------------------------------------------------------------------------------


class _LanesType(types.Type):
    def __init__(self) -> None:
        super().__init__(name="Lanes")


class _MaskType(types.Type):
    def __init__(self) -> None:
        super().__init__(name="Mask")


_lanes, _mask = _LanesType(), _MaskType()


@register_model(_LanesType)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, of: Any) -> None:
        super().__init__(manager, of, _DOUBLES)


@register_model(_MaskType)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager: Any, of: Any) -> None:
        super().__init__(manager, of, _BITS)


def _spread(builder: Any, value: Any) -> Any:
    one = builder.insert_element(ir.Constant(_DOUBLES, ir.Undefined), value, ir.Constant(_I32, 0))
    return builder.shuffle_vector(
        one, ir.Constant(_DOUBLES, ir.Undefined), ir.Constant(_INTS, [0] * LANES)
    )


def _operation(one: Callable[..., object], emit: Callable[..., Any], result: Any) -> None:
    """Teach numba an operator between eight numbers, or eight and one."""
    numbers = (types.Float, types.Integer)

    class Template(AbstractTemplate):
        def generic(self, args: Any, kws: Any) -> Any:
            known = len(args) == 2 and all(a == _lanes or isinstance(a, numbers) for a in args)
            return signature(result, *args) if known and _lanes in args else None

    def lower(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        both = [
            value
            if of == _lanes
            else _spread(builder, context.cast(builder, value, of, types.float64))
            for of, value in zip(sig.args, args, strict=True)
        ]
        return emit(builder, *both)

    infer_global(one)(Template)
    for other in numbers:
        lower_builtin(one, _LanesType, other)(lower)
        lower_builtin(one, other, _LanesType)(lower)
    lower_builtin(one, _LanesType, _LanesType)(lower)


_operation(operator.add, lambda b, x, y: b.fadd(x, y), _lanes)
_operation(operator.sub, lambda b, x, y: b.fsub(x, y), _lanes)
_operation(operator.mul, lambda b, x, y: b.fmul(x, y), _lanes)
_operation(operator.truediv, lambda b, x, y: b.fdiv(x, y), _lanes)
_operation(operator.gt, lambda b, x, y: b.fcmp_ordered(">", x, y), _mask)
_operation(operator.lt, lambda b, x, y: b.fcmp_ordered("<", x, y), _mask)


def _intrinsic(made: Callable[..., Any]) -> Callable[..., Any]:
    """Teach numba a function: ``made`` gives its signature and what emits its instructions."""
    return cast(Callable[..., Any], intrinsic(made))


# -- memory ----------------------------------------------------------------------------------------


def _pointer(context: Any, builder: Any, array_type: Any, array: Any, row: Any) -> Any:
    data = context.make_array(array_type)(context, builder, value=array).data
    place = builder.gep(data, [builder.mul(row, ir.Constant(row.type, LANES))])
    return builder.bitcast(place, _DOUBLES.as_pointer())


@_intrinsic
def load(typing: Any, array: Any, row: Any) -> Any:
    """Take eight numbers: row ``row`` of an array (..., LANES)."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        place = _pointer(context, builder, sig.args[0], *args)
        return builder.load(place, typ=_DOUBLES, align=8)

    return _lanes(array, types.intp), emit


@_intrinsic
def store(typing: Any, array: Any, row: Any, value: Any) -> Any:
    """Put eight numbers into an array (..., LANES)."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        place = _pointer(context, builder, sig.args[0], args[0], args[1])
        builder.store(args[2], place, align=8)
        return context.get_dummy_value()

    return types.void(array, types.intp, _lanes), emit


@_intrinsic
def look_up(typing: Any, table: Any, index: Any) -> Any:
    """Give eight entries of a table (T,), at whole numbers within it."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        data = context.make_array(sig.args[0])(context, builder, value=args[0]).data
        whole = builder.fptosi(args[1], _LONGS)
        found = ir.Constant(_DOUBLES, ir.Undefined)
        for lane in range(LANES):
            at = ir.Constant(_I32, lane)
            place = builder.gep(data, [builder.extract_element(whole, at)])
            found = builder.insert_element(found, builder.load(place), at)
        return found

    return _lanes(table, _lanes), emit


# -- functions -------------------------------------------------------------------------------------


@_intrinsic
def fill(typing: Any, value: Any) -> Any:
    """Give eight times the same number."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _spread(builder, args[0])

    return _lanes(types.float64), emit


@_intrinsic
def select(typing: Any, mask: Any, this: Any, that: Any) -> Any:
    """Give ``this`` where the mask holds, else ``that``."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.select(*args)

    return _lanes(_mask, _lanes, _lanes), emit


@_intrinsic
def some(typing: Any, mask: Any) -> Any:
    """Whether the mask holds anywhere."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits = builder.bitcast(args[0], ir.IntType(LANES))
        return builder.icmp_unsigned("!=", bits, ir.Constant(ir.IntType(LANES), 0))

    return types.boolean(_mask), emit


def _function(name: str) -> Any:
    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        of = ir.FunctionType(_DOUBLES, [_DOUBLES])
        function = cgutils.get_or_insert_function(builder.module, of, f"llvm.{name}.v{LANES}f64")
        return builder.call(function, args)

    return emit


@_intrinsic
def sqrt(typing: Any, x: Any) -> Any:
    """Eight square roots."""
    return _lanes(_lanes), _function("sqrt")


@_intrinsic
def floor(typing: Any, x: Any) -> Any:
    """Eight whole numbers not above."""
    return _lanes(_lanes), _function("floor")


def _extreme(sign: str) -> Any:
    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.select(builder.fcmp_ordered(sign, *args), *args)

    return emit


@_intrinsic
def greater(typing: Any, x: Any, y: Any) -> Any:
    """The greater of each two; ``y`` where one is NaN."""
    return _lanes(_lanes, _lanes), _extreme(">")


@_intrinsic
def lesser(typing: Any, x: Any, y: Any) -> Any:
    """The lesser of each two; ``y`` where one is NaN."""
    return _lanes(_lanes, _lanes), _extreme("<")


@_intrinsic
def total(typing: Any, x: Any) -> Any:
    """The sum of the eight."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        rest, width = args[0], LANES
        while width > 1:
            width //= 2
            halves = [
                builder.shuffle_vector(
                    rest, ir.Constant(rest.type, ir.Undefined),
                    ir.Constant(ir.VectorType(_I32, width), list(range(begin, begin + width))),
                )
                for begin in (0, width)
            ]  # fmt: skip
            rest = builder.fadd(*halves)
        return builder.extract_element(rest, ir.Constant(_I32, 0))

    return types.float64(_lanes), emit


@_intrinsic
def _power_of_two(typing: Any, n: Any) -> Any:
    """2^n of whole numbers within the exponent's reach."""

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        # By way of 32 bits: the direct conversion to 64 is one of AVX-512's own.
        whole = builder.sext(builder.fptosi(args[0], _INTS), _LONGS)
        biased = builder.add(whole, ir.Constant(_LONGS, [1023] * LANES))
        return builder.bitcast(builder.shl(biased, ir.Constant(_LONGS, [52] * LANES)), _DOUBLES)

    return _lanes(_lanes), emit


@_intrinsic
def _exponent_and_mantissa(typing: Any, x: Any) -> Any:
    """As ``vectormath.log`` takes a number apart."""
    pair = types.UniTuple(_lanes, 2)

    def emit(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits = builder.bitcast(args[0], _LONGS)
        above = builder.sub(bits, ir.Constant(_LONGS, [vectormath.ROOT_HALF_BITS] * LANES))
        shift = ir.Constant(_LONGS, [52] * LANES)
        exponent = builder.ashr(above, shift)
        mantissa = builder.bitcast(builder.sub(bits, builder.shl(exponent, shift)), _DOUBLES)
        number = builder.sitofp(builder.trunc(exponent, _INTS), _DOUBLES)
        return context.make_tuple(builder, sig.return_type, (number, mantissa))

    return pair(_lanes), emit


@inner
def exp(x: Lanes) -> Lanes:
    """As :func:`vectormath.exp`."""
    kept = greater(x, fill(-700.0))
    n = floor(kept * vectormath.LOG2_E + 0.5)
    grown = vectormath.exp_series(vectormath.less_whole_logs(kept, n)) * _power_of_two(n)
    return select(x > -700.0, grown, fill(0.0))


@inner
def log(x: Lanes) -> Lanes:
    """As :func:`vectormath.log`."""
    e, f = _exponent_and_mantissa(x)
    return vectormath.log_series(e, f)


@inner
def cos_sin(x: Lanes) -> tuple[Lanes, Lanes]:
    """As :func:`vectormath.cos_sin`."""
    n = floor(x * vectormath.PER_QUARTER + 0.5)
    cosine, sine = vectormath.quarter_series(vectormath.less_quarters(x, n))
    quarter = n - 4.0 * floor(0.25 * n)
    odd = (quarter - 2.0 * floor(0.5 * quarter)) > 0.5
    c, s = select(odd, sine, cosine), select(odd, cosine, sine)
    off = quarter - 1.5
    return select(off * off < 1.0, 0.0 - c, c), select(quarter > 1.5, 0.0 - s, s)
