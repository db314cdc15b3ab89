"""Sixteen float32 numbers that compiled code handles as one: the small solves of sixteen pairs.

Plain loops with fastmath, the best of three arrangements for each row, took 1.2 × as long for
points and 1.5 to 2.3 × for pairs of subspaces with m = 16 (interleaved medians, 512 to 1024 rows of
products): LLVM's vectoriser cannot keep sums of several arrays in registers. The compiler splits a
vector where the processor's are shorter, so the code runs everywhere.

Compiled kernels are cached by the text of their own file. After a change in this one, or of a
number in ``metric.py``, the caches are stale: ``make clean``.
"""

import operator
from collections.abc import Callable
from typing import Any, TypeVar, cast

import numpy as np
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.extending import intrinsic, models, overload, register_model

LANES = 16
ALL = 0xFFFF
"""The bits of all lanes."""
OVERFLOW = np.float32(1e38)
"""A square that is not below this may be infinite."""

Lanes = Any
"""Sixteen float32 numbers, in signatures of compiled functions."""
FourLanes = tuple[Lanes, Lanes, Lanes, Lanes]

_FLOATS = ir.VectorType(ir.FloatType(), LANES)
_FLAGS = ir.VectorType(ir.IntType(1), LANES)
_BITS = ir.IntType(LANES)
_ALIGNMENT = 4
_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}

_Function = TypeVar("_Function", bound=Callable[..., Any])


def compiled(function: _Function, **options: Any) -> _Function:
    """Compile on the first call, without the interpreter's lock, and keep the result on disk.

    Division by zero gives infinity, as in NumPy. Where no folder can be written (a read-only
    installation without a home), every process compiles anew.
    """
    options |= _OPTIONS
    try:
        return cast(_Function, njit(cache=True, **options)(function))
    except RuntimeError:
        return cast(_Function, njit(**options)(function))


def inlined(function: _Function) -> _Function:
    """Compile as a part of its callers: a call costs as much as a small solve."""
    return cast(_Function, njit(forceinline=True, **_OPTIONS)(function))


def _primitive(function: Callable[..., Any]) -> Any:
    return intrinsic(function)


class LanesType(types.Type):
    """The compiler's type of sixteen float32 numbers."""

    def __init__(self) -> None:
        super().__init__(name="Lanes")


_LANES = LanesType()


@register_model(LanesType)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, frontend: Any) -> None:
        super().__init__(manager, frontend, _FLOATS)  # type: ignore[no-untyped-call]


def _address(context: Any, builder: Any, kind: Any, array: Any, index: Any) -> Any:
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), _FLOATS.as_pointer())


@_primitive
def load(typing: Any, array: Any, index: Any) -> Any:
    """Numbers ``index`` to ``index + 15`` of a flat, contiguous float32 array."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        numbers = builder.load(_address(context, builder, signature.args[0], *arguments))
        numbers.align = _ALIGNMENT
        return numbers

    return _LANES(array, types.intp), generate


@_primitive
def store(typing: Any, array: Any, index: Any, value: Any) -> Any:
    """Write sixteen numbers of a flat, contiguous float32 array."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        place = _address(context, builder, signature.args[0], *arguments[:2])
        builder.store(arguments[2], place).align = _ALIGNMENT
        return context.get_dummy_value()

    return types.none(array, types.intp, _LANES), generate


def _spread(builder: Any, value: Any, kind: Any) -> Any:
    """The same number in all lanes."""
    undefined = ir.Constant(ir.VectorType(kind, LANES), ir.Undefined)
    first = builder.insert_element(undefined, value, ir.Constant(ir.IntType(32), 0))
    order = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
    return builder.shuffle_vector(first, undefined, order)


@_primitive
def every(typing: Any, value: Any) -> Any:
    """The same float32 number in all lanes."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return _spread(builder, arguments[0], ir.FloatType())

    return _LANES(types.float32), generate


def _called(name: str, count: int) -> Any:
    """Wrap an LLVM intrinsic function of ``count`` vectors."""

    @_primitive
    def one(typing: Any, a: Any) -> Any:
        return _LANES(_LANES), generate

    @_primitive
    def two(typing: Any, a: Any, b: Any) -> Any:
        return _LANES(_LANES, _LANES), generate

    @_primitive
    def three(typing: Any, a: Any, b: Any, c: Any) -> Any:
        return _LANES(_LANES, _LANES, _LANES), generate

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        kind = ir.FunctionType(_FLOATS, [_FLOATS] * count)
        title = f"llvm.{name}.v{LANES}f32"
        function: Any = cgutils.get_or_insert_function  # untyped
        return builder.call(function(builder.module, kind, title), arguments)

    return {1: one, 2: two, 3: three}[count]


root = _called("sqrt", 1)
"""Square root."""
smaller = _called("minnum", 2)
larger = _called("maxnum", 2)
"""The larger number; the other one where one is NaN."""
fma = _called("fma", 3)
"""a · b + c, rounded once."""


@_primitive
def less(typing: Any, a: Any, b: Any) -> Any:
    """Which lanes have a < b, as the bits of an integer; none where one is NaN."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        flags = builder.fcmp_ordered("<", *arguments)
        return builder.zext(builder.bitcast(flags, _BITS), ir.IntType(64))

    return types.int64(_LANES, _LANES), generate


@_primitive
def blend(typing: Any, bits: Any, chosen: Any, other: Any) -> Any:
    """``chosen`` in the lanes whose bit is set, ``other`` elsewhere."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        flags = builder.bitcast(builder.trunc(arguments[0], _BITS), _FLAGS)
        return builder.select(flags, *arguments[1:])

    return _LANES(types.int64, _LANES, _LANES), generate


def _operator(name: str) -> Any:
    @_primitive
    def apply(typing: Any, a: Any, b: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
            return getattr(builder, name)(*arguments)

        return _LANES(_LANES, _LANES), generate

    def choose(a: Any, b: Any) -> Any:
        def both(a: Any, b: Any) -> Any:
            return apply(a, b)

        return both if isinstance(a, LanesType) and isinstance(b, LanesType) else None

    return choose


overload(operator.add)(_operator("fadd"))
overload(operator.sub)(_operator("fsub"))
overload(operator.mul)(_operator("fmul"))
overload(operator.truediv)(_operator("fdiv"))


@_primitive
def take(typing: Any, counter: Any) -> Any:
    """Return the one number of an int64 array and add 1 to it, in one step for all threads."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        data = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        one = ir.Constant(ir.IntType(64), 1)
        return builder.atomic_rmw("add", data, one, "monotonic")

    return types.int64(counter), generate


@_primitive
def put(typing: Any, array: Any, index: Any, count: Any, value: Any) -> Any:
    """Write the first ``count`` lanes, or all where there are more, as :func:`store` does."""

    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        place = _address(context, builder, signature.args[0], *arguments[:2])
        lanes = ir.Constant(ir.VectorType(ir.IntType(64), LANES), list(range(LANES)))
        wanted = builder.icmp_signed("<", lanes, _spread(builder, arguments[2], ir.IntType(64)))
        kind = ir.FunctionType(
            ir.VoidType(), [_FLOATS, _FLOATS.as_pointer(), ir.IntType(32), _FLAGS]
        )
        function: Any = cgutils.get_or_insert_function  # untyped
        write = function(builder.module, kind, f"llvm.masked.store.v{LANES}f32.p0")
        alignment = ir.Constant(ir.IntType(32), _ALIGNMENT)
        builder.call(write, [arguments[3], place, alignment, wanted])
        return context.get_dummy_value()

    return types.none(array, types.intp, types.intp, _LANES), generate


@inlined
def fma4(array: Any, place: int, step: int, x: Lanes, sums: FourLanes) -> FourLanes:
    """Add x times four vectors of an array, ``step`` numbers apart, to four sums."""
    s0, s1, s2, s3 = sums
    return (
        fma(load(array, place), x, s0),
        fma(load(array, place + step), x, s1),
        fma(load(array, place + 2 * step), x, s2),
        fma(load(array, place + 3 * step), x, s3),
    )


@inlined
def store4(array: Any, place: int, step: int, values: FourLanes) -> None:
    """Write four vectors, ``step`` numbers apart."""
    s0, s1, s2, s3 = values
    store(array, place, s0)
    store(array, place + step, s1)
    store(array, place + 2 * step, s2)
    store(array, place + 3 * step, s3)
