"""Kernels of the posed body: segments and skin, with their derivatives by every coordinate."""

import numpy as np

from marey.compiled.kernel_copies import copy_matrix, copy_row
from marey.compiled.kernels import kernel
from marey.geometry.rotations import turn_about


# Short: see `marey.compiled.kernels.kernel`.
@kernel(nogil=False)
def pose_segments(parents, coordinate_segment, axes, joints, root_rotation, root_translation, angles):
    """Place the segments ([Rosenhahn2006] eq. (12)).

    Returns:
        rotation (S, 3, 3) world from segment, origin (S, 3) of the joint centres in the world, world_axes (D - 6, 3) of
        the joint coordinates.
    """
    count = parents.shape[0]
    rotation = np.empty((count, 3, 3))
    origin = np.empty((count, 3))
    world_axes = np.empty((axes.shape[0], 3))
    turn = np.empty((3, 3))
    product = np.empty((3, 3))
    i = 0
    for k in range(count):
        parent = parents[k]
        if parent < 0:
            copy_matrix(rotation[k], root_rotation)
            copy_row(origin[k], root_translation)
        else:
            copy_matrix(rotation[k], rotation[parent])
            for a in range(3):
                shift = 0.0
                for b in range(3):
                    shift += rotation[parent, a, b] * (joints[k, b] - joints[parent, b])
                origin[k, a] = origin[parent, a] + shift
        while i < axes.shape[0] and coordinate_segment[i] == k:
            for a in range(3):
                world_axes[i, a] = (
                    rotation[k, a, 0] * axes[i, 0] + rotation[k, a, 1] * axes[i, 1] + rotation[k, a, 2] * axes[i, 2]
                )
            turn_about(axes[i], angles[i], turn)
            for a in range(3):
                for b in range(3):
                    product[a, b] = (
                        rotation[k, a, 0] * turn[0, b] + rotation[k, a, 1] * turn[1, b] + rotation[k, a, 2] * turn[2, b]
                    )
            copy_matrix(rotation[k], product)
            i += 1
    return rotation, origin, world_axes


@kernel
def turned(rotation, turn):
    """Rotate a rotation (3, 3) by a vector (3,) about the world's axes: exp(turn) rotation, kept orthonormal."""
    angle = np.sqrt(turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2)
    if angle == 0.0:
        return rotation.copy()
    first = np.empty((3, 3))
    turn_about(turn / angle, angle, first)
    product = np.empty((3, 3))
    for a in range(3):
        for b in range(3):
            product[a, b] = first[a, 0] * rotation[0, b] + first[a, 1] * rotation[1, b] + first[a, 2] * rotation[2, b]
    # One step towards the nearest rotation, R (3 - R'R) / 2, removes the rounding errors.
    nearest = np.empty((3, 3))
    for a in range(3):
        for b in range(3):
            t = 1.5 * product[a, b]
            for c in range(3):
                inner = 0.0
                for d in range(3):
                    inner += product[d, c] * product[d, b]
                t -= 0.5 * product[a, c] * inner
            nearest[a, b] = t
    return nearest


@kernel
def blend_skin(vertices, vertex_segments, vertex_weights, joints, rotation, origin):
    """Return the vertices (V, 3) at rest moved with their segments by blended weights (linear blend skinning)."""
    posed = np.empty((vertices.shape[0], 3))
    moved = np.ones(vertices.shape[0], np.bool_)
    blend_moved_skin(vertices, vertex_segments, vertex_weights, joints, rotation, origin, moved, posed)
    return posed


@kernel
def blend_moved_skin(vertices, vertex_segments, vertex_weights, joints, rotation, origin, moved, posed):
    """Write those posed vertices (V, 3) that are true in moved (V,); see `blend_skin`."""
    segments = rotation.shape[0]
    shift = np.empty((segments, 3))
    for k in range(segments):
        for a in range(3):
            shift[k, a] = origin[k, a] - (
                rotation[k, a, 0] * joints[k, 0] + rotation[k, a, 1] * joints[k, 1] + rotation[k, a, 2] * joints[k, 2]
            )
    for v in range(vertices.shape[0]):
        if not moved[v]:
            continue
        x, y, z = vertices[v, 0], vertices[v, 1], vertices[v, 2]
        px = py = pz = 0.0
        for n in range(vertex_weights.shape[1]):
            w = vertex_weights[v, n]
            if w > 0.0:
                k = vertex_segments[v, n]
                r = rotation[k]
                px += w * (r[0, 0] * x + r[0, 1] * y + r[0, 2] * z + shift[k, 0])
                py += w * (r[1, 0] * x + r[1, 1] * y + r[1, 2] * z + shift[k, 1])
                pz += w * (r[2, 0] * x + r[2, 1] * y + r[2, 2] * z + shift[k, 2])
        posed[v, 0] = px
        posed[v, 1] = py
        posed[v, 2] = pz


# Short: see `marey.compiled.kernels.kernel`.
@kernel(nogil=False)
def points_on_faces(vertices, faces, face, barycentric):
    """Return the points (n, 3) of faces (n,) with barycentric weights (n, 3)."""
    points = np.empty((face.shape[0], 3))
    for i in range(face.shape[0]):
        a, b, c = faces[face[i], 0], faces[face[i], 1], faces[face[i], 2]
        u, v, w = barycentric[i, 0], barycentric[i, 1], barycentric[i, 2]
        for k in range(3):
            points[i, k] = u * vertices[a, k] + v * vertices[b, k] + w * vertices[c, k]
    return points


@kernel
def gather_parts(faces, corners, vertices, vertex_segments, vertex_weights, joints, face, barycentric, segment, part):
    """Decompose surface points into the parts carried by their segments.

    A point p = sum over its segments k of T_k y_k, where y_k (4,) gathers the weighted rest positions (relative to the
    segment's joint centre) of the face's three corners, the weight last.

    Args:
        faces: (T, 3).
        corners: Largest number of segments per point that are kept; there are at most four weights per vertex.
        vertices: (V, 3) at rest.
        vertex_segments: (V, 4).
        vertex_weights: (V, 4).
        joints: (S, 3) at rest.
        face: (n,) the face of each point.
        barycentric: (n, 3).
        segment: (n, corners) output: the segments, -1 where there are fewer.
        part: (n, corners, 4) output.
    """
    for i in range(face.shape[0]):
        split_point(
            faces, corners, vertices, vertex_segments, vertex_weights, joints, face[i], barycentric, i, segment, part, i
        )


@kernel(inline="always")
def split_point(
    faces, corners, vertices, vertex_segments, vertex_weights, joints, face, barycentric, i, segment, part, row
):  # fmt: skip
    """Decompose surface point i, of barycentric weights i, into a row of segment and part, see `gather_parts`."""
    used = 0
    for n in range(corners):
        segment[row, n] = -1
    for c in range(3):
        v = faces[face, c]
        b = barycentric[i, c]
        for n in range(vertex_weights.shape[1]):
            w = vertex_weights[v, n] * b
            if w <= 0.0:
                continue
            k = vertex_segments[v, n]
            slot = -1
            for m in range(used):
                if segment[row, m] == k:
                    slot = m
            if slot < 0:
                if used == corners:
                    continue
                slot = used
                used += 1
                segment[row, slot] = k
                for a in range(4):
                    part[row, slot, a] = 0.0
            for a in range(3):
                part[row, slot, a] += w * (vertices[v, a] - joints[k, a])
            part[row, slot, 3] += w


@kernel
def share_faces(faces, vertex_segments, vertex_weights):
    """Return for each face the segments that carry its corners, in ascending order, and their weights.

    Returns:
        count (T,) of segments, segment (T, N), weight (T, N, 3) of the three corners; N is the largest count.
    """
    most = 3 * vertex_weights.shape[1]
    count = np.zeros(faces.shape[0], np.int64)
    segment = np.full((faces.shape[0], most), -1)
    weight = np.zeros((faces.shape[0], most, 3))
    for f in range(faces.shape[0]):
        for c in range(3):
            v = faces[f, c]
            for n in range(vertex_weights.shape[1]):
                if vertex_weights[v, n] <= 0.0:
                    continue
                k, at = vertex_segments[v, n], 0
                while at < count[f] and segment[f, at] < k:
                    at += 1
                if at == count[f] or segment[f, at] != k:
                    for later in range(count[f], at, -1):
                        segment[f, later] = segment[f, later - 1]
                        copy_row(weight[f, later], weight[f, later - 1])
                    segment[f, at] = k
                    weight[f, at] = 0.0
                    count[f] += 1
                weight[f, at, c] += vertex_weights[v, n]
    most = count.max()
    return count, segment[:, :most].copy(), weight[:, :most].copy()


@kernel
def point_jacobian(parents, coordinate_segment, rotation, origin, world_axes, segment, part, jacobian):
    """Write the derivatives of points by the pose: (n, 3, D), the root's translation and rotation (world axes) first.

    The root rotates about the pelvis' own centre.
    """
    coordinates = world_axes.shape[0]
    first = np.zeros(rotation.shape[0] + 1, np.int64)
    for i in range(coordinates):
        first[coordinate_segment[i] + 1] += 1
    for k in range(rotation.shape[0]):
        first[k + 1] += first[k]
    y = np.empty(3)
    for i in range(segment.shape[0]):
        jacobian[i] = 0.0
        for n in range(segment.shape[1]):
            k = segment[i, n]
            if k < 0:
                break
            w = part[i, n, 3]
            for a in range(3):
                y[a] = (
                    rotation[k, a, 0] * part[i, n, 0]
                    + rotation[k, a, 1] * part[i, n, 1]
                    + rotation[k, a, 2] * part[i, n, 2]
                    + origin[k, a] * w
                )
            for a in range(3):
                jacobian[i, a, a] += w
            dx, dy, dz = y[0] - w * origin[0, 0], y[1] - w * origin[0, 1], y[2] - w * origin[0, 2]
            jacobian[i, 0, 4] += dz
            jacobian[i, 0, 5] -= dy
            jacobian[i, 1, 3] -= dz
            jacobian[i, 1, 5] += dx
            jacobian[i, 2, 3] += dy
            jacobian[i, 2, 4] -= dx
            j = k
            while j >= 0:
                for q in range(first[j], first[j + 1]):
                    ax, ay, az = world_axes[q, 0], world_axes[q, 1], world_axes[q, 2]
                    dx, dy, dz = y[0] - w * origin[j, 0], y[1] - w * origin[j, 1], y[2] - w * origin[j, 2]
                    jacobian[i, 0, 6 + q] += ay * dz - az * dy
                    jacobian[i, 1, 6 + q] += az * dx - ax * dz
                    jacobian[i, 2, 6 + q] += ax * dy - ay * dx
                j = parents[j]


@kernel
def origin_modes(parents, rotation, joint_modes):
    """Return the derivatives of the segments' origins by the shape, and the same minus the motion of their joints.

    Args:
        parents: (S,).
        rotation: (S, 3, 3).
        joint_modes: (M, S, 3) motion of the joint centres at rest per shape parameter.

    Returns:
        moved: (S, M, 3) of the origins; anchored: (S, M, 3) = moved - R_k times the joint's own motion.
    """
    modes, count, _ = joint_modes.shape
    moved = np.zeros((count, modes, 3))
    anchored = np.zeros((count, modes, 3))
    for k in range(count):
        parent = parents[k]
        for m in range(modes):
            for a in range(3):
                if parent >= 0:
                    moved[k, m, a] = moved[parent, m, a]
                    for b in range(3):
                        moved[k, m, a] += rotation[parent, a, b] * (joint_modes[m, k, b] - joint_modes[m, parent, b])
                anchored[k, m, a] = moved[k, m, a]
                for b in range(3):
                    anchored[k, m, a] -= rotation[k, a, b] * joint_modes[m, k, b]
    return moved, anchored


@kernel
def shape_jacobian(
    faces, vertex_segments, vertex_weights, vertex_modes, rotation, anchored, face, barycentric, jacobian
):
    """Write the derivatives of surface points by the shape parameters: (n, 3, M); vertex_modes is (V, M, 3)."""
    modes = vertex_modes.shape[1]
    blend = np.empty((3, 3))
    for i in range(face.shape[0]):
        jacobian[i] = 0.0
        for c in range(3):
            v = faces[face[i], c]
            share = barycentric[i, c]
            blend[:] = 0.0
            for n in range(vertex_weights.shape[1]):
                w = vertex_weights[v, n] * share
                if w <= 0.0:
                    continue
                k = vertex_segments[v, n]
                for a in range(3):
                    for b in range(3):
                        blend[a, b] += w * rotation[k, a, b]
                for m in range(modes):
                    for a in range(3):
                        jacobian[i, a, m] += w * anchored[k, m, a]
            for m in range(modes):
                x, y, z = vertex_modes[v, m, 0], vertex_modes[v, m, 1], vertex_modes[v, m, 2]
                for a in range(3):
                    jacobian[i, a, m] += blend[a, 0] * x + blend[a, 1] * y + blend[a, 2] * z


@kernel
def pose_rows(parents, coordinate_segment, rotation, origin, world_axes, segment, part, rows, jacobian):
    """Add the derivatives of rows (n, r, 3) of points by the pose to the first D columns of jacobian (n, r, ...).

    A force a on the part y of segment k rotates a joint by axis . ((y - w o) x a): `point_jacobian`, multiplied out.
    """
    segments, coordinates = rotation.shape[0], world_axes.shape[0]
    first = np.zeros(segments + 1, np.int64)
    for i in range(coordinates):
        first[coordinate_segment[i] + 1] += 1
    for k in range(segments):
        first[k + 1] += first[k]
    for i in range(segment.shape[0]):
        for n in range(segment.shape[1]):
            k = segment[i, n]
            if k < 0:
                break
            p0, p1, p2, w = part[i, n, 0], part[i, n, 1], part[i, n, 2], part[i, n, 3]
            turn = rotation[k]
            y0 = turn[0, 0] * p0 + turn[0, 1] * p1 + turn[0, 2] * p2 + origin[k, 0] * w
            y1 = turn[1, 0] * p0 + turn[1, 1] * p1 + turn[1, 2] * p2 + origin[k, 1] * w
            y2 = turn[2, 0] * p0 + turn[2, 1] * p1 + turn[2, 2] * p2 + origin[k, 2] * w
            for r in range(rows.shape[1]):
                a0, a1, a2 = rows[i, r, 0], rows[i, r, 1], rows[i, r, 2]
                out = jacobian[i, r]
                out[0] += w * a0
                out[1] += w * a1
                out[2] += w * a2
                j = k
                while j >= 0:
                    d0, d1, d2 = y0 - w * origin[j, 0], y1 - w * origin[j, 1], y2 - w * origin[j, 2]
                    t0, t1, t2 = d1 * a2 - d2 * a1, d2 * a0 - d0 * a2, d0 * a1 - d1 * a0
                    for q in range(first[j], first[j + 1]):
                        out[6 + q] += world_axes[q, 0] * t0 + world_axes[q, 1] * t1 + world_axes[q, 2] * t2
                    if parents[j] < 0:
                        out[3] += t0
                        out[4] += t1
                        out[5] += t2
                    j = parents[j]


@kernel(fastmath=True)
def shape_rows(
    faces, vertex_segments, vertex_weights, vertex_modes, rotation, anchored, face, barycentric, segment, part,
    rows, degrees, jacobian,
):  # fmt: skip
    """Add the derivatives of rows (n, r, 3) of surface points by the shape to jacobian (n, r, D + M) from column D on.

    It is `shape_jacobian`, multiplied out; vertex_modes is (V, 3, M) and anchored (S, 3, M).
    """
    modes = vertex_modes.shape[2]
    for i in range(face.shape[0]):
        for r in range(rows.shape[1]):
            a0, a1, a2 = rows[i, r, 0], rows[i, r, 1], rows[i, r, 2]
            out = jacobian[i, r, degrees:]
            for n in range(segment.shape[1]):
                k = segment[i, n]
                if k < 0:
                    break
                w = part[i, n, 3]
                b0, b1, b2 = w * a0, w * a1, w * a2
                for m in range(modes):
                    out[m] += b0 * anchored[k, 0, m] + b1 * anchored[k, 1, m] + b2 * anchored[k, 2, m]
            for c in range(3):
                v = faces[face[i], c]
                b0 = b1 = b2 = 0.0
                for n in range(vertex_weights.shape[1]):
                    w = vertex_weights[v, n] * barycentric[i, c]
                    if w > 0.0:
                        turn = rotation[vertex_segments[v, n]]
                        b0 += w * (turn[0, 0] * a0 + turn[1, 0] * a1 + turn[2, 0] * a2)
                        b1 += w * (turn[0, 1] * a0 + turn[1, 1] * a1 + turn[2, 1] * a2)
                        b2 += w * (turn[0, 2] * a0 + turn[1, 2] * a1 + turn[2, 2] * a2)
                for m in range(modes):
                    out[m] += b0 * vertex_modes[v, 0, m] + b1 * vertex_modes[v, 1, m] + b2 * vertex_modes[v, 2, m]
