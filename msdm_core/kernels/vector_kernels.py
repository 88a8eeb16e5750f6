"""Vector registers for numba: a type of LLVM vectors, their arithmetic, loads, stores and shuffles.

numba does not vectorise the organ's loops by itself: they gather and scatter, and short loops over lanes are unrolled
before LLVM's vectoriser. Here four springs, or the springs of eight organs, are one value. LLVM splits a vector wider
than the machine's registers, so the same code runs, to the same bits, on any machine.

A kernel of `+ - * /`, `root`, `keep_lower`, `below_zero` and `any_below` takes numbers and vectors alike: the equations
of springs and tets stand once, in `element_kernels.py`.
"""

import math
import operator
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import extending, types
from numba.core import cgutils
from numba.core.datamodel.models import PrimitiveModel
from numba.core.registry import cpu_target
from numba.core.typing.templates import AbstractTemplate, infer_global
from numba.extending import lower_builtin, register_model
from numpy.typing import NDArray

# Untyped: calls lack the typing context of an intrinsic's definition.
intrinsic: Any = extending.intrinsic

# Size of the widest registers, and of a line of the cache [bytes].
REGISTER_SIZE = 64
# Springs or tets of an organ alone in a vector. As many as numbers in a row, so that rows turn into vectors and back
# with the fewest shuffles; eight took 20 % longer with AVX2, as they overflow its 16 registers, and 9 % longer with
# AVX-512.
GROUP = 4
# By features of the processor, the widest first; 128 without them.
_REGISTER_BITS = {"avx512f": 512, "avx2": 256, "avx": 256}
# No fusing of products and sums: the same bits on every machine, for numbers and for vectors of any width.
FLAGS = ()


class VectorType(types.Type):
    """Several floats in one register."""

    def __init__(self, element: Any, width: int) -> None:
        self.element = element
        self.width = width
        super().__init__(f"vector({element} x {width})")


@register_model(VectorType)
class VectorModel(PrimitiveModel):
    """LLVM's own vector."""

    def __init__(self, manager: Any, kind: VectorType) -> None:
        element = ir.DoubleType() if kind.element == types.float64 else ir.FloatType()
        super().__init__(manager, kind, ir.VectorType(element, kind.width))


def lane_counts(dtype: Any) -> tuple[int, ...]:
    """Possible numbers of lanes of a numpy type: a full register first, then half a register."""
    return (8,) if np.dtype(dtype) == np.float64 else (16, 8)


def register_bits() -> int:
    """Width of the widest vector registers for compiled code [bits].

    NUMBA_CPU_NAME and NUMBA_CPU_FEATURES decide; without them, the processor.
    """
    context: Any = cpu_target.target_context
    features = context.codegen().magic_tuple()[2].split(",")
    return next((bits for name, bits in _REGISTER_BITS.items() if f"+{name}" in features), 128)


def aligned_zeros(shape: tuple[int, ...], dtype: Any = np.float64) -> NDArray[Any]:
    """Zeros aligned to registers; a load across two cache lines costs up to a third."""
    count = math.prod(shape) * np.dtype(dtype).itemsize
    raw = np.zeros(count + REGISTER_SIZE, dtype=np.uint8)
    start = -raw.ctypes.data % REGISTER_SIZE
    return raw[start : start + count].view(dtype).reshape(shape)


# ---- arithmetic ---------------------------------------------------------------------------------------------------


def _spread(builder: ir.IRBuilder, value: Any, kind: ir.VectorType) -> Any:
    """Vector with a number in each place."""
    empty = ir.Constant(kind, ir.Undefined)
    first = builder.insert_element(empty, value, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(
        first, empty, ir.Constant(ir.VectorType(ir.IntType(32), kind.count), [0] * kind.count)
    )


def _operand(context: Any, builder: ir.IRBuilder, value: Any, kind: Any, vector: VectorType) -> Any:
    if isinstance(kind, VectorType):
        return value
    number = context.cast(builder, value, kind, vector.element)
    return _spread(builder, number, context.get_value_type(vector))


def _common(a: Any, b: Any) -> VectorType | None:
    """Vector type of an operation on a vector and a vector or number; None for others."""
    if isinstance(a, VectorType):
        return a if a == b or isinstance(b, types.Number) else None
    return b if isinstance(b, VectorType) and isinstance(a, types.Number) else None


def _define_operator(function: Callable[..., Any], instruction: str) -> None:
    """Extend numba's own operator to vectors; an `overload` would compile a function for each pair of types."""

    @infer_global(function)  # pyright: ignore[reportOptionalCall]
    class _VectorOperator(AbstractTemplate):
        def generic(self, operands: Any, named: Any) -> Any:
            vector = None if named or len(operands) != 2 else _common(*operands)
            return None if vector is None else vector(*operands)

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, values: Any) -> Any:
        pair = [
            _operand(context, builder, value, kind, signature.return_type)
            for value, kind in zip(values, signature.args, strict=True)
        ]
        return getattr(builder, instruction)(*pair, flags=FLAGS)

    for kinds in ((VectorType, VectorType), (VectorType, types.Number), (types.Number, VectorType)):
        lower_builtin(function, *kinds)(generate)


for _function, _instruction in (
    (operator.add, "fadd"),
    (operator.sub, "fsub"),
    (operator.mul, "fmul"),
    (operator.truediv, "fdiv"),
):
    _define_operator(_function, _instruction)


@intrinsic
def root(_typing: Any, value: Any) -> Any:
    """Square root of a number or of each number of a vector, correctly rounded."""
    vector = isinstance(value, VectorType)

    def generate(_context: Any, builder: ir.IRBuilder, _signature: Any, values: Any) -> Any:
        kind = values[0].type
        element = kind.element if vector else kind
        name = f"llvm.sqrt.{f'v{kind.count}' if vector else ''}{'f64' if element == ir.DoubleType() else 'f32'}"
        return builder.call(cgutils.get_or_insert_function(builder.module, ir.FunctionType(kind, [kind]), name), values)

    return value(value), generate


@intrinsic
def keep_lower(_typing: Any, new: Any, old: Any, of_new: Any, of_old: Any) -> Any:
    """Entry by entry `of_old` for old <= new, else `of_new`, so also for a new value of nan."""

    def generate(_context: Any, builder: ir.IRBuilder, _signature: Any, values: Any) -> Any:
        return builder.select(builder.fcmp_ordered(">=", values[0], values[1]), values[3], values[2])

    return of_new(new, old, of_new, of_old), generate


@intrinsic
def below_zero(_typing: Any, value: Any) -> Any:
    """Entry by entry min(value, 0)."""

    def generate(_context: Any, builder: ir.IRBuilder, _signature: Any, values: Any) -> Any:
        zero = ir.Constant(values[0].type, [0.0] * value.width if isinstance(value, VectorType) else 0.0)
        return builder.select(builder.fcmp_ordered("<", values[0], zero), values[0], zero)

    return value(value), generate


@intrinsic
def any_below(_typing: Any, value: Any, limit: Any) -> Any:
    """True if a number, or any number of a vector, is below a limit."""

    def generate(context: Any, builder: ir.IRBuilder, _signature: Any, values: Any) -> Any:
        if not isinstance(value, VectorType):
            return builder.fcmp_ordered("<", values[0], context.cast(builder, values[1], limit, value))
        is_below = builder.fcmp_ordered("<", values[0], _operand(context, builder, values[1], limit, value))
        bits = ir.IntType(value.width)
        return builder.icmp_unsigned("!=", builder.bitcast(is_below, bits), bits(0))

    return types.boolean(value, limit), generate


# ---- memory -------------------------------------------------------------------------------------------------------


def _pointer(context: Any, builder: ir.IRBuilder, kind: Any, array: Any, index: Any, vector: VectorType) -> Any:
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [index]), context.get_value_type(vector).as_pointer())


def _define_load(width_of: Callable[[Any], int], scale: Callable[[int], int]) -> Any:
    """Load of `width_of` numbers from place index * scale of a flat array."""

    @intrinsic
    def load(_typing: Any, array: Any, index: Any) -> Any:
        vector = VectorType(array.dtype, width_of(array.dtype))

        def generate(context: Any, builder: ir.IRBuilder, signature: Any, values: Any) -> Any:
            place = builder.mul(values[1], ir.Constant(values[1].type, scale(vector.width)))
            loaded = builder.load(_pointer(context, builder, signature.args[0], values[0], place, vector))
            # The alignment of the numbers: arrays of saved states have no larger one.
            loaded.align = array.dtype.bitwidth // 8
            return loaded

        return vector(array, types.intp), generate

    return load


def _define_store(scale: Callable[[int], int]) -> Any:
    @intrinsic
    def store(_typing: Any, array: Any, index: Any, value: Any) -> Any:

        def generate(context: Any, builder: ir.IRBuilder, signature: Any, values: Any) -> Any:
            place = builder.mul(values[1], ir.Constant(values[1].type, scale(value.width)))
            pointer = _pointer(context, builder, signature.args[0], values[0], place, value)
            builder.store(values[2], pointer, align=array.dtype.bitwidth // 8)
            return context.get_dummy_value()

        return types.none(array, types.intp, value), generate

    return store


# A vector of a group from place `index` of an array; the four numbers of row `index` of an array (n, 4).
load_group = _define_load(lambda _: GROUP, lambda _: 1)
load_row = _define_load(lambda _: 4, lambda _: 4)
# The `index`-th vector of an array of vectors.
store_lanes = _define_store(lambda width: width)
store_row = _define_store(lambda _: 4)
# Store for `load_group`.
store_group = _define_store(lambda _: 1)


@intrinsic
def load_lanes(_typing: Any, lanes: Any, array: Any, index: Any) -> Any:
    """The `index`-th vector of an array of vectors as wide as the length of the tuple `lanes`."""
    vector = VectorType(array.dtype, len(lanes))

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, values: Any) -> Any:
        place = builder.mul(values[2], ir.Constant(values[2].type, vector.width))
        loaded = builder.load(_pointer(context, builder, signature.args[1], values[1], place, vector))
        loaded.align = array.dtype.bitwidth // 8
        return loaded

    return vector(lanes, array, types.intp), generate


@intrinsic
def spread_group(_typing: Any, value: Any) -> Any:
    """Vector of a group with the same number for each item."""
    vector = VectorType(value, GROUP)

    def generate(context: Any, builder: ir.IRBuilder, _signature: Any, values: Any) -> Any:
        return _operand(context, builder, values[0], value, vector)

    return vector(value), generate


@intrinsic
def load_or_spread(_typing: Any, lanes: Any, like: Any, array: Any, index: Any) -> Any:
    """Vector of each lane's own numbers in an array (n, n_lane), or of a common number in an array (n,); as `like`."""
    own = array.ndim == 2
    vector = VectorType(array.dtype if own else like.dtype, len(lanes))

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, values: Any) -> Any:
        kind = signature.args[2]
        if own:
            place = builder.mul(values[3], ir.Constant(values[3].type, vector.width))
            loaded = builder.load(_pointer(context, builder, kind, values[2], place, vector))
            loaded.align = array.dtype.bitwidth // 8
            return loaded
        data = context.make_array(kind)(context, builder, values[2]).data
        return _operand(context, builder, builder.load(builder.gep(data, [values[3]])), array.dtype, vector)

    return vector(lanes, like, array, types.intp), generate


# ---- shuffles -----------------------------------------------------------------------------------------------------


def define_shuffle(places: list[int]) -> Any:
    """Function that selects entries of two joined vectors by place."""

    @intrinsic
    def shuffle(_typing: Any, a: Any, b: Any) -> Any:
        def generate(_context: Any, builder: ir.IRBuilder, _signature: Any, values: Any) -> Any:
            mask = ir.Constant(ir.VectorType(ir.IntType(32), len(places)), places)
            return builder.shuffle_vector(values[0], values[1], mask)

        return VectorType(a.element, len(places))(a, b), generate

    return shuffle


def define_extract(place: int) -> Any:
    """Function that extracts the number at a place of a vector."""

    @intrinsic
    def extract(_typing: Any, a: Any) -> Any:
        def generate(_context: Any, builder: ir.IRBuilder, _signature: Any, values: Any) -> Any:
            return builder.extract_element(values[0], ir.Constant(ir.IntType(32), place))

        return a.element(a), generate

    return extract


@intrinsic
def fold_lower(_typing: Any, vector: Any, lowest: Any) -> Any:
    """`keep_lower` of a number and the numbers of a vector, in order."""

    def generate(_context: Any, builder: ir.IRBuilder, _signature: Any, values: Any) -> Any:
        least = values[1]
        for place in range(vector.width):
            number = builder.extract_element(values[0], ir.Constant(ir.IntType(32), place))
            least = builder.select(builder.fcmp_ordered(">=", number, least), least, number)
        return least

    return vector.element(vector, vector.element), generate
