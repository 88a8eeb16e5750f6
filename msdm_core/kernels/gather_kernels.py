"""Gathering of node values into vectors with an entry per item (spring or tet) of a group, and scattered sums.

Each function emits its loads, shuffles and stores as LLVM code, as many as a group has items. Stores of an item precede
loads of the next: items of a group may share nodes, and their sums have the order of a plain loop.
"""

from collections.abc import Callable, Sequence
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils

from msdm_core.kernels.vector_kernels import GROUP, VectorType, intrinsic

# Of a float64: arrays of saved states have no larger alignment.
_ALIGNMENT = 8
_INDEX, _INT32, _DOUBLE = ir.IntType(64), ir.IntType(32), ir.DoubleType()
_ROW, _PAIR, _VECTOR = ir.VectorType(_DOUBLE, 4), ir.VectorType(_DOUBLE, 2), ir.VectorType(_DOUBLE, GROUP)
# Entries of two vectors of four: the even and the odd ones in turn, both lower and both upper halves.
_EVEN, _ODD, _LOW, _HIGH = (0, 4, 2, 6), (1, 5, 3, 7), (0, 1, 4, 5), (2, 3, 6, 7)
VECTOR, ROW = VectorType(types.float64, GROUP), VectorType(types.float64, 4)


class _Group:
    """Code for the nodes of a group of items, from item `first` on, of an array (n_item, corners)."""

    def __init__(self, context: Any, builder: ir.IRBuilder, kind: Any, items: Any, first: Any, corners: int) -> None:
        self.builder, self.corners = builder, corners
        data = context.make_array(kind)(context, builder, items).data
        self._data = builder.gep(data, [builder.mul(first, _INDEX(corners))])
        self._nodes: dict[tuple[int, int], Any] = {}

    def node(self, item: int, corner: int) -> Any:
        """Number of a node, loaded once."""
        if (item, corner) not in self._nodes:
            place = self.builder.gep(self._data, [_INDEX(item * self.corners + corner)])
            self._nodes[item, corner] = self.builder.sext(self.builder.load(place), _INDEX)
        return self._nodes[item, corner]


class _Numbers:
    """Code for the numbers of an array with `width` numbers a node, at the corners of a group's items."""

    def __init__(self, group: _Group, context: Any, kind: Any, array: Any, width: int) -> None:
        self._group, self._width = group, width
        self._builder = group.builder
        self._data = context.make_array(kind)(context, self._builder, array).data

    def _place(self, item: int, corner: int, column: int, kind: Any) -> Any:
        first = self._builder.mul(self._group.node(item, corner), _INDEX(self._width))
        return self._builder.bitcast(
            self._builder.gep(self._data, [self._builder.add(first, _INDEX(column))]), kind.as_pointer()
        )

    def load(self, item: int, corner: int, kind: Any, column: int = 0) -> Any:
        """Numbers of a node from a column on."""
        return self._builder.load(self._place(item, corner, column, kind), align=_ALIGNMENT)

    def add(self, item: int, corner: int, value: Any, column: int = 0) -> None:
        """Add to what `load` reads."""
        total = self._builder.fadd(self.load(item, corner, value.type, column), value)
        self._builder.store(total, self._place(item, corner, column, value.type), align=_ALIGNMENT)

    def take(self, item: int, corner: int, value: Any) -> None:
        """Subtract from what `load` reads."""
        difference = self._builder.fsub(self.load(item, corner, value.type), value)
        self._builder.store(difference, self._place(item, corner, 0, value.type), align=_ALIGNMENT)


def _shuffle(builder: ir.IRBuilder, pair: Sequence[Any], places: Sequence[int]) -> Any:
    """Entries of two joined vectors, by place."""
    return builder.shuffle_vector(pair[0], pair[1], ir.Constant(ir.VectorType(_INT32, len(places)), list(places)))


def _pack(builder: ir.IRBuilder, numbers: Sequence[Any]) -> Any:
    packed = ir.Constant(_VECTOR, ir.Undefined)
    for place, number in enumerate(numbers):
        packed = builder.insert_element(packed, number, _INT32(place))
    return packed


def _entry(builder: ir.IRBuilder, vector: Any, place: int) -> Any:
    return builder.extract_element(vector, _INT32(place))


def _columns(builder: ir.IRBuilder, rows: Sequence[Any]) -> list[Any]:
    """Rows (x, y, z, -) of items as vectors of x, y and z."""
    pairs = ((rows[0], rows[1]), (rows[2], rows[3]))
    even = [_shuffle(builder, pair, _EVEN) for pair in pairs]
    odd = [_shuffle(builder, pair, _ODD) for pair in pairs]
    return [_shuffle(builder, even, _LOW), _shuffle(builder, odd, _LOW), _shuffle(builder, even, _HIGH)]


def _rows(builder: ir.IRBuilder, columns: Sequence[Any]) -> list[Any]:
    """Vectors of x, y and z as rows (x, y, z, 0) of items."""
    x, y, z = columns
    zeros = ir.Constant(_VECTOR, [0.0] * GROUP)
    # x0, y0, x2, y2 and z0, 0, z2, 0; then those of items 1 and 3.
    even, odd = ([_shuffle(builder, pair, places) for pair in ((x, y), (z, zeros))] for places in (_EVEN, _ODD))
    return [_shuffle(builder, pairs, half) for half in (_LOW, _HIGH) for pairs in (even, odd)]


def _define_read(corners: int, width: int, result: Any, write: Callable[..., Any]) -> Any:
    """Function of an array, of items and of a group's first item with vectors as result; `write` emits its code.

    Arrays have `width` numbers a node and `corners` nodes an item, in sequence.
    """

    @intrinsic
    def read(_typing: Any, values: Any, items: Any, first: Any) -> Any:
        def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
            group = _Group(context, builder, signature.args[1], arguments[1], arguments[2], corners)
            vectors = write(builder, _Numbers(group, context, signature.args[0], arguments[0], width))
            return vectors if result == VECTOR else _tuple(context, builder, result, vectors)

        return result(values, items, types.intp), generate

    return read


def _define_add(corners: int, width: int, write: Callable[..., None]) -> Any:
    """Function of an array, of items, of a group's first item and of vectors, added to the array; as `_define_read`."""

    @intrinsic
    def add(_typing: Any, values: Any, items: Any, first: Any, vectors: Any) -> Any:
        def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
            group = _Group(context, builder, signature.args[1], arguments[1], arguments[2], corners)
            numbers = _Numbers(group, context, signature.args[0], arguments[0], width)
            several = isinstance(vectors, types.BaseTuple)
            write(builder, numbers, _entries(builder, signature.args[3], arguments[3]) if several else arguments[3])
            return context.get_dummy_value()

        return types.none(values, items, types.intp, vectors), generate

    return add


def _tuple(context: Any, builder: ir.IRBuilder, kind: Any, values: Sequence[Any]) -> Any:
    """Lists of lists of values as tuples of tuples."""
    parts = [
        _tuple(context, builder, part, value) if isinstance(part, types.BaseTuple) else value
        for part, value in zip(kind, values, strict=True)
    ]
    return context.make_tuple(builder, kind, parts)


def _entries(builder: ir.IRBuilder, kind: Any, value: Any) -> list[Any]:
    """Tuples of tuples of values as lists of lists."""
    return [
        _entries(builder, part, entry) if isinstance(part, types.BaseTuple) else entry
        for part, entry in zip(kind, cgutils.unpack_tuple(builder, value), strict=True)
    ]


# ---- springs ------------------------------------------------------------------------------------------------------


def _edge_rows(builder: ir.IRBuilder, position: _Numbers, corner: int = 1) -> list[Any]:
    return [
        builder.fsub(position.load(item, corner, _ROW), position.load(item, 0, _ROW)) for item in range(GROUP)
    ]  # fmt: skip


def _end_sums(builder: ir.IRBuilder, pairs: _Numbers) -> Any:
    return _pack(
        builder,
        [
            builder.fadd(pairs.load(item, 0, _DOUBLE, 1), pairs.load(item, 1, _DOUBLE, 1)) for item in range(GROUP)
        ],
    )  # fmt: skip


def _pull_ends(builder: ir.IRBuilder, force: _Numbers, vectors: Any) -> None:
    rows, scale = vectors
    for item in range(GROUP):
        pull = builder.fmul(rows[item], _shuffle(builder, (scale, scale), [item] * 4))
        force.add(item, 0, pull)
        force.take(item, 1, pull)


def _add_at_ends(builder: ir.IRBuilder, pairs: _Numbers, energy: Any) -> None:
    for item in range(GROUP):
        for corner in (0, 1):
            pairs.add(item, corner, _entry(builder, energy, item), 1)


# Rows from end 0 to end 1 of each spring, from rows (x, y, z, 0).
edge_rows = _define_read(2, 4, types.UniTuple(ROW, GROUP), _edge_rows)
# Sums of the second numbers of the two ends, from pairs.
end_sums = _define_read(2, 2, VECTOR, _end_sums)
# Arguments rows and a vector: their product added to the rows of end 0, subtracted from those of end 1.
pull_ends = _define_add(2, 4, _pull_ends)
# A vector added to the second numbers of the pairs of both ends.
add_at_ends = _define_add(2, 2, _add_at_ends)


@intrinsic
def columns(_typing: Any, rows: Any) -> Any:
    """Rows (x, y, z, -) of a group as vectors of x, y and z."""
    result = types.UniTuple(VECTOR, 3)

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, values: Any) -> Any:
        return context.make_tuple(builder, result, _columns(builder, cgutils.unpack_tuple(builder, values[0])))

    return result(rows), generate


# ---- tets ---------------------------------------------------------------------------------------------------------


def _tet_edges(builder: ir.IRBuilder, position: _Numbers) -> list[Any]:
    return [_columns(builder, _edge_rows(builder, position, corner)) for corner in (1, 2, 3)]


def _corner_sums(builder: ir.IRBuilder, values: _Numbers) -> Any:
    sums = []
    for item in range(GROUP):
        total = values.load(item, 0, _DOUBLE)
        for corner in (1, 2, 3):
            total = builder.fadd(total, values.load(item, corner, _DOUBLE))
        sums.append(total)
    return _pack(builder, sums)


def _pair_sums(builder: ir.IRBuilder, pairs: _Numbers) -> list[Any]:
    totals, ends, corners = [], [], []
    for item in range(GROUP):
        at_ends = builder.fadd(pairs.load(item, 0, _PAIR), pairs.load(item, 1, _PAIR))
        total = builder.fadd(builder.fadd(at_ends, pairs.load(item, 2, _PAIR)), pairs.load(item, 3, _PAIR))
        totals.append(_entry(builder, total, 0))
        ends.append(_entry(builder, at_ends, 1))
        corners.append(_entry(builder, total, 1))
    return [_pack(builder, totals), _pack(builder, ends), _pack(builder, corners)]


def _push_corners(builder: ir.IRBuilder, force: _Numbers, vectors: Any) -> None:
    b, c, d = (_rows(builder, vector) for vector in vectors)
    for item in range(GROUP):
        force.take(item, 0, builder.fadd(builder.fadd(b[item], c[item]), d[item]))
        for corner, rows in ((1, b), (2, c), (3, d)):
            force.add(item, corner, rows[item])


def _add_at_corners(builder: ir.IRBuilder, total: _Numbers, six: Any) -> None:
    for item in range(GROUP):
        for corner in range(4):
            total.add(item, corner, _entry(builder, six, item))


def _add_pairs(builder: ir.IRBuilder, pairs: _Numbers, vectors: Any) -> None:
    six, ends, others = vectors
    for item in range(GROUP):
        places = (item, item + GROUP)
        at_ends, elsewhere = _shuffle(builder, (six, ends), places), _shuffle(builder, (six, others), places)
        for corner, value in enumerate((at_ends, at_ends, elsewhere, elsewhere)):
            pairs.add(item, corner, value)


# Vectors of x, y and z from corner 0 of each tet to its corners 1, 2 and 3, from rows (x, y, z, 0).
tet_edges = _define_read(4, 4, types.UniTuple(types.UniTuple(VECTOR, 3), 3), _tet_edges)
# Sums over the corners, from numbers.
corner_sums = _define_read(4, 1, VECTOR, _corner_sums)
# Sums of the first numbers over the corners, of the second over the ends of the tet's spring and over the corners, from
# pairs.
pair_sums = _define_read(4, 2, types.UniTuple(VECTOR, 3), _pair_sums)
# Vectors of x, y and z added to the rows of the corners 1, 2 and 3, their sum subtracted at corner 0.
push_corners = _define_add(4, 4, _push_corners)
# A vector added to the numbers of all corners.
add_at_corners = _define_add(4, 1, _add_at_corners)
# A vector added to the first numbers of all corners' pairs, others to the second numbers at the ends of the tet's
# spring and at its other corners.
add_pairs = _define_add(4, 2, _add_pairs)
