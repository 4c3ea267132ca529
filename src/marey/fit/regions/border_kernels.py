"""Kernels that fit a pose to classes of pixels: each border of a drawn part is moved to where the classes change.

A border of a part lies between two neighbouring pixels. Along a short line across it, the sum of the gains of a moved
border gives the likelihood of every place of the border, whose mean and variance enter the normal equations of the
pose. The sum of all borders' gains is the change of the score of `score_regions`.
"""

import numpy as np

from marey.body.articulation.kinematics import blend_moved_skin, pose_segments, turned
from marey.cameras.lens import project_points
from marey.fit.regions.region_kernels import (
    EMPTY,
    angle_cost,
    depth_count,
    draw_parts,
    inverse_depths,
    pixel_area,
)
from marey.fit.solver.pose_steps import solve_step_into
from marey.kernels import kernel

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
    pixel; and the posed body with its image.
    """
    cameras = shape[0]
    box = np.zeros((cameras, 4), np.int64)
    box[:, 2:] = -1
    posed, projected = np.empty((vertices, 3)), np.empty((vertices, 3))
    return (
        np.full(shape, EMPTY), np.zeros(shape, np.int16), np.zeros(shape, np.float32), box, np.zeros(cameras), posed,
        projected,
    )  # fmt: skip


@kernel
def _draw(rest, numbers, segments, views, table, canvas):
    """Draw a posed body with the numbers of its faces; return the log-likelihood ratio of its region [nat m2]."""
    _, _, _, joints, vertices, vertex_segments, vertex_weights, faces, face_part = rest
    cameras, widths, heights, focal, words, evidence = views
    order, face, value, boxes, area, posed, projected = canvas
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
        draw_parts(
            projected, faces, numbers, all_faces, order[c, : heights[c], : widths[c]], face[c], box
        )  # fmt: skip
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
    order, face, _, boxes, _, _, _ = canvas
    sums, touched = np.zeros((faces.shape[0], 4)), np.empty(faces.shape[0], np.int64)
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
            _add_face(rest, segments, views, canvas, c, f, sums[f], face_segment, hessian, gradient)
            sums[f] = 0.0


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
    order, face, value, _, _, _, _ = canvas
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
    order, face, value, _, _, _, _ = canvas
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
def _add_face(rest, segments, views, canvas, c, f, sums, face_segment, hessian, gradient):
    """Add the borders of a face in one image to the normal equations.

    Args:
        rest: See `score_regions`.
        segments: Rotations and origins of the segments, and axes of the coordinates.
        views: See `score_regions`.
        canvas: See `_canvas`.
        c: The camera.
        f: The face.
        sums: (4,) information, and its product with the mean, of borders along rows and along columns.
        face_segment: (T,) segment that moves each face.
        hessian: (D, D), whose lower triangle is changed.
        gradient: (D,) is changed.
    """
    parents, coordinate_segment, faces = rest[0], rest[1], rest[7]
    _, origin, world_axes = segments
    packed, focal, area, posed = views[0][c], views[3][c], canvas[4][c], canvas[5]
    point, across = np.empty(3), np.empty(3)
    row, column = np.empty(hessian.shape[0]), np.empty(hessian.shape[0], np.int64)
    for a in range(3):
        point[a] = (posed[faces[f, 0], a] + posed[faces[f, 1], a] + posed[faces[f, 2], a]) / 3.0
    depth = packed[6] * point[0] + packed[7] * point[1] + packed[8] * point[2] + packed[11]
    for axis in range(2):
        information, pull = sums[2 * axis], sums[2 * axis + 1]
        if information == 0.0:
            continue
        # The lens is neglected: it changes the direction in which an image point moves by a few degrees only.
        aside = packed[9 + axis]
        for a in range(3):
            aside += packed[3 * axis + a] * point[a]
        for a in range(3):
            across[a] = focal * (packed[3 * axis + a] - aside / depth * packed[6 + a]) / depth
        count = _row(parents, coordinate_segment, origin, world_axes, face_segment[f], point, across, row, column)
        for i in range(count):
            gradient[column[i]] -= area * pull * row[i]
            weighted = area * information * row[i]
            for k in range(i + 1):
                # Columns descend towards the root.
                hessian[max(column[i], column[k]), min(column[i], column[k])] += weighted * row[k]


@kernel
def _row(parents, coordinate_segment, origin, world_axes, segment, point, across, row, column):
    """Write the derivatives of a moved point along a direction by those coordinates that move it; return how many."""
    for a in range(3):
        row[a], column[a], column[3 + a] = across[a], a, 3 + a
    row[3], row[4], row[5] = _torque(point, origin[0], across)
    count = 6
    i = world_axes.shape[0] - 1
    while segment >= 0:
        t0, t1, t2 = _torque(point, origin[segment], across)
        while i >= 0 and coordinate_segment[i] > segment:
            i -= 1
        while i >= 0 and coordinate_segment[i] == segment:
            row[count] = world_axes[i, 0] * t0 + world_axes[i, 1] * t1 + world_axes[i, 2] * t2
            column[count] = 6 + i
            count += 1
            i -= 1
        segment = parents[segment]
    return count


@kernel
def _torque(point, centre, across):
    """Return the derivative of a point along a direction by a rotation about three axes through a centre."""
    dx, dy, dz = point[0] - centre[0], point[1] - centre[1], point[2] - centre[2]
    return dy * across[2] - dz * across[1], dz * across[0] - dx * across[2], dx * across[1] - dy * across[0]


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
