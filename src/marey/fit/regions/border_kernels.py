"""Kernels that fit a pose to classes of pixels: each border of a drawn part is moved to where the classes change.

A border of a part lies between two neighbouring pixels. Along a short line across it, the sum of the gains of a moved
border gives the likelihood of every place of the border, whose mean and variance enter the normal equations of the
pose. The sum of all borders' gains is the change of the score of `score_regions`.
"""

import numpy as np

from marey.body.articulation.kinematics import blend_moved_skin, pose_segments, turned
from marey.cameras.lens import project_points
from marey.compiled.kernels import kernel
from marey.fit.regions.region_kernels import (
    EMPTY,
    angle_cost,
    canvases,
    depth_count,
    draw_parts,
    image_of,
    inverse_depths,
    pixel_area,
)
from marey.fit.solver.pose_steps import solve_step_into

PLACE_VARIANCE = 0.25
"""Variance of the place of a border beside that of its likelihood [px2]: the body is drawn in whole pixels. Chosen by
hand."""
LEAST_INFORMATION = 1e-3
"""Information about the place of a border below which it is left out [1/px2]. Chosen by hand."""
NEARER_M = 0.2
"""Distance by which another part must be nearer to a camera to hide a border that would move behind it [m]. Chosen by
hand."""
SHRINK, ATTEMPTS = 0.4, 3
"""Factor by which a step is shortened that does not raise the score, and largest number of lengths that are tried.
Chosen by hand."""
MOMENTS = 7
"""Rows of the moments of a segment's borders: six numbers of each border, and the mean of its place."""
FINISHED_RAD = 0.002
"""Largest change of an angle in a step after which a fit is finished, if its lines are as short as the last ones [rad].
Chosen by hand."""


@kernel
def fit_borders(
    rest, rotation, translation, angles, views, table, habit, near, weight, reaches, face_segment
):  # fmt: skip
    """Improve a pose by Gauss-Newton steps on the places of the borders of its parts.

    Args:
        rest: See `score_regions`.
        rotation: (3, 3) of the root.
        translation: (3,) of the root [m].
        angles: (D - 6,) [rad].
        views: See `score_regions`.
        table: See `score_regions`.
        habit: See `angle_cost`.
        near: See `angle_cost`.
        weight: See `angle_cost`.
        reaches: (n,) half lengths of the lines of each step [px].
        face_segment: (T,) segment that moves each face.

    Returns:
        The score less the cost [nat m2], and the rotation, translation and angles.
    """
    parents, coordinate_segment, axes, joints = rest[0], rest[1], rest[2], rest[3]
    canvas = _canvas(views[4].shape, rest[4].shape[0])
    numbers = np.arange(rest[7].shape[0]).astype(np.int16)
    degrees = 6 + angles.shape[0]
    hessian, gradient = np.empty((degrees, degrees)), np.empty(degrees)
    factor, change = np.empty((degrees, degrees)), np.empty(degrees)
    segments = pose_segments(parents, coordinate_segment, axes, joints, rotation, translation, angles)
    best = _draw(rest, numbers, segments, views, table, canvas) - angle_cost(angles, habit, near, weight)
    for n in range(reaches.shape[0]):
        hessian[:] = 0.0
        gradient[:] = 0.0
        _add_borders(rest, segments, views, table, canvas, reaches[n], face_segment, hessian, gradient)
        _add_angle_costs(angles, habit, near, weight, hessian, gradient)
        if not solve_step_into(hessian, gradient, factor, change):
            break
        raised = False
        for _ in range(ATTEMPTS):
            turns = turned(rotation, change[3:6])
            place, bent = translation + change[:3], angles + change[6:]
            segments = pose_segments(parents, coordinate_segment, axes, joints, turns, place, bent)
            score = _draw(rest, numbers, segments, views, table, canvas) - angle_cost(bent, habit, near, weight)
            raised = score > best
            if raised:
                best, rotation, translation, angles = score, turns, place, bent
                break
            change *= SHRINK
        if reaches[n] == reaches[-1] and (not raised or np.abs(change[3:]).max() < FINISHED_RAD):
            break
        if not raised:
            segments = pose_segments(parents, coordinate_segment, axes, joints, rotation, translation, angles)
            _draw(rest, numbers, segments, views, table, canvas)
    return best, rotation, translation, angles


@kernel
def _canvas(shape, vertices):
    """Return what `_draw` fills.

    These are, of each camera, the orders of faces, the faces, the values of pixels, the drawn box and the area of a
    pixel; the posed body with its image; and the orders and the faces as flat images.
    """
    cameras = shape[0]
    count = cameras * shape[1] * shape[2]
    order, face = canvases(shape, np.int16)
    box = np.zeros((cameras, 4), np.int64)
    box[:, 2:] = -1
    posed, projected = np.empty((vertices, 3)), np.empty((vertices, 3))
    return (
        order[:count].reshape(shape), face[:count].reshape(shape), np.zeros(shape, np.float32), box, np.zeros(cameras),
        posed, projected, order, face,
    )  # fmt: skip


@kernel
def _draw(rest, numbers, segments, views, table, canvas):
    """Draw a posed body with the numbers of its faces; return the log-likelihood ratio of its region [nat m2]."""
    _, _, _, joints, vertices, vertex_segments, vertex_weights, faces, face_part = rest
    cameras, widths, heights, focal, words, evidence = views
    order, face, value, boxes, area, posed, projected, flat_order, flat_face = canvas
    every, all_faces = np.ones(vertices.shape[0], np.bool_), np.arange(faces.shape[0])
    blend_moved_skin(vertices, vertex_segments, vertex_weights, joints, segments[0], segments[1], every, posed)
    score = 0.0
    for c in range(cameras.shape[0]):
        box = boxes[c]
        for y in range(box[1], box[3] + 1):
            for x in range(box[0], box[2] + 1):
                order[c, y, x] = EMPTY
                value[c, y, x] = 0.0
        project_points(cameras[c], posed, projected)
        image = image_of(c, words.shape, widths, heights)
        draw_parts(projected, faces, numbers, all_faces, flat_order, flat_face, image, box)
        own = 0.0
        for y in range(box[1], box[3] + 1):
            for x in range(box[0], box[2] + 1):
                if order[c, y, x] > EMPTY:
                    value[c, y, x] = table[c, face_part[face[c, y, x]], words[c, y, x]] + evidence[c, y, x]
                    own += value[c, y, x]
        area[c] = pixel_area(inverse_depths(projected, every, True), depth_count(vertices), focal[c])
        score += own * area[c]
    return score


@kernel
def _add_borders(rest, segments, views, table, canvas, reach, face_segment, hessian, gradient):
    """Add the places of all borders of parts to the normal equations, those of each face and direction as one."""
    cameras, widths, heights, _, _, _ = views
    faces, face_part = rest[7], rest[8]
    order, face, _, boxes = canvas[:4]
    sums, touched = np.zeros((faces.shape[0], 4)), np.empty(faces.shape[0], np.int64)
    moments = np.zeros((segments[1].shape[0], MOMENTS, MOMENTS))
    course = np.empty(2 * reach + 1)
    for c in range(cameras.shape[0]):
        count = 0
        for y in range(max(boxes[c, 1] - 1, 0), min(boxes[c, 3], heights[c] - 2) + 1):
            for x in range(max(boxes[c, 0] - 1, 0), min(boxes[c, 2], widths[c] - 2) + 1):
                here = order[c, y, x]
                for axis in range(2):
                    beside_x, beside_y = x + 1 - axis, y + axis
                    beside = order[c, beside_y, beside_x]
                    if here == EMPTY and beside == EMPTY:
                        continue
                    if (
                        here > EMPTY and beside > EMPTY
                        and face_part[face[c, y, x]] == face_part[face[c, beside_y, beside_x]]
                    ):  # fmt: skip
                        continue
                    sign = 1 if here >= beside else -1
                    own_x, own_y = (x, y) if sign > 0 else (beside_x, beside_y)
                    information, pull = _place(
                        c, own_x, own_y, sign * (1 - axis), sign * axis, reach, face_part, views, table, canvas, course
                    )
                    if information > 0.0:
                        f = face[c, own_y, own_x]
                        if sums[f, 0] == 0.0 and sums[f, 2] == 0.0:
                            touched[count] = f
                            count += 1
                        sums[f, 2 * axis] += information
                        sums[f, 2 * axis + 1] += sign * pull
        for f in touched[:count]:
            _add_face(faces[f], views, canvas, c, sums[f], moments[face_segment[f]])
            sums[f] = 0.0
    for segment in range(moments.shape[0]):
        if moments[segment, 0, 0] + moments[segment, 1, 1] + moments[segment, 2, 2] > 0.0:
            _add_segment(rest, segments, segment, moments[segment], hessian, gradient)


@kernel
def _place(c, x, y, dx, dy, reach, face_part, views, table, canvas, course):
    """Measure the place of a border along the line from the last pixel (x, y) of the nearer part outward (dx, dy).

    Args:
        c: The camera.
        x: Column.
        y: Row.
        dx: -1, 0 or 1.
        dy: -1, 0 or 1.
        reach: Half length of the line [px].
        face_part: (T,) part of each face.
        views: See `score_regions`.
        table: See `score_regions`.
        canvas: See `_canvas`.
        course: (2 reach + 1,) receives the gain of the score by each place [nat].

    Returns:
        The information about the place [1/px2], and its product with the mean [1/px]; 0 if there is hardly any.
    """
    first = -_gains_inward(c, x, y, dx, dy, reach, face_part, views, table, canvas, course)
    last = _gains_outward(c, x, y, dx, dy, reach, face_part, views, table, canvas, course)
    best = 0.0
    for d in range(first, last + 1):
        best = max(best, course[reach + d])
    total = mean = square = 0.0
    for d in range(first, last + 1):
        share = np.exp(course[reach + d] - best)
        total += share
        mean += share * d
        square += share * d * d
    mean /= total
    variance = square / total - mean * mean + PLACE_VARIANCE
    # A line without any change of classes says nothing: its places are evenly distributed.
    even = ((last - first + 1) ** 2 - 1) / 12.0 + PLACE_VARIANCE
    information = 1.0 / variance - 1.0 / even
    if information < LEAST_INFORMATION:
        return 0.0, 0.0
    return information, mean / variance - 0.5 * (first + last) / even


@kernel
def _gains_outward(c, x, y, dx, dy, reach, face_part, views, table, canvas, course):
    """Write the gains of a border that moves outward; return how far it can move [px]. See `_place`."""
    _, widths, heights, _, words, evidence = views
    order, face, value = canvas[:3]
    part, own = face_part[face[c, y, x]], order[c, y, x]
    nearest = own + NEARER_M * own * own / 3.0
    course[reach] = 0.0
    for d in range(1, reach + 1):
        column, row = x + d * dx, y + d * dy
        if column < 0 or row < 0 or column >= widths[c] or row >= heights[c] or order[c, row, column] > nearest:
            return d - 1
        gain = table[c, part, words[c, row, column]] + evidence[c, row, column] - value[c, row, column]
        course[reach + d] = course[reach + d - 1] + gain
    return reach


@kernel
def _gains_inward(c, x, y, dx, dy, reach, face_part, views, table, canvas, course):
    """Write the gains of a border that moves inward; return how far it can move [px]. See `_place`."""
    _, widths, heights, _, words, evidence = views
    order, face, value = canvas[:3]
    part, behind = face_part[face[c, y, x]], -1
    if order[c, y + dy, x + dx] > EMPTY:
        behind = face_part[face[c, y + dy, x + dx]]
    course[reach] = 0.0
    for d in range(reach):
        column, row = x - d * dx, y - d * dy
        if column < 0 or row < 0 or column >= widths[c] or row >= heights[c] or order[c, row, column] == EMPTY:
            return d
        if face_part[face[c, row, column]] != part:
            return d
        gain = -value[c, row, column]
        if behind >= 0:
            gain += table[c, behind, words[c, row, column]] + evidence[c, row, column]
        course[reach - d - 1] = course[reach - d] + gain
    return reach


@kernel
def _add_face(corners, views, canvas, c, sums, moments):
    """Add the borders of a face in one image to the moments of its segment.

    The derivative of a point p along a direction a, by any motion of its segment, is a linear function of the six
    numbers (a, p x a). Their weighted products therefore determine the normal equations.

    Args:
        corners: (3,) vertices of the face.
        views: See `score_regions`.
        canvas: See `_canvas`.
        c: The camera.
        sums: (4,) information, and its product with the mean, of borders along rows and along columns.
        moments: (MOMENTS, MOMENTS), whose lower triangle is changed; the last row is that of the mean.
    """
    packed, focal, area, posed = views[0][c], views[3][c], canvas[4][c], canvas[5]
    p0 = (posed[corners[0], 0] + posed[corners[1], 0] + posed[corners[2], 0]) / 3.0
    p1 = (posed[corners[0], 1] + posed[corners[1], 1] + posed[corners[2], 1]) / 3.0
    p2 = (posed[corners[0], 2] + posed[corners[1], 2] + posed[corners[2], 2]) / 3.0
    depth = packed[6] * p0 + packed[7] * p1 + packed[8] * p2 + packed[11]
    for axis in range(2):
        information, pull = area * sums[2 * axis], area * sums[2 * axis + 1]
        if information == 0.0:
            continue
        # The lens is neglected: it changes the direction in which an image point moves by a few degrees only.
        k = 3 * axis
        aside = (packed[k] * p0 + packed[k + 1] * p1 + packed[k + 2] * p2 + packed[9 + axis]) / depth
        scale = focal / depth
        a0 = scale * (packed[k] - aside * packed[6])
        a1 = scale * (packed[k + 1] - aside * packed[7])
        a2 = scale * (packed[k + 2] - aside * packed[8])
        six = (a0, a1, a2, p1 * a2 - p2 * a1, p2 * a0 - p0 * a2, p0 * a1 - p1 * a0)
        for i in range(6):
            weighted = information * six[i]
            for j in range(i + 1):
                moments[i, j] += weighted * six[j]
            moments[6, i] += pull * six[i]


@kernel
def _add_segment(rest, segments, segment, moments, hessian, gradient):
    """Add the moments of a segment's borders, see `_add_face`, to the normal equations.

    Args:
        rest: See `score_regions`.
        segments: Rotations and origins of the segments, and axes of the coordinates.
        segment: The segment.
        moments: (MOMENTS, MOMENTS) its moments.
        hessian: (D, D), whose lower triangle is changed.
        gradient: (D,) is changed.
    """
    parents, coordinate_segment = rest[0], rest[1]
    _, origin, world_axes = segments
    motions, column = np.zeros((hessian.shape[0], 6)), np.empty(hessian.shape[0], np.int64)
    for a in range(3):
        motions[a, a], column[a] = 1.0, a
        motions[3 + a, 3 + a], column[3 + a] = 1.0, 3 + a
        _set_lever(motions[3 + a], origin[0])
    count = 6
    i, ancestor = world_axes.shape[0] - 1, segment
    while ancestor >= 0:
        while i >= 0 and coordinate_segment[i] > ancestor:
            i -= 1
        while i >= 0 and coordinate_segment[i] == ancestor:
            motions[count, 3:] = world_axes[i]
            _set_lever(motions[count], origin[ancestor])
            column[count] = 6 + i
            count += 1
            i -= 1
        ancestor = parents[ancestor]
    product = np.empty(6)
    for n in range(count):
        for i in range(6):
            product[i] = 0.0
            for j in range(6):
                product[i] += moments[max(i, j), min(i, j)] * motions[n, j]
            gradient[column[n]] -= moments[6, i] * motions[n, i]
        for m in range(n + 1):
            change = 0.0
            for i in range(6):
                change += product[i] * motions[m, i]
            # Columns of joints descend towards the root.
            hessian[max(column[n], column[m]), min(column[n], column[m])] += change


@kernel
def _set_lever(motion, centre):
    """Write the first three of the six factors of a rotation through a centre from its axis, the last three."""
    u0, u1, u2 = motion[3], motion[4], motion[5]
    motion[0] = centre[1] * u2 - centre[2] * u1
    motion[1] = centre[2] * u0 - centre[0] * u2
    motion[2] = centre[0] * u1 - centre[1] * u0


@kernel
def _add_angle_costs(angles, habit, near, weight, hessian, gradient):
    """Add the cost of joint angles, see `angle_cost`, to the normal equations."""
    mean, sd, low, high, excess = habit
    predicted, change = near
    for i in range(angles.shape[0]):
        usual, changed = 1.0 / (sd[i] * sd[i]), change[i] * change[i]
        beyond = min(angles[i] - low[i], 0.0) + max(angles[i] - high[i], 0.0)
        excessive = excess * excess if beyond != 0.0 else 0.0
        hessian[6 + i, 6 + i] += 2.0 * weight * (usual + changed + excessive)
        gradient[6 + i] += (
            2.0 * weight * ((angles[i] - mean[i]) * usual + (angles[i] - predicted[i]) * changed + beyond * excessive)
        )
