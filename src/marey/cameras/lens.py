"""Lens models: kernels that map directions to pixels and back, for use in other kernels.

A camera is passed to kernels as one float64 vector of `PACKED` numbers: the rotation (9, row by row) and the
translation (3) from world to camera; fx, skew, fy, cx, cy [px]; the model (0 radial and tangential, 1 fisheye);
the distortion coefficients in OpenCV's order, padded with zeros to 14; and the square of the radius of (x/z, y/z) up to
which the lens model is invertible. Points beyond that radius have no image: their pixels are NaN.
"""

import numpy as np

from marey.arrays import Floats
from marey.compiled.kernels import kernel

PACKED = 33
"""Length of the vector of a camera."""
TRANSLATION, FX, SKEW, FY, CX, CY, MODEL, LENS, LIMIT = 9, 12, 13, 14, 15, 16, 17, 18, 32
"""Positions of the entries in the vector of a camera; the rotation starts at 0."""

_LEAST_STRETCH = 0.01
"""Determinant of the lens's Jacobian below which a pixel determines no direction; chosen by hand."""
_NEAR_AXIS = 1e-8
"""Squared radius below which the series of the fisheye model replaces its closed form, which loses digits there."""


@kernel
def distort(packed: Floats, x: float, y: float) -> tuple[float, float]:
    """Distort a direction (x/z, y/z) with the formulas of OpenCV.

    Args:
        packed: (PACKED,) the camera.
        x: Right, in units of the depth.
        y: Down, in units of the depth.

    Returns:
        The position in an image of focal length 1.
    """
    k = packed[LENS:LIMIT]
    s = x * x + y * y
    if packed[MODEL] == 1.0:
        if s < _NEAR_AXIS:
            scale = 1.0 + (k[0] - 1.0 / 3.0) * s
            return scale * x, scale * y
        r = np.sqrt(s)
        angle = np.arctan(r)
        t = angle * angle
        scale = angle * (1.0 + t * (k[0] + t * (k[1] + t * (k[2] + t * k[3])))) / r
        return scale * x, scale * y
    return distort_radially((k[0], k[1], k[2], k[3], k[4], k[5], k[6], k[7], k[8], k[9], k[10], k[11]), x, y)


@kernel(error_model="numpy")
def distort_radially(k, x, y):
    """Do what `distort` does for the radial and tangential model, without branches.

    Args:
        k: Twelve distortion coefficients in OpenCV's order.
        x: Right, in units of the depth.
        y: Down, in units of the depth.
    """
    s = x * x + y * y
    radial = (1.0 + s * (k[0] + s * (k[1] + s * k[4]))) / (1.0 + s * (k[5] + s * (k[6] + s * k[7])))
    across = 2.0 * x * y
    u = x * radial + k[2] * across + k[3] * (s + 2.0 * x * x) + s * (k[8] + s * k[9])
    v = y * radial + k[2] * (s + 2.0 * y * y) + k[3] * across + s * (k[10] + s * k[11])
    return u, v


@kernel
def distort_with_derivative(packed: Floats, x: float, y: float) -> tuple[float, float, float, float, float, float]:
    """Distort a direction, with the derivatives of the result.

    Args:
        packed: (PACKED,) the camera.
        x: Right, in units of the depth.
        y: Down, in units of the depth.

    Returns:
        u, v, du/dx, du/dy, dv/dx, dv/dy.
    """
    k = packed[LENS:LIMIT]
    s = x * x + y * y
    if packed[MODEL] == 1.0:
        if s < _NEAR_AXIS:
            scale, change = 1.0 + (k[0] - 1.0 / 3.0) * s, 2.0 * (k[0] - 1.0 / 3.0)
        else:
            r = np.sqrt(s)
            angle = np.arctan(r)
            t = angle * angle
            scale = angle * (1.0 + t * (k[0] + t * (k[1] + t * (k[2] + t * k[3])))) / r
            slope = 1.0 + t * (3.0 * k[0] + t * (5.0 * k[1] + t * (7.0 * k[2] + t * 9.0 * k[3])))
            change = (slope / (1.0 + s) - scale) / s
        across = change * x * y
        return scale * x, scale * y, scale + change * x * x, across, across, scale + change * y * y
    below = 1.0 + s * (k[5] + s * (k[6] + s * k[7]))
    radial = (1.0 + s * (k[0] + s * (k[1] + s * k[4]))) / below
    above_slope = k[0] + s * (2.0 * k[1] + s * 3.0 * k[4])
    below_slope = k[5] + s * (2.0 * k[6] + s * 3.0 * k[7])
    slope = 2.0 * (above_slope - radial * below_slope) / below
    across = 2.0 * x * y
    u = x * radial + k[2] * across + k[3] * (s + 2.0 * x * x) + s * (k[8] + s * k[9])
    v = y * radial + k[2] * (s + 2.0 * y * y) + k[3] * across + s * (k[10] + s * k[11])
    prism_u, prism_v = 2.0 * (k[8] + 2.0 * s * k[9]), 2.0 * (k[10] + 2.0 * s * k[11])
    ux = radial + slope * x * x + 2.0 * k[2] * y + 6.0 * k[3] * x + prism_u * x
    uy = slope * x * y + 2.0 * k[2] * x + 2.0 * k[3] * y + prism_u * y
    vx = slope * x * y + 2.0 * k[2] * x + 2.0 * k[3] * y + prism_v * x
    vy = radial + slope * y * y + 6.0 * k[2] * y + 2.0 * k[3] * x + prism_v * y
    return u, v, ux, uy, vx, vy


@kernel
def one_to_one_radius(packed: Floats) -> float:
    """Find the radius of (x/z, y/z) up to which the lens is invertible: where its Jacobian first becomes singular.

    Args:
        packed: (PACKED,) the camera; its limit is ignored.

    Returns:
        The radius; infinite if the lens is invertible up to 89.9 degrees.
    """
    steps, directions = 4000, 16
    radius = 0.0
    for i in range(1, steps + 1):
        r = np.tan(np.pi / 2 * 89.9 / 90.0 * i / steps)
        for j in range(directions):
            turn = 2.0 * np.pi * j / directions
            _, _, ux, uy, vx, vy = distort_with_derivative(packed, r * np.cos(turn), r * np.sin(turn))
            # Every fisheye compresses the image towards 90 degrees; (1 + r^2)^(3/2) compensates for that.
            fair = (1.0 + r * r) ** 1.5 if packed[MODEL] == 1.0 else 1.0
            if not (ux * vy - uy * vx) * fair > _LEAST_STRETCH:
                return radius
        radius = r
    return np.inf


@kernel
def _radius_before(packed: Floats, after: float) -> float:
    """Invert the radial part of the lens by bisection, between the axis and the limit."""
    low, high = 0.0, min(np.sqrt(packed[LIMIT]), 600.0)
    if distort(packed, high, 0.0)[0] <= after:
        return high
    for _ in range(60):
        middle = 0.5 * (low + high)
        if distort(packed, middle, 0.0)[0] < after:
            low = middle
        else:
            high = middle
        if high - low < 1e-6 * high:
            break
    return 0.5 * (low + high)


@kernel
def undistort(packed: Floats, u: float, v: float) -> tuple[float, float]:
    """Undistort a position in an image of focal length 1 by Newton's method; NaN where the lens is not invertible.

    Args:
        packed: (PACKED,) the camera.
        u: Right.
        v: Down.

    Returns:
        The direction (x/z, y/z).
    """
    x, y = u, v
    limit = packed[LIMIT]
    tolerance = 1e-13 * (1.0 + abs(u) + abs(v))
    restarted = False
    i = 0
    while i < 30:
        if not x * x + y * y <= limit or (i == 8 and not restarted):
            # The iteration left the range of the lens: restart from the solution of the radial part alone.
            if restarted:
                break
            restarted, i = True, 0
            length = np.sqrt(u * u + v * v)
            r = _radius_before(packed, length) / length
            x, y = 0.9999 * r * u, 0.9999 * r * v
        i += 1
        a, b, ux, uy, vx, vy = distort_with_derivative(packed, x, y)
        a, b, area = u - a, v - b, ux * vy - uy * vx
        if abs(a) + abs(b) <= tolerance:
            return x, y
        x, y = x + (vy * a - uy * b) / area, y + (ux * b - vx * a) / area
    if x * x + y * y <= limit:
        a, b = distort(packed, x, y)
        if abs(a - u) + abs(b - v) <= 1e3 * tolerance:
            return x, y
    return np.nan, np.nan


@kernel
def undistort_pixel(packed: Floats, column: float, row: float) -> tuple[float, float]:
    """Undistort a pixel: the direction (x/z, y/z) in camera axes, NaN where the lens is not invertible.

    Args:
        packed: (PACKED,) the camera.
        column: x [px].
        row: y [px].

    Returns:
        x/z and y/z.
    """
    v = (row - packed[CY]) / packed[FY]
    u = (column - packed[CX] - packed[SKEW] * v) / packed[FX]
    return undistort(packed, u, v)


@kernel
def project(packed: Floats, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Project a point of the world.

    Args:
        packed: (PACKED,) the camera.
        x: World x [m].
        y: World y [m].
        z: World z [m].

    Returns:
        Column and row [px], and one over the depth [1/m]; NaN, NaN, 0 behind the camera and beyond the
        range of the lens.
    """
    depth = packed[6] * x + packed[7] * y + packed[8] * z + packed[11]
    if not depth > 0.0:
        return np.nan, np.nan, 0.0
    inverse = 1.0 / depth
    a = (packed[0] * x + packed[1] * y + packed[2] * z + packed[9]) * inverse
    b = (packed[3] * x + packed[4] * y + packed[5] * z + packed[10]) * inverse
    if not a * a + b * b <= packed[LIMIT]:
        return np.nan, np.nan, 0.0
    u, v = distort(packed, a, b)
    return packed[FX] * u + packed[SKEW] * v + packed[CX], packed[FY] * v + packed[CY], inverse


@kernel
def project_points(packed: Floats, points: Floats, out: Floats) -> None:
    """Project many points of the world.

    Args:
        packed: (PACKED,) the camera.
        points: (n, 3) [m].
        out: (n, 3) is filled with column, row [px] and one over the depth [1/m]; NaN, NaN, 0 where there is no image.
    """
    if packed[MODEL] == 1.0:
        for i in range(len(points)):
            out[i, 0], out[i, 1], out[i, 2] = project(packed, points[i, 0], points[i, 1], points[i, 2])
    else:
        _project_radially(packed, points, out)


@kernel(error_model="numpy")
def _project_radially(packed, points, out):
    """Do what `project_points` does for the radial model, without branches, so that the loop is vectorised."""
    k = packed[LENS:LIMIT]
    lens = (k[0], k[1], k[2], k[3], k[4], k[5], k[6], k[7], k[8], k[9], k[10], k[11])
    r0, r1, r2, r3, r4, r5, r6, r7, r8 = (
        packed[0], packed[1], packed[2], packed[3], packed[4], packed[5], packed[6], packed[7], packed[8]
    )  # fmt: skip
    tx, ty, tz, limit = packed[9], packed[10], packed[11], packed[LIMIT]
    fx, skew, fy, cx, cy = packed[FX], packed[SKEW], packed[FY], packed[CX], packed[CY]
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        depth = r6 * x + r7 * y + r8 * z + tz
        inverse = 1.0 / depth
        a = (r0 * x + r1 * y + r2 * z + tx) * inverse
        b = (r3 * x + r4 * y + r5 * z + ty) * inverse
        seen = (depth > 0.0) & (a * a + b * b <= limit)
        u, v = distort_radially(lens, a, b)
        out[i, 0] = fx * u + skew * v + cx if seen else np.nan
        out[i, 1] = fy * v + cy if seen else np.nan
        out[i, 2] = inverse if seen else 0.0


@kernel
def project_points_with_derivative(packed: Floats, points: Floats, pixels: Floats, derivative: Floats) -> None:
    """Project many points of the world, with the derivatives of the pixels.

    Args:
        packed: (PACKED,) the camera.
        points: (n, 3) [m].
        pixels: (n, 2) is filled [px]; NaN where there is no image.
        derivative: (n, 2, 3) is filled [px/m]; NaN where there is no image.
    """
    fx, skew, fy, limit = packed[FX], packed[SKEW], packed[FY], packed[LIMIT]
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        depth = packed[6] * x + packed[7] * y + packed[8] * z + packed[11]
        inverse = 1.0 / depth if depth > 0.0 else np.nan
        a = (packed[0] * x + packed[1] * y + packed[2] * z + packed[9]) * inverse
        b = (packed[3] * x + packed[4] * y + packed[5] * z + packed[10]) * inverse
        if not a * a + b * b <= limit:
            inverse = np.nan
        u, v, ux, uy, vx, vy = distort_with_derivative(packed, a, b)
        pixels[i, 0] = fx * u + skew * v + packed[CX] + 0.0 * inverse
        pixels[i, 1] = fy * v + packed[CY] + 0.0 * inverse
        column_a, column_b = (fx * ux + skew * vx) * inverse, (fx * uy + skew * vy) * inverse
        row_a, row_b = fy * vx * inverse, fy * vy * inverse
        for j in range(3):
            da, db = packed[j] - a * packed[6 + j], packed[3 + j] - b * packed[6 + j]
            derivative[i, 0, j] = column_a * da + column_b * db
            derivative[i, 1, j] = row_a * da + row_b * db


@kernel
def undistort_pixels(packed: Floats, pixels: Floats, out: Floats) -> None:
    """Undistort many pixels.

    Args:
        packed: (PACKED,) the camera.
        pixels: (n, 2) [px].
        out: (n, 2) is filled with x/z and y/z; NaN where the lens is not invertible.
    """
    for i in range(len(pixels)):
        out[i, 0], out[i, 1] = undistort_pixel(packed, pixels[i, 0], pixels[i, 1])


@kernel
def contour_normals(packed: Floats, pixels: Floats, normals: Floats, out: Floats) -> None:
    """Find the planes through the camera's centre that are tangent to a solid along contours.

    The plane contains the ray of the pixel and the direction in which the ray moves along the tangent of the contour,
    both exact for the lens. Its normal points to the side of the normal of the contour.

    Args:
        packed: (PACKED,) the camera.
        pixels: (n, 2) points of contours [px].
        normals: (n, 2) normals of the contours in the image, of any length.
        out: (n, 3) is filled with unit normals of the planes, in world axes; NaN where the lens is not invertible.
    """
    fx, skew, fy = packed[FX], packed[SKEW], packed[FY]
    for i in range(len(pixels)):
        x, y = undistort_pixel(packed, pixels[i, 0], pixels[i, 1])
        _, _, ux, uy, vx, vy = distort_with_derivative(packed, x, y)
        # In the plane z = 1 the covector of the contour is that of the image times the derivative of the pixel.
        a, b = normals[i, 0] * fx, normals[i, 0] * skew + normals[i, 1] * fy
        nx, ny = a * ux + b * vx, a * uy + b * vy
        nz = -(nx * x + ny * y)
        length = np.sqrt(nx * nx + ny * ny + nz * nz)
        for j in range(3):
            out[i, j] = (packed[j] * nx + packed[3 + j] * ny + packed[6 + j] * nz) / length


@kernel
def ray_turns(packed: Floats, pixels: Floats, steps: Floats, out: Floats) -> None:
    """Measure the rotation of the ray over steps in the image: the distance between the unit rays of both ends.

    Args:
        packed: (PACKED,) the camera.
        pixels: (n, 2) centres of the steps [px].
        steps: (n, 2) [px].
        out: (n,) is filled [rad, for small steps]; NaN where the lens is not invertible.
    """
    for i in range(len(pixels)):
        dx, dy = 0.5 * steps[i, 0], 0.5 * steps[i, 1]
        ax, ay = undistort_pixel(packed, pixels[i, 0] + dx, pixels[i, 1] + dy)
        bx, by = undistort_pixel(packed, pixels[i, 0] - dx, pixels[i, 1] - dy)
        az, bz = 1.0 / np.sqrt(1.0 + ax * ax + ay * ay), 1.0 / np.sqrt(1.0 + bx * bx + by * by)
        out[i] = np.sqrt((ax * az - bx * bz) ** 2 + (ay * az - by * bz) ** 2 + (az - bz) ** 2)
