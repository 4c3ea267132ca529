"""Vector instructions for kernels: four or eight neighbouring numbers at a time.

Numba vectorises long loops only. These intrinsics express an inner loop over a few numbers as vector instructions; a
processor with shorter vectors executes several instructions.
"""

import inspect
from collections.abc import Callable
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
_SINGLES = ir.VectorType(ir.FloatType(), LANES)
"""Type of a vector of float32 in LLVM."""
_FOUR = ir.VectorType(ir.FloatType(), 4)
"""Type of a vector of four float32 in LLVM."""
_FLOOR = "llvm.floor.v8f32"
"""LLVM's function that rounds eight float32 down."""
_CUBICS = ((1 / 6, 2 / 3, 1 / 6, 0.0), (-0.5, 0.0, 0.5, 0.0), (0.5, -1.0, 0.5, 0.0), (-1 / 6, 0.5, -0.5, 1 / 6))
"""Coefficients of the four cubic B-splines between two pixels; row k belongs to the k-th power of the place."""
_LINEAR = ("reassoc", "contract", "nsz")
"""Floating-point flags of LLVM that allow reassociation, but preserve NaN."""
_FAST = ("fast",)
"""Floating-point flags of LLVM that allow reassociation."""


def _writes(*names: str) -> Callable[[Any], Any]:
    """Let an intrinsic state the arguments that it writes to; see `marey.compiled.kernel_writes`."""

    def with_statement(found: Any) -> Any:
        order = list(inspect.signature(found._defn).parameters)[1:]
        found.written = frozenset(order.index(name) for name in names)
        return found

    return with_statement


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


@_writes("sums")
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


@_writes("out")
@intrinsic
def put_combination(typing, out, at, factors, rows, start, stride):  # type: ignore[no-untyped-def]
    """Do out[at : at + 8] = sum over s of factors[s] * rows[start + s stride :][:8], for flat arrays and a tuple.

    All numbers have the same precision, double or single.
    """

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        array, place, scales, source, first, step = arguments
        kind, total = _SINGLES if rows.dtype == types.float32 else _LANES, None
        size = rows.dtype.bitwidth // 8
        for s in range(factors.count):
            row = builder.load(_place(context, builder, signature.args[3], source, first), align=size)
            product = builder.fmul(_spread(builder, builder.extract_value(scales, s), kind), row, flags=_LINEAR)
            total = product if total is None else builder.fadd(total, product, flags=_LINEAR)
            first = builder.add(first, step)
        builder.store(total, _place(context, builder, signature.args[0], array, place), align=size)
        return context.get_dummy_value()

    return types.void(out, types.intp, factors, rows, types.intp, types.intp), build


@_writes("depth", "label")
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


@_writes("first", "right", "below")
@intrinsic
def place_pixels(typing, to_image, corner, width, last, x, y, at, first, right, below):  # type: ignore[no-untyped-def]
    """Find the 4 x 4 pixels about each of eight mapped pixels, and the place of the mapped one between them.

    Args:
        typing: Numba's.
        to_image: the map, six float32: place of the origin right of and below a pixel, and the linear part row by row.
        corner: index in the flat image of the neighbour of that pixel at the upper left.
        width: width of the image.
        last: largest index that is written; the smallest is 0.
        x: flat array of float32 with the pixels that are mapped.
        y: the same.
        at: number of the first of the eight pixels.
        first: flat array of int32 for the index of the pixel at the upper left of the 4 x 4 pixels.
        right: flat array of float32 for the distance from the pixel at their second column and row, between 0 and 1.
        below: the same along the columns.
    """

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        linear, origin, step, most, columns, rows, place, *results = arguments
        u, v, a, b, c, d = (_spread(builder, builder.extract_value(linear, i), _SINGLES) for i in range(6))
        along = builder.load(_place(context, builder, signature.args[4], columns, place), align=4)
        down = builder.load(_place(context, builder, signature.args[5], rows, place), align=4)
        mapped = [_sum_of_products(builder, each, (along, down)) for each in ((u, a, b), (v, c, d))]
        floor = cgutils.get_or_insert_function(builder.module, ir.FunctionType(_SINGLES, [_SINGLES]), _FLOOR)
        whole = [builder.call(floor, [each]) for each in mapped]
        column, row = (builder.fptosi(each, _LABELS) for each in whole)
        origin, step, most = (
            _spread(builder, builder.trunc(each, ir.IntType(32)), _LABELS) for each in (origin, step, most)
        )
        index = builder.add(builder.add(origin, column), builder.mul(row, step))
        zero = ir.Constant(_LABELS, [0] * LANES)
        index = builder.select(builder.icmp_signed("<", index, zero), zero, index)
        index = builder.select(builder.icmp_signed(">", index, most), most, index)
        fractions = [builder.fsub(each, under, flags=_LINEAR) for each, under in zip(mapped, whole, strict=True)]
        for kind, array, value in zip(signature.args[7:], results, (index, *fractions), strict=True):
            builder.store(value, _place(context, builder, kind, array, place), align=4)
        return context.get_dummy_value()

    numbers = (types.intp, types.intp, types.intp)
    return types.void(to_image, *numbers, x, y, types.intp, first, right, below), build


def _sum_of_products(builder: Any, factors: Any, numbers: Any) -> Any:
    """Return the first factor, plus each other one times its number."""
    total = factors[0]
    for factor, number in zip(factors[1:], numbers, strict=True):
        total = builder.fadd(total, builder.fmul(factor, number, flags=_LINEAR), flags=_LINEAR)
    return total


@_writes("out")
@intrinsic
def interpolate_pixels(typing, coefficients, width, first, right, below, at, out):  # type: ignore[no-untyped-def]
    """Evaluate a cubic spline at eight pixels that `place_pixels` has placed; all but indices are float32.

    Two pixels that are four apart are processed together, one in each half of a vector.

    Args:
        typing: Numba's.
        coefficients: flat image with the spline's coefficients.
        width: width of the image.
        first: flat array with the index of the coefficient at the upper left of each pixel's 4 x 4 coefficients.
        right: flat array with the pixels' places between their second and third columns.
        below: the same between their rows.
        at: number of the first of the eight pixels.
        out: flat array for the values.
    """

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        image, step, indices, rights, belows, place, values = arguments
        lines = [context.make_array(signature.args[0])(context, builder, image).data]
        for _ in range(3):
            lines.append(builder.gep(lines[-1], [step]))
        index = context.make_array(signature.args[2])(context, builder, indices).data
        numbers = [builder.add(place, ir.Constant(place.type, pixel)) for pixel in range(LANES)]
        corners = [builder.sext(builder.load(builder.gep(index, [each])), place.type) for each in numbers]
        x = builder.load(_place(context, builder, signature.args[3], rights, place), align=4)
        y = builder.load(_place(context, builder, signature.args[4], belows, place), align=4)
        down = [_polynomial(builder, y, [[row[i]] * LANES for row in _CUBICS]) for i in range(4)]
        pairs = []
        for pixel in range(LANES // 2):
            both = [pixel] * 4 + [pixel + 4] * 4
            total = ir.Constant(_SINGLES, [0.0] * LANES)
            for weights, line in zip(down, lines, strict=True):
                low, high = (
                    builder.load(builder.bitcast(builder.gep(line, [corners[each]]), _FOUR.as_pointer()), align=4)
                    for each in (pixel, pixel + 4)
                )
                row = _picked(builder, low, high, range(LANES))
                total = _sum_of_products(builder, (total, _picked(builder, weights, weights, both)), (row,))
            across = _polynomial(builder, _picked(builder, x, x, both), [2 * each for each in _CUBICS])
            pairs.append(builder.fmul(total, across, flags=_LINEAR))
        halves = (_neighbours_added(builder, *pairs[:2]), _neighbours_added(builder, *pairs[2:]))
        target = _place(context, builder, signature.args[6], values, place)
        builder.store(_neighbours_added(builder, *halves), target, align=4)
        return context.get_dummy_value()

    return types.void(coefficients, types.intp, first, right, below, types.intp, out), build


def _polynomial(builder: Any, x: Any, coefficients: Any) -> Any:
    """Evaluate polynomials of a vector, whose coefficients are given by power, one per number of the vector."""
    powers = [ir.Constant(_SINGLES, list(each)) for each in coefficients]
    total = powers.pop()
    while powers:
        total = _sum_of_products(builder, (powers.pop(), total), (x,))
    return total


def _picked(builder: Any, one: Any, other: Any, numbers: Any) -> Any:
    """Return eight numbers out of two vectors; those of the second one are numbered on from the first one's."""
    return builder.shuffle_vector(one, other, ir.Constant(_LABELS, list(numbers)))


def _neighbours_added(builder: Any, one: Any, other: Any) -> Any:
    """Return the sums of neighbours in each half of two vectors: the first one's, the second one's, in each half."""
    even, odd = ([i + shift for i in (0, 2, 8, 10, 4, 6, 12, 14)] for shift in (0, 1))
    return builder.fadd(_picked(builder, one, other, even), _picked(builder, one, other, odd), flags=_LINEAR)


POSITIONS = 24
"""Number of neighbouring positions that `correlate_rows` compares at a time."""
_ROWS, _BLOCKS = 2, 3
"""Rows and blocks of eight positions; six sums are independent of each other, as many as a processor adds at a time."""


@_writes("sums")
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
        totals = [cgutils.alloca_once_value(builder, ir.Constant(_SINGLES, None)) for _ in places]
        weight = context.make_array(signature.args[0])(context, builder, weights).data
        data = context.make_array(signature.args[2])(context, builder, image).data
        with cgutils.for_range(builder, side) as row, cgutils.for_range(builder, side) as column:
            own = builder.load(builder.gep(weight, [builder.add(builder.mul(row.index, side), column.index)]))
            factor = ir.Constant(_SINGLES, ir.Undefined)
            for lane in range(_SINGLES.count):
                factor = builder.insert_element(factor, own, ir.Constant(ir.IntType(32), lane))
            corner = builder.add(builder.add(start, column.index), builder.mul(row.index, step))
            for total, (r, b) in zip(totals, places, strict=True):
                place = builder.add(corner, ir.Constant(corner.type, _SINGLES.count * b))
                place = builder.add(place, step) if r else place
                pixels = builder.load(builder.bitcast(builder.gep(data, [place]), _SINGLES.as_pointer()), align=4)
                product = builder.fmul(factor, pixels, flags=_LINEAR)
                builder.store(builder.fadd(builder.load(total), product, flags=_LINEAR), total)
        out = context.make_array(signature.args[5])(context, builder, results).data
        for number, total in enumerate(totals):
            place = builder.gep(out, [ir.Constant(ir.IntType(64), _SINGLES.count * number)])
            builder.store(builder.load(total), builder.bitcast(place, _SINGLES.as_pointer()), align=4)
        return context.get_dummy_value()

    return types.void(patch, types.intp, window, types.intp, types.intp, sums), build


@_writes("order", "label")
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
        u, v = (_along(builder, line, _SINGLES, _FAST) for line in lines)
        target = _place(context, builder, signature.args[0], orders, place)
        nearer, old = _spread(builder, nearness, _SINGLES), builder.load(target, align=4)
        painted = builder.and_(_covered(builder, u, v, most, _SINGLES), builder.fcmp_ordered(">", nearer, old))
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
            beside = _spread(builder, others, _SINGLES)
        else:
            beside = builder.load(_place(context, builder, signature.args[1], others, place), align=4)
        larger = builder.fcmp_ordered(">", builder.load(target, align=4), beside)
        builder.store(_spread(builder, nothing, _SINGLES), target, align=4)
        return builder.zext(builder.bitcast(larger, ir.IntType(LANES)), ir.IntType(64))

    return types.int64(order, other, types.intp, types.float32), build


@intrinsic
def lowest_bit(typing, bits):  # type: ignore[no-untyped-def]
    """Return the place of the lowest bit of an integer that is not 0."""

    def build(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        return builder.cttz(arguments[0], ir.Constant(ir.IntType(1), 1))

    return types.int64(types.int64), build
