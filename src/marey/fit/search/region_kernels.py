"""Kernels that compare poses with the classes of the pixels that the body covers; no silhouettes are needed."""

import numpy as np

from marey.body.articulation.kinematics import blend_skin, pose_segments, turned
from marey.cameras.lens import project_points
from marey.kernels import kernel

DEPTH_STRIDE = 7
"""Every how many vertices enter the mean depth of the body. Chosen by hand."""


@kernel
def draw_parts(projected, faces, face_part, stamp, canvas, nearness, part, box):
    """Draw the parts of a body into an image; nearer faces hide farther ones.

    Args:
        projected: (V, 3) columns and rows [px], and inverse depths.
        faces: (T, 3).
        face_part: (T,) part of each face.
        stamp: Number of this drawing; a pixel of `canvas` with another number is empty.
        canvas: (h, w) of int32.
        nearness: (h, w) receives three times the inverse depth of the nearest face.
        part: (h, w) receives its part.
        box: (4,) receives the first column and row, and the last column and row, of the drawing.
    """
    height, width = canvas.shape
    box[0], box[1], box[2], box[3] = width, height, -1, -1
    for f in range(faces.shape[0]):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        x0, y0 = projected[a, 0], projected[a, 1]
        x1, y1 = projected[b, 0], projected[b, 1]
        x2, y2 = projected[c, 0], projected[c, 1]
        area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
        # A point outside the lens' range is NaN, and the comparison is false.
        if not area < 0.0:
            continue
        xmin = max(0, int(np.ceil(min(x0, min(x1, x2)))))
        xmax = min(width - 1, int(np.floor(max(x0, max(x1, x2)))))
        ymin = max(0, int(np.ceil(min(y0, min(y1, y2)))))
        ymax = min(height - 1, int(np.floor(max(y0, max(y1, y2)))))
        near = projected[a, 2] + projected[b, 2] + projected[c, 2]
        d0, d1 = -(y2 - y1) / area, -(y0 - y2) / area
        for y in range(ymin, ymax + 1):
            e0 = ((x2 - x1) * (y - y1) - (y2 - y1) * (xmin - x1)) / area
            e1 = ((x0 - x2) * (y - y2) - (y0 - y2) * (xmin - x2)) / area
            for x in range(xmin, xmax + 1):
                if e0 >= 0.0 and e1 >= 0.0 and e0 + e1 <= 1.0 and (canvas[y, x] != stamp or near > nearness[y, x]):
                    canvas[y, x] = stamp
                    nearness[y, x] = near
                    part[y, x] = face_part[f]
                    box[0], box[1] = min(box[0], x), min(box[1], y)
                    box[2], box[3] = max(box[2], x), max(box[3], y)
                e0 += d0
                e1 += d1


@kernel
def _pixel_area(projected, focal):
    """Return the area that a pixel covers at the body's mean depth [m2]."""
    total, count = 0.0, 0
    for v in range(0, projected.shape[0], DEPTH_STRIDE):
        total += projected[v, 2]
        count += 1
    mean = total / count * focal
    # Behind the camera, or outside the lens' range, nothing is drawn, and the area does not matter.
    return 1.0 / (mean * mean) if mean > 0.0 else 0.0


@kernel
def _score_pose(rest, rotation, translation, angles, views, table, stamp, canvases, projected, box):
    parents, coordinate_segment, axes, joints, vertices, vertex_segments, vertex_weights, faces, face_part = rest
    cameras, widths, heights, focal, words, evidence = views
    canvas, nearness, part = canvases
    turns, origins, _ = pose_segments(parents, coordinate_segment, axes, joints, rotation, translation, angles)
    posed = blend_skin(vertices, vertex_segments, vertex_weights, joints, turns, origins)
    score = 0.0
    for c in range(cameras.shape[0]):
        project_points(cameras[c], posed, projected)
        view = canvas[c, : heights[c], : widths[c]]
        draw_parts(projected, faces, face_part, stamp, view, nearness[c], part[c], box)
        own = 0.0
        for y in range(box[1], box[3] + 1):
            for x in range(box[0], box[2] + 1):
                if view[y, x] == stamp:
                    own += table[c, part[c, y, x], words[c, y, x]] + evidence[c, y, x]
        score += own * _pixel_area(projected, focal[c])
    return score


@kernel
def score_regions(rest, rotations, translations, angles, views, table):
    """Return the log-likelihood ratio of person and background in the region of many poses (n,) [nat m2].

    Args:
        rest: The body at rest: parents, coordinate_segment, axes, joints, vertices, vertex_segments, vertex_weights,
            faces and the part of each face; see `Body`.
        rotations: (n, 3, 3) of the root.
        translations: (n, 3).
        angles: (n, D - 6).
        views: cameras (C, P) packed, widths (C,), heights (C,), focal lengths (C,) [px], words (C, h, w) of the pixels,
            and the log-likelihood ratio (C, h, w) of other evidence, padded to a common size.
        table: (C, parts, K) log-likelihood ratio of each word in each part.
    """
    shape = views[4].shape
    canvases = np.zeros(shape, np.int32), np.zeros(shape, np.float32), np.zeros(shape, np.int8)
    projected, box = np.empty((rest[4].shape[0], 3)), np.empty(4, np.int64)
    scores = np.empty(rotations.shape[0])
    for n in range(rotations.shape[0]):
        scores[n] = _score_pose(
            rest, rotations[n], translations[n], angles[n], views, table, n + 1, canvases, projected, box
        )
    return scores


@kernel
def count_words(rest, rotations, translations, angles, views, parts, count):
    """Return the area of each word in each part (n, C, parts, count) [m2] for many poses; see `score_regions`."""
    parents, coordinate_segment, axes, joints, vertices, vertex_segments, vertex_weights, faces, face_part = rest
    cameras, widths, heights, focal, words, _ = views
    canvas, nearness, part = (
        np.zeros(words.shape, np.int32),
        np.zeros(words.shape, np.float32),
        np.zeros(words.shape, np.int8),
    )
    projected, box = np.empty((vertices.shape[0], 3)), np.empty(4, np.int64)
    areas = np.zeros((rotations.shape[0], cameras.shape[0], parts, count), np.float32)
    for n in range(rotations.shape[0]):
        turns, origins, _ = pose_segments(
            parents, coordinate_segment, axes, joints, rotations[n], translations[n], angles[n]
        )
        posed = blend_skin(vertices, vertex_segments, vertex_weights, joints, turns, origins)
        for c in range(cameras.shape[0]):
            project_points(cameras[c], posed, projected)
            view = canvas[c, : heights[c], : widths[c]]
            draw_parts(projected, faces, face_part, n + 1, view, nearness[c], part[c], box)
            area = np.float32(_pixel_area(projected, focal[c]))
            for y in range(box[1], box[3] + 1):
                for x in range(box[0], box[2] + 1):
                    if view[y, x] == n + 1:
                        areas[n, c, part[c, y, x], words[c, y, x]] += area
    return areas


@kernel
def angle_cost(angles, habit, near, weight):
    """Return the cost of joint angles [nat m2]: of unusual ones, of those beyond their limits, and of a change.

    Args:
        angles: (D - 6,) [rad].
        habit: Usual angles, their standard deviations, lower and upper limits, and the reciprocal of the standard
            deviation of an excess.
        near: Predicted angles, and the reciprocals of the standard deviations of the changes from them.
        weight: Weight of a squared deviation [m2].
    """
    mean, sd, low, high, excess = habit
    predicted, change = near
    total = 0.0
    for i in range(angles.shape[0]):
        unusual = (angles[i] - mean[i]) / sd[i]
        beyond = (min(angles[i] - low[i], 0.0) + max(angles[i] - high[i], 0.0)) * excess
        changed = (angles[i] - predicted[i]) * change[i]
        total += unusual * unusual + beyond * beyond + changed * changed
    return weight * total


@kernel
def climb_regions(rest, rotation, translation, angles, views, table, habit, near, weight, steps, metres):
    """Improve a pose by changes of single coordinates.

    Args:
        rest: See `score_regions`; so are the next five.
        rotation: (3, 3).
        translation: (3,).
        angles: (D - 6,).
        views: See `score_regions`.
        table: See `score_regions`.
        habit: See `angle_cost`; so are the next two.
        near: See `angle_cost`.
        weight: See `angle_cost`.
        steps: Sizes of the changes, from large to small [rad].
        metres: Change of a position for a change of an angle [m/rad].

    Returns:
        The score less the cost [nat m2], and the rotation, translation and angles.
    """
    shape = views[4].shape
    canvases = np.zeros(shape, np.int32), np.zeros(shape, np.float32), np.zeros(shape, np.int8)
    projected, box = np.empty((rest[4].shape[0], 3)), np.empty(4, np.int64)
    stamp, count = 1, 6 + angles.shape[0]
    best = _score_pose(rest, rotation, translation, angles, views, table, stamp, canvases, projected, box)
    best -= angle_cost(angles, habit, near, weight)
    signs, turn = np.ones(count), np.zeros(3)
    for step in steps:
        for i in range(count):
            for attempt in range(2):
                sign = signs[i] if attempt == 0 else -signs[i]
                turns, place, bent = rotation, translation, angles
                if i < 3:
                    place = translation.copy()
                    place[i] += sign * step * metres
                elif i < 6:
                    turn[:] = 0.0
                    turn[i - 3] = sign * step
                    turns = turned(rotation, turn)
                else:
                    bent = angles.copy()
                    bent[i - 6] += sign * step
                stamp += 1
                score = _score_pose(rest, turns, place, bent, views, table, stamp, canvases, projected, box)
                score -= angle_cost(bent, habit, near, weight)
                if score > best:
                    best, rotation, translation, angles = score, turns, place, bent
                    signs[i] = sign
                    break
    return best, rotation, translation, angles
