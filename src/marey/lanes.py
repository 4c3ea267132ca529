"""Vector instructions for kernels: four or eight neighbouring numbers at a time.

Numba vectorises long loops only. These intrinsics express an inner loop over a few numbers as vector instructions; a
processor with shorter vectors executes several instructions.
"""

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

LANES = 8
"""Number of float64 values in one vector: 512 bits."""

_LANES = ir.VectorType(ir.DoubleType(), LANES)
"""Type of a vector of float64 in LLVM."""
_LABELS = ir.VectorType(ir.IntType(32), LANES)
"""Type of a vector of int32 in LLVM."""
_FOUR = ir.VectorType(ir.FloatType(), 4)
"""Type of a vector of four float32 in LLVM."""
_LINEAR = ("reassoc", "contract", "nsz")
"""Floating-point flags of LLVM that allow reassociation, but preserve NaN."""
_FAST = ("fast",)
"""Floating-point flags of LLVM that allow reassociation."""


def _spread(builder: Any, scalar: Any, kind: Any = _LANES) -> Any:
    """Return a vector of a type, all numbers of which equal a scalar."""
    undefined = ir.Constant(kind, ir.Undefined)
    vector = builder.insert_element(undefined, scalar, ir.Constant(ir.IntType(32), 0))
    return builder.shuffle_vector(vector, undefined, ir.Constant(_LABELS, [0] * LANES))


def _place(context: Any, builder: Any, kind: Any, array: Any, at: Any) -> Any:
    """Point to eight neighbouring numbers of a flat array."""
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [at]), ir.VectorType(data.type.pointee, LANES).as_pointer())


def _along(builder: Any, line: Any, kind: Any, flags: tuple[str, ...] = ()) -> Any:
    """Return eight successive numbers, as a vector of a type, from a tuple of the first one and the step."""
    start, step = (_spread(builder, builder.extract_value(line, i), kind) for i in range(2))
    lanes = ir.Constant(kind, [float(lane) for lane in range(LANES)])
    return builder.fadd(start, builder.fmul(step, lanes, flags=flags), flags=flags)


def _covered(builder: Any, u: Any, v: Any, count: Any, kind: Any) -> Any:
    """Return which of eight pixels are among the first ones of a row and have no negative u, v and 1 - u - v."""
    numbers = ir.Constant(_LABELS, list(range(LANES)))
    covered = builder.icmp_signed("<", numbers, _spread(builder, builder.trunc(count, ir.IntType(32)), _LABELS))
    w = builder.fsub(builder.fsub(ir.Constant(kind, [1.0] * LANES), u), v)
    for edge in (u, v, w):
        covered = builder.and_(covered, builder.fcmp_ordered(">=", edge, ir.Constant(kind, [0.0] * LANES)))
    return covered


@intrinsic
def add_row(typing, sums, at, factor, row):  # type: ignore[no-untyped-def]
    """Do sums[at : at + 8] += factor * row, for a flat array and a tuple of eight numbers."""

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array, start, scale, values = arguments
        target = _place(context, builder, signature.args[0], array, start)
        vector = ir.Constant(_LANES, ir.Undefined)
        for lane in range(LANES):
            value = builder.extract_value(values, lane)
            vector = builder.insert_element(vector, value, ir.Constant(ir.IntType(32), lane))
        product = builder.fmul(_spread(builder, scale), vector, flags=_FAST)
        builder.store(builder.fadd(builder.load(target, align=8), product, flags=_FAST), target, align=8)
        return context.get_dummy_value()

    return types.void(sums, types.intp, types.float64, row), build


@intrinsic
def put_combination(typing, out, at, factors, rows, start, stride):  # type: ignore[no-untyped-def]
    """Do out[at : at + 8] = sum over s of factors[s] * rows[start + s stride :][:8], for flat arrays and a tuple."""

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array, place, scales, source, first, step = arguments
        total = None
        for s in range(factors.count):
            row = builder.load(_place(context, builder, signature.args[3], source, first), align=8)
            product = builder.fmul(_spread(builder, builder.extract_value(scales, s)), row, flags=_FAST)
            total = product if total is None else builder.fadd(total, product, flags=_FAST)
            first = builder.add(first, step)
        builder.store(total, _place(context, builder, signature.args[0], array, place), align=8)
        return context.get_dummy_value()

    return types.void(out, types.intp, factors, rows, types.intp, types.intp), build


@intrinsic
def paint_row(typing, depth, label, at, count, first, second, third, value):  # type: ignore[no-untyped-def]
    """Write a label and its depth where three numbers are not negative and the depth exceeds the one that is there.

    Args:
        typing: Numba's.
        depth: flat array, eight numbers longer than what is painted.
        label: flat array of the same length, int32.
        at: first pixel of the row.
        count: pixels of the row; what lies beyond eight is not painted.
        first: (start, step) of a number that must not be negative.
        second: the same of another one; the third is one less these two.
        third: the depth's start and step.
        value: the label.
    """

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        depths, labels, place, most, *lines, number = arguments
        u, v, z = (_along(builder, line, _LANES) for line in lines)
        target = _place(context, builder, signature.args[0], depths, place)
        old = builder.load(target, align=8)
        painted = builder.and_(_covered(builder, u, v, most, _LANES), builder.fcmp_ordered(">", z, old))
        builder.store(builder.select(painted, z, old), target, align=8)
        target = _place(context, builder, signature.args[1], labels, place)
        own_label = _spread(builder, number, _LABELS)
        builder.store(builder.select(painted, own_label, builder.load(target, align=4)), target, align=4)
        return context.get_dummy_value()

    return types.void(depth, label, types.intp, types.intp, first, second, third, types.int32), build


@intrinsic
def weighted_square(typing, picture, first, width, across, down):  # type: ignore[no-untyped-def]
    """Return the sum over i, j < 4 of down[i] * across[j] * picture[first + i width + j]; all but indices are float32.

    Args:
        typing: Numba's.
        picture: flat image.
        first: index of the pixel at the upper left of the 4 x 4 pixels.
        width: width of the image.
        across: weights of the four columns.
        down: weights of the four rows.
    """

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array, at, step, columns, rows = arguments
        data = context.make_array(signature.args[0])(context, builder, array).data
        total = None
        for i in range(4):
            row = builder.load(builder.bitcast(builder.gep(data, [at]), _FOUR.as_pointer()), align=4)
            product = builder.fmul(row, _four(builder, [builder.extract_value(rows, i)] * 4), flags=_LINEAR)
            total = product if total is None else builder.fadd(total, product, flags=_LINEAR)
            at = builder.add(at, step)
        weights = _four(builder, [builder.extract_value(columns, j) for j in range(4)])
        total = builder.fmul(total, weights, flags=_LINEAR)
        a, b, c, d = (builder.extract_element(total, ir.Constant(ir.IntType(32), lane)) for lane in range(4))
        left, right = builder.fadd(a, b, flags=_LINEAR), builder.fadd(c, d, flags=_LINEAR)
        return builder.fadd(left, right, flags=_LINEAR)

    weights = types.UniTuple(types.float32, 4)
    return types.float32(picture, types.intp, types.intp, weights, weights), build


POSITIONS = 24
"""Number of neighbouring positions that `correlate_rows` compares at a time."""
_ROWS, _BLOCKS = 2, 3
"""Rows and blocks of eight positions; six sums are independent of each other, as many as a processor adds at a time."""
_EIGHT = ir.VectorType(ir.FloatType(), POSITIONS // _BLOCKS)
"""Type of a vector of eight float32 in LLVM."""


@intrinsic
def correlate_rows(typing, patch, size, window, at, stride, sums):  # type: ignore[no-untyped-def]
    """Correlate a patch with an image at 24 neighbouring positions in each of two rows.

    Sets sums[24 r + k] to the sum over i, j < size of patch[size i + j] * window[at + (r + i) stride + j + k].

    Args:
        typing: Numba's.
        patch: flat patch, float32.
        size: width and height of the patch.
        window: flat image, float32.
        at: index of the first pixel under the patch at the first position.
        stride: width of the image.
        sums: (48,) float32.
    """

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        weights, side, image, start, step, results = arguments
        places = [(r, b) for r in range(_ROWS) for b in range(_BLOCKS)]
        totals = [cgutils.alloca_once_value(builder, ir.Constant(_EIGHT, None)) for _ in places]
        weight = context.make_array(signature.args[0])(context, builder, weights).data
        data = context.make_array(signature.args[2])(context, builder, image).data
        with cgutils.for_range(builder, side) as row, cgutils.for_range(builder, side) as column:
            own = builder.load(builder.gep(weight, [builder.add(builder.mul(row.index, side), column.index)]))
            factor = ir.Constant(_EIGHT, ir.Undefined)
            for lane in range(_EIGHT.count):
                factor = builder.insert_element(factor, own, ir.Constant(ir.IntType(32), lane))
            corner = builder.add(builder.add(start, column.index), builder.mul(row.index, step))
            for total, (r, b) in zip(totals, places, strict=True):
                place = builder.add(corner, ir.Constant(corner.type, _EIGHT.count * b))
                place = builder.add(place, step) if r else place
                pixels = builder.load(builder.bitcast(builder.gep(data, [place]), _EIGHT.as_pointer()), align=4)
                product = builder.fmul(factor, pixels, flags=_LINEAR)
                builder.store(builder.fadd(builder.load(total), product, flags=_LINEAR), total)
        out = context.make_array(signature.args[5])(context, builder, results).data
        for number, total in enumerate(totals):
            place = builder.gep(out, [ir.Constant(ir.IntType(64), _EIGHT.count * number)])
            builder.store(builder.load(total), builder.bitcast(place, _EIGHT.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(patch, types.intp, window, types.intp, types.intp, sums), build


def _four(builder: Any, scalars: Any) -> Any:
    vector = ir.Constant(_FOUR, ir.Undefined)
    for lane, scalar in enumerate(scalars):
        vector = builder.insert_element(vector, scalar, ir.Constant(ir.IntType(32), lane))
    return vector


_ORDERS = ir.VectorType(ir.FloatType(), LANES)
"""Type of a vector of the orders of neighbouring pixels in LLVM."""


@intrinsic
def paint_flat_row(typing, order, label, at, count, first, second, own, value):  # type: ignore[no-untyped-def]
    """Write a label and its order where three numbers are not negative and the order exceeds the one that is there.

    Unlike in `paint_row`, all pixels have the same order, and the numbers have single precision.

    Args:
        typing: Numba's.
        order: flat array of float32, eight numbers longer than what is painted.
        label: flat array of integers of the same length.
        at: first pixel of the row.
        count: pixels of the row; what lies beyond eight is not painted.
        first: (start, step) of a number that must not be negative, float32.
        second: the same of another one; the third is one less these two.
        own: the order, float32.
        value: the label.
    """

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        orders, labels, place, most, *lines, nearness, number = arguments
        u, v = (_along(builder, line, _ORDERS, _FAST) for line in lines)
        target = _place(context, builder, signature.args[0], orders, place)
        nearer, old = _spread(builder, nearness, _ORDERS), builder.load(target, align=4)
        painted = builder.and_(_covered(builder, u, v, most, _ORDERS), builder.fcmp_ordered(">", nearer, old))
        builder.store(builder.select(painted, nearer, old), target, align=4)
        target = _place(context, builder, signature.args[1], labels, place)
        own_label = _spread(builder, number, target.type.pointee)
        builder.store(builder.select(painted, own_label, builder.load(target, align=1)), target, align=1)
        return context.get_dummy_value()

    row = types.UniTuple(types.float32, 2)
    return types.void(order, label, types.intp, types.intp, row, row, types.float32, label.dtype), build


@intrinsic
def take_larger(typing, order, other, at, empty):  # type: ignore[no-untyped-def]
    """Compare eight neighbouring pixels with those of another image, and empty them.

    Args:
        typing: Numba's.
        order: flat array of float32; the eight numbers become `empty`.
        other: flat array of float32, or one number for all pixels.
        at: first pixel.
        empty: float32.

    Returns:
        Bits of the pixels that were larger in the first image, the first pixel's bit lowest.
    """

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        orders, others, place, nothing = arguments
        target = _place(context, builder, signature.args[0], orders, place)
        if isinstance(signature.args[1], types.Float):
            beside = _spread(builder, others, _ORDERS)
        else:
            beside = builder.load(_place(context, builder, signature.args[1], others, place), align=4)
        larger = builder.fcmp_ordered(">", builder.load(target, align=4), beside)
        builder.store(_spread(builder, nothing, _ORDERS), target, align=4)
        return builder.zext(builder.bitcast(larger, ir.IntType(LANES)), ir.IntType(64))

    return types.int64(order, other, types.intp, types.float32), build


@intrinsic
def lowest_bit(typing, bits):  # type: ignore[no-untyped-def]
    """Return the place of the lowest bit of an integer that is not 0."""

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.cttz(arguments[0], ir.Constant(ir.IntType(1), 1))

    return types.int64(types.int64), build
