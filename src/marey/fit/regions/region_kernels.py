"""Kernels that compare poses with the classes of the pixels that the body covers; no silhouettes are needed."""

import numpy as np

from marey.body.articulation.kinematics import blend_moved_skin, blend_skin, pose_segments, turned
from marey.cameras.lens import project_points
from marey.compiled.kernel_copies import copy_row
from marey.compiled.kernels import kernel
from marey.lanes import LANES, lowest_bit, paint_flat_row, take_larger

DEPTH_STRIDE = 7
"""Every how many vertices enter the mean depth of the body. Chosen by hand."""


EMPTY = np.float32(-1.0)
"""Order of a pixel on which no face is drawn; those of faces are positive [1/m]."""


@kernel
def draw_parts(projected, faces, face_part, chosen, order, part, image, box):
    """Draw the parts of a body into an image; nearer faces hide farther ones.

    Args:
        projected: (V, 3) columns and rows [px], and inverse depths.
        faces: (T, 3).
        face_part: (T,) part of each face.
        chosen: (n,) numbers of the faces that are drawn.
        order: flat images of float32, `LANES` numbers longer than these: `EMPTY` or the faces that were drawn before;
            receives three times the inverse depth of the nearest face [1/m].
        part: of the same length, receives its part.
        image: place of the image's first pixel in them, numbers from row to row, width and height [px].
        box: (4,) receives the first column and row, and the last column and row, of the drawn faces' boxes.
    """
    first, stride, width, height = image
    left, top, right, bottom = width, height, -1, -1
    for i in range(chosen.shape[0]):
        f = chosen[i]
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
        if xmin > xmax or ymin > ymax:
            continue
        left, top = min(left, xmin), min(top, ymin)
        right, bottom = max(right, xmax), max(bottom, ymax)
        own, colour = np.float32(projected[a, 2] + projected[b, 2] + projected[c, 2]), face_part[f]
        scale = 1.0 / area
        across0, across1 = -(y2 - y1) * scale, -(y0 - y2) * scale
        down0, down1 = (x2 - x1) * scale, (x0 - x2) * scale
        e0 = (xmin - x1) * across0 + (ymin - y1) * down0
        e1 = (xmin - x2) * across1 + (ymin - y2) * down1
        step0, step1 = np.float32(across0), np.float32(across1)
        for y in range(ymin, ymax + 1):
            for x in range(xmin, xmax + 1, LANES):
                on = float(x - xmin)
                paint_flat_row(
                    order, part, first + y * stride + x, xmax + 1 - x, (np.float32(e0 + on * across0), step0),
                    (np.float32(e1 + on * across1), step1), own, colour,
                )  # fmt: skip
            e0 += down0
            e1 += down1
    box[0], box[1], box[2], box[3] = left, top, right, bottom


@kernel
def image_of(c, shape, widths, heights):
    """Return the place of a camera's image among flat images (C, h, w), see `draw_parts`."""
    return c * shape[1] * shape[2], shape[2], widths[c], heights[c]


@kernel
def canvases(shape, parts):
    """Return empty flat images of the orders of faces, and images of parts or faces of a type, see `draw_parts`."""
    count = shape[0] * shape[1] * shape[2] + LANES
    return np.full(count, EMPTY), np.zeros(count, parts)


@kernel
def _take_nearer(order, still, image, box, found):
    """List the drawn pixels of an image that are nearer than what is at rest, and empty all pixels that were drawn.

    Args:
        order: See `draw_parts`.
        still: flat images of the orders of what is at rest, or `EMPTY` if nothing is.
        image: See `draw_parts`; so is the next one.
        box: (4,).
        found: receives the places of the pixels in the flat images.

    Returns:
        The number of these pixels.
    """
    count = 0
    for y in range(box[1], box[3] + 1):
        row = image[0] + y * image[1]
        # The last eight pixels may reach beyond the box, where they are empty or belong to a next row: each pixel is
        # emptied where it is found, and therefore found once.
        for at in range(row + box[0], row + box[2] + 1, LANES):
            bits = take_larger(order, still, at, EMPTY)
            while bits != 0:
                found[count] = at + lowest_bit(bits)
                count += 1
                bits &= bits - 1
    return count


@kernel
def pixel_area(inverse_depths, count, focal):
    """Return the area that a pixel covers at the mean depth of vertices [m2], from the sum of inverse depths."""
    mean = inverse_depths / count * focal
    # Behind the camera, or outside the lens' range, nothing is drawn, and the area does not matter.
    return 1.0 / (mean * mean) if mean > 0.0 else 0.0


@kernel
def inverse_depths(projected, moves, moving):
    """Return the sum of the inverse depths of every `DEPTH_STRIDE`-th vertex, of those that move or do not."""
    total = 0.0
    for v in range(0, projected.shape[0], DEPTH_STRIDE):
        if moves[v] == moving:
            total += projected[v, 2]
    return total


@kernel
def depth_count(vertices):
    """Return how many vertices `inverse_depths` adds up, moving or not."""
    return (vertices.shape[0] + DEPTH_STRIDE - 1) // DEPTH_STRIDE


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
    parents, coordinate_segment, axes, joints, vertices, vertex_segments, vertex_weights, faces, face_part = rest
    cameras, widths, heights, focal, words, evidence = views
    order, part = canvases(words.shape, np.int8)
    flat_words, flat_evidence = words.ravel(), evidence.ravel()
    projected, box, found = np.empty((vertices.shape[0], 3)), np.empty(4, np.int64), np.empty(order.shape[0], np.int64)
    every, all_faces = np.ones(vertices.shape[0], np.bool_), np.arange(faces.shape[0])
    scores = np.zeros(rotations.shape[0])
    for n in range(rotations.shape[0]):
        turns, origins, _ = pose_segments(
            parents, coordinate_segment, axes, joints, rotations[n], translations[n], angles[n]
        )
        posed = blend_skin(vertices, vertex_segments, vertex_weights, joints, turns, origins)
        for c in range(cameras.shape[0]):
            project_points(cameras[c], posed, projected)
            image = image_of(c, words.shape, widths, heights)
            draw_parts(projected, faces, face_part, all_faces, order, part, image, box)
            own = 0.0
            for k in range(_take_nearer(order, EMPTY, image, box, found)):
                i = found[k]
                own += table[c, part[i], flat_words[i]] + flat_evidence[i]
            scores[n] += own * pixel_area(
                inverse_depths(projected, every, True), depth_count(vertices), focal[c]
            )  # fmt: skip
    return scores


@kernel
def count_words(rest, rotations, translations, angles, views, parts, count):
    """Return the area of each word in each part (n, C, parts, count) of many poses [m2]; see `score_regions`."""
    parents, coordinate_segment, axes, joints, vertices, vertex_segments, vertex_weights, faces, face_part = rest
    cameras, widths, heights, focal, words, _ = views
    order, part = canvases(words.shape, np.int8)
    flat_words = words.ravel()
    projected, box, found = np.empty((vertices.shape[0], 3)), np.empty(4, np.int64), np.empty(order.shape[0], np.int64)
    every, all_faces = np.ones(vertices.shape[0], np.bool_), np.arange(faces.shape[0])
    areas = np.zeros((rotations.shape[0], cameras.shape[0], parts, count), np.float32)
    for n in range(rotations.shape[0]):
        turns, origins, _ = pose_segments(
            parents, coordinate_segment, axes, joints, rotations[n], translations[n], angles[n]
        )
        posed = blend_skin(vertices, vertex_segments, vertex_weights, joints, turns, origins)
        for c in range(cameras.shape[0]):
            project_points(cameras[c], posed, projected)
            image = image_of(c, words.shape, widths, heights)
            draw_parts(projected, faces, face_part, all_faces, order, part, image, box)
            area = np.float32(
                pixel_area(inverse_depths(projected, every, True), depth_count(vertices), focal[c])
            )  # fmt: skip
            for k in range(_take_nearer(order, EMPTY, image, box, found)):
                i = found[k]
                areas[n, c, part[i], flat_words[i]] += area
    return areas


@kernel
def score_shared_words(rest, rotations, translations, angles, views, parts, whole, least_area, other_share):
    """Score many poses by the words that the cameras have in common, and by other evidence (n,) [nat m2].

    Args:
        rest: See `score_regions`; so are the next four.
        rotations: (n, 3, 3).
        translations: (n, 3).
        angles: (n, D - 6).
        views: See `score_regions`.
        parts: Number of parts.
        whole: (C, K) logarithms of the densities of the words in the whole images.
        least_area: Area that is added to that of each word in the other cameras [m2].
        other_share: Share of the other cameras' words in the density of a part; the rest are unknown words.
    """
    parents, coordinate_segment, axes, joints, vertices, vertex_segments, vertex_weights, faces, face_part = rest
    cameras, widths, heights, focal, words, evidence = views
    order, part = canvases(words.shape, np.int8)
    flat_words, flat_evidence = words.ravel(), evidence.ravel()
    projected, box, found = np.empty((vertices.shape[0], 3)), np.empty(4, np.int64), np.empty(order.shape[0], np.int64)
    every, all_faces = np.ones(vertices.shape[0], np.bool_), np.arange(faces.shape[0])
    areas = np.empty((cameras.shape[0], parts, whole.shape[1] + 1))
    scores = np.zeros(rotations.shape[0])
    for n in range(rotations.shape[0]):
        areas[:] = 0.0
        turns, origins, _ = pose_segments(
            parents, coordinate_segment, axes, joints, rotations[n], translations[n], angles[n]
        )
        posed = blend_skin(vertices, vertex_segments, vertex_weights, joints, turns, origins)
        for c in range(cameras.shape[0]):
            project_points(cameras[c], posed, projected)
            image = image_of(c, words.shape, widths, heights)
            draw_parts(projected, faces, face_part, all_faces, order, part, image, box)
            area = pixel_area(inverse_depths(projected, every, True), depth_count(vertices), focal[c])
            for k in range(_take_nearer(order, EMPTY, image, box, found)):
                i = found[k]
                areas[c, part[i], flat_words[i]] += area
                scores[n] += area * flat_evidence[i]
        scores[n] += _shared_ratio(areas, whole, least_area, other_share)
    return scores


@kernel
def _shared_ratio(areas, whole, least_area, other_share):
    """Return the log-likelihood ratio of the words in the parts by those in the other cameras [nat m2]."""
    cameras, parts, _ = areas.shape
    count = whole.shape[1]
    score = 0.0
    for p in range(parts):
        together = 0.0
        for c in range(cameras):
            for k in range(count):
                together += areas[c, p, k]
        for c in range(cameras):
            total = together + count * least_area
            for k in range(count):
                total -= areas[c, p, k]
            for k in range(count):
                own = areas[c, p, k]
                if own > 0.0:
                    others = least_area - own
                    for other in range(cameras):
                        others += areas[other, p, k]
                    density = other_share * others / total + (1.0 - other_share) / count
                    score += own * (np.log(density) - whole[c, k])
    return score


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
def angle_costs(angles, habit, near, weight):
    """Return the costs (n,) of joint angles (n, D - 6) [nat m2]; see `angle_cost`."""
    costs = np.empty(angles.shape[0])
    for n in range(angles.shape[0]):
        costs[n] = angle_cost(angles[n], habit, near, weight)
    return costs


@kernel
def _still_layer(rest, chain, chains, rotation, translation, angles, views, table, still, drawing):
    """Draw the faces that a chain does not move; their scores, and the posed body, remain in the layer."""
    parents, coordinate_segment, axes, joints, vertices, vertex_segments, vertex_weights, faces, face_part = rest
    cameras, widths, heights, _, words, evidence = views
    _, moves_face, moves_vertex = chains
    order, part, value, own, depths, posed, projected = still
    box = drawing[2]
    resting = _chosen_numbers(moves_face[chain], False)
    turns, origins, _ = pose_segments(parents, coordinate_segment, axes, joints, rotation, translation, angles)
    every = np.ones(vertices.shape[0], np.bool_)
    blend_moved_skin(vertices, vertex_segments, vertex_weights, joints, turns, origins, every, posed)
    for c in range(cameras.shape[0]):
        project_points(cameras[c], posed, projected[c])
        image = image_of(c, words.shape, widths, heights)
        order[image[0] : image[0] + image[1] * image[3]] = EMPTY
        draw_parts(projected[c], faces, face_part, resting, order, part, image, box)
        own[c] = 0.0
        for y in range(box[1], box[3] + 1):
            for x in range(box[0], box[2] + 1):
                i = image[0] + y * image[1] + x
                if order[i] > EMPTY:
                    value[i] = table[c, part[i], words[c, y, x]] + evidence[c, y, x]
                    own[c] += value[i]
        depths[c] = inverse_depths(projected[c], moves_vertex[chain], False)


@kernel
def _score_over(rest, moves_vertex, moved, rotation, translation, angles, views, table, still, drawing):
    """Return the score of a pose that differs from that of the layer in the coordinates of a chain only.

    Args:
        rest: See `score_regions`.
        moves_vertex: (V,) true for the vertices that the chain moves.
        moved: See `_moved`.
        rotation: See `climb_regions`; so are the next four.
        translation: (3,).
        angles: (D - 6,).
        views: See `score_regions`.
        table: See `score_regions`.
        still: See `_layers`.
        drawing: See `_layers`.
    """
    parents, coordinate_segment, axes, joints, vertices, vertex_segments, vertex_weights, faces, face_part = rest
    cameras, widths, heights, focal, words, evidence = views
    flat_words, flat_evidence = words.ravel(), evidence.ravel()
    moved_faces, moved_vertices, places, pixels_of = moved
    still_order, _, value, own, depths, posed, projected = still
    order, part, box, found = drawing
    turns, origins, _ = pose_segments(parents, coordinate_segment, axes, joints, rotation, translation, angles)
    blend_moved_skin(vertices, vertex_segments, vertex_weights, joints, turns, origins, moves_vertex, posed)
    for i in range(moved_vertices.shape[0]):
        copy_row(places[i], posed[moved_vertices[i]])
    score = 0.0
    for c in range(cameras.shape[0]):
        pixels = projected[c]
        project_points(cameras[c], places, pixels_of)
        for i in range(moved_vertices.shape[0]):
            copy_row(pixels[moved_vertices[i]], pixels_of[i])
        image = image_of(c, words.shape, widths, heights)
        draw_parts(pixels, faces, face_part, moved_faces, order, part, image, box)
        total = own[c]
        for k in range(_take_nearer(order, still_order, image, box, found)):
            i = found[k]
            total += table[c, part[i], flat_words[i]] + flat_evidence[i]
            if still_order[i] > EMPTY:
                total -= value[i]
        depth = depths[c] + inverse_depths(pixels, moves_vertex, True)
        score += total * pixel_area(depth, depth_count(vertices), focal[c])
    return score


@kernel
def _chosen_numbers(mask, value):
    """Return the numbers of the elements of a mask (n,) that have a value."""
    numbers, count = np.empty(mask.shape[0], np.int64), 0
    for i in range(mask.shape[0]):
        if mask[i] == value:
            numbers[count] = i
            count += 1
    return numbers[:count]


@kernel
def _moved(chain, chains):
    """Return the numbers of the faces and of the vertices that a chain moves, and space for places and pixels."""
    _, moves_face, moves_vertex = chains
    vertices = _chosen_numbers(moves_vertex[chain], True)
    count = vertices.shape[0]
    return _chosen_numbers(moves_face[chain], True), vertices, np.empty((count, 3)), np.empty((count, 3))


@kernel
def _layers(shape, vertices):
    """Return an empty layer of the faces at rest, see `_still_layer`, and images to draw the others in."""
    order, part = canvases(shape, np.int8)
    posed, projected = np.empty((vertices, 3)), np.empty((shape[0], vertices, 3))
    value = np.zeros(order.shape, np.float32)
    still = order, part, value, np.zeros(shape[0]), np.zeros(shape[0]), posed, projected
    above, above_part = canvases(shape, np.int8)
    return still, (above, above_part, np.empty(4, np.int64), np.empty(above.shape[0], np.int64))


@kernel
def climb_regions(
    rest, chains, rotation, translation, angles, views, table, habit, near, weight, steps, metres, coordinates
):  # fmt: skip
    """Improve a pose by changes of single coordinates.

    A change of a coordinate moves one chain of segments, for example an arm: only its faces are drawn again, over a
    layer with the others.

    Args:
        rest: See `score_regions`.
        chains: Number of each coordinate's chain (D,); faces (G, T) and vertices (G, V) that each chain moves.
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
        coordinates: The coordinates that are changed, in their order.

    Returns:
        The score less the cost [nat m2], and the rotation, translation and angles.
    """
    still, drawing = _layers(views[4].shape, rest[4].shape[0])
    chain_of, chain, count = chains[0], -1, 6 + angles.shape[0]
    best = -np.inf
    moves_vertex, moved = chains[2][0], _moved(0, chains)
    signs, turn = np.ones(count), np.zeros(3)
    for step in steps:
        for i in coordinates:
            if chain_of[i] != chain:
                chain = chain_of[i]
                moves_vertex, moved = chains[2][chain], _moved(chain, chains)
                _still_layer(rest, chain, chains, rotation, translation, angles, views, table, still, drawing)
            if best == -np.inf:
                best = _score_over(
                    rest, moves_vertex, moved, rotation, translation, angles, views, table, still, drawing
                )  # fmt: skip
                best -= angle_cost(angles, habit, near, weight)
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
                score = _score_over(rest, moves_vertex, moved, turns, place, bent, views, table, still, drawing)
                score -= angle_cost(bent, habit, near, weight)
                if score > best:
                    best, rotation, translation, angles = score, turns, place, bent
                    signs[i] = sign
                    break
    return best, rotation, translation, angles


@kernel
def score_chain(rest, chain, chains, rotation, translation, angles, views, table):
    """Return the scores (n,) of poses that differ in the coordinates of one chain only; see `score_regions`.

    Args:
        rest: See `score_regions`.
        chain: Number of the chain.
        chains: See `climb_regions`.
        rotation: (3, 3) of the root of all poses.
        translation: (3,) of the root of all poses.
        angles: (n, D - 6).
        views: See `score_regions`.
        table: See `score_regions`.
    """
    still, drawing = _layers(views[4].shape, rest[4].shape[0])
    scores = np.empty(angles.shape[0])
    _still_layer(rest, chain, chains, rotation, translation, angles[0], views, table, still, drawing)
    moves_vertex, moved = chains[2][chain], _moved(chain, chains)
    for n in range(angles.shape[0]):
        scores[n] = _score_over(
            rest, moves_vertex, moved, rotation, translation, angles[n], views, table, still, drawing
        )  # fmt: skip
    return scores
