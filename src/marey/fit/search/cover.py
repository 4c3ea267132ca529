"""Kernels that compare many poses with silhouettes by the covered pixels, without a depth buffer."""

import numpy as np

from marey.body.articulation.kinematics import blend_skin, pose_segments
from marey.cameras.lens import project_points
from marey.cameras.visibility import shown_faces
from marey.compiled.kernels import kernel


@kernel
def stamp_faces(projected, faces, stamp, canvas, mask):
    """Write a stamp into every pixel whose centre lies in a front face, except pixels of value -1.

    Args:
        projected: (V, 3) columns and rows [px] first.
        faces: (T, 3).
        stamp: Any value but zero.
        canvas: (h, w) of int32.
        mask: (h, w) 1 in the silhouette.

    Returns:
        The number of newly stamped pixels inside the silhouette, and outside it.
    """
    height, width = canvas.shape
    shown = shown_faces(projected, faces, 0, 0)
    inside = total = 0
    for k in range(len(shown)):
        a, b, c = faces[shown[k], 0], faces[shown[k], 1], faces[shown[k], 2]
        x0, y0 = projected[a, 0], projected[a, 1]
        x1, y1 = projected[b, 0], projected[b, 1]
        x2, y2 = projected[c, 0], projected[c, 1]
        area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
        xmin = max(0, int(np.ceil(min(x0, min(x1, x2)))))
        xmax = min(width - 1, int(np.floor(max(x0, max(x1, x2)))))
        ymin = max(0, int(np.ceil(min(y0, min(y1, y2)))))
        ymax = min(height - 1, int(np.floor(max(y0, max(y1, y2)))))
        # Twice the areas, negative as the face's own, of the triangles between the pixel and two of the edges.
        d0, d1 = y1 - y2, y2 - y0
        for y in range(ymin, ymax + 1):
            row, silhouette = canvas[y], mask[y]
            e0 = (x2 - x1) * (y - y1) - (y2 - y1) * (xmin - x1)
            e1 = (x0 - x2) * (y - y2) - (y0 - y2) * (xmin - x2)
            # Without branches: which pixels lie in a face of a few pixels cannot be predicted.
            for x in range(xmin, xmax + 1):
                here = row[x]
                new = (e0 <= 0.0) & (e1 <= 0.0) & (e0 + e1 >= area) & (here != -1) & (here != stamp)
                row[x] = stamp if new else here
                total += new
                inside += new & (silhouette[x] == 1)
                e0 += d0
                e1 += d1
    return inside, total - inside


@kernel
def blank_canvas(masks):
    """Return a canvas (C, h, w) for `stamp_faces`, of value -1 where the masks are, and the silhouettes' areas (C,)."""
    views, height, width = masks.shape
    canvas, area = np.zeros(masks.shape, np.int32), np.zeros(views, np.int64)
    for c in range(views):
        for y in range(height):
            for x in range(width):
                if masks[c, y, x] == 1:
                    area[c] += 1
                elif masks[c, y, x] == -1:
                    canvas[c, y, x] = -1
    return canvas, area


@kernel
def score_poses(
    parents, coordinate_segment, axes, joints, vertices, vertex_segments, vertex_weights, faces,
    rotations, translations, angles, cameras, widths, heights, masks,
):  # fmt: skip
    """Return the mean intersection over union of many poses (n,) with the silhouettes of all cameras.

    Args:
        parents: (S,) This and the next seven describe the body at rest, see `Body`.
        coordinate_segment: (D - 6,).
        axes: (D - 6, 3).
        joints: (S, 3).
        vertices: (V, 3).
        vertex_segments: (V, 4).
        vertex_weights: (V, 4).
        faces: (T, 3).
        rotations: (n, 3, 3) of the root.
        translations: (n, 3).
        angles: (n, D - 6).
        cameras: (C, P) packed.
        widths: (C,) of the images; the masks are padded to a common size.
        heights: (C,).
        masks: (C, h, w) of int8: 1 in the silhouette, 0 beside it, and -1 where a pixel counts for nothing.
    """
    poses, views = rotations.shape[0], cameras.shape[0]
    canvas, area = blank_canvas(masks)
    projected = np.empty((vertices.shape[0], 3))
    scores = np.zeros(poses)
    for n in range(poses):
        rotation, origin, _ = pose_segments(
            parents, coordinate_segment, axes, joints, rotations[n], translations[n], angles[n]
        )
        posed = blend_skin(vertices, vertex_segments, vertex_weights, joints, rotation, origin)
        for c in range(views):
            project_points(cameras[c], posed, projected)
            view = canvas[c, : heights[c], : widths[c]]
            both, outside = stamp_faces(projected, faces, n + 1, view, masks[c])
            union = outside + area[c]
            scores[n] += (both / union if union > 0 else 1.0) / views
    return scores


@kernel
def score_limb(
    parents, coordinate_segment, axes, joints, vertices, vertex_segments, vertex_weights, limb_faces, other_faces,
    limb_vertices, rotation, translation, angles, columns, candidates, cameras, widths, heights, masks,
):  # fmt: skip
    """Return the score of a pose for many placements of one limb; only newly covered pixels are counted.

    Args:
        parents: (S,) This and the next six describe the body at rest, see `Body`.
        coordinate_segment: (D - 6,).
        axes: (D - 6, 3).
        joints: (S, 3).
        vertices: (V, 3).
        vertex_segments: (V, 4).
        vertex_weights: (V, 4).
        limb_faces: (T', 3) the limb's faces.
        other_faces: (T'', 3) all other faces.
        limb_vertices: (V',) the vertices of the limb's faces.
        rotation: (3, 3) of the root.
        translation: (3,) of the root.
        angles: (D - 6,) of the pose whose limb is moved.
        columns: (k,) the limb's joint coordinates.
        candidates: (n, k) their angles.
        cameras: (C, P) packed.
        widths: (C,) of the images; the masks are padded to a common size.
        heights: (C,).
        masks: (C, h, w) of int8: 1 in the silhouette, 0 beside it, and -1 where a pixel counts for nothing.
    """
    views = cameras.shape[0]
    canvas, area = blank_canvas(masks)
    projected = np.empty((vertices.shape[0], 3))
    both = np.zeros(views)
    union = np.zeros(views)
    segment_rotation, origin, _ = pose_segments(
        parents, coordinate_segment, axes, joints, rotation, translation, angles
    )
    posed = blend_skin(vertices, vertex_segments, vertex_weights, joints, segment_rotation, origin)
    for c in range(views):
        project_points(cameras[c], posed, projected)
        view = canvas[c, : heights[c], : widths[c]]
        both[c], outside = stamp_faces(projected, other_faces, -1, view, masks[c])
        union[c] = outside + area[c]
    limb_segments = vertex_segments[limb_vertices]
    limb_weights = vertex_weights[limb_vertices]
    limb_rest = vertices[limb_vertices]
    local = np.full(vertices.shape[0], -1, np.int64)
    for i in range(limb_vertices.shape[0]):
        local[limb_vertices[i]] = i
    renumbered = np.empty_like(limb_faces)
    for f in range(limb_faces.shape[0]):
        for a in range(3):
            renumbered[f, a] = local[limb_faces[f, a]]
    limb_projected = np.empty((limb_vertices.shape[0], 3))
    scores = np.zeros(candidates.shape[0])
    moved = angles.copy()
    for n in range(candidates.shape[0]):
        for k in range(columns.shape[0]):
            moved[columns[k]] = candidates[n, k]
        segment_rotation, origin, _ = pose_segments(
            parents, coordinate_segment, axes, joints, rotation, translation, moved
        )
        posed = blend_skin(limb_rest, limb_segments, limb_weights, joints, segment_rotation, origin)
        for c in range(views):
            project_points(cameras[c], posed, limb_projected)
            view = canvas[c, : heights[c], : widths[c]]
            inside, outside = stamp_faces(limb_projected, renumbered, n + 1, view, masks[c])
            total = union[c] + outside
            scores[n] += ((both[c] + inside) / total if total > 0 else 1.0) / views
    return scores
