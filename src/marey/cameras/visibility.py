"""Visibility of a triangle mesh in a camera: depth buffer, visible faces and rim."""

import threading
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from marey.arrays import Floats, Integers, Mask
from marey.compiled.kernels import kernel
from marey.lanes import LANES, paint_row


class Rim(NamedTuple):
    """The outermost covered pixels of a mesh in an image, with their surface points."""

    pixels: Floats
    """(n, 2) x, y in the image, integers."""
    inward: Floats
    """(n, 2) inward unit normals of the outline [px]."""
    face: Integers
    """(n,) the visible face."""
    barycentric: Floats
    """(n, 3) barycentric coordinates on the face."""
    depth: Floats
    """(n,) of the surface point from the camera [m]."""


JUMP = 0.025
"""Depth difference of two limbs below which they count as touching, without a rim between them [m]; chosen by hand."""


@dataclass(frozen=True, eq=False)
class View:
    """A mesh rendered by one camera, stored for the part of the image that it covers."""

    corner: tuple[int, int]
    """x, y of the first pixel of the part in the image."""
    size: tuple[int, int]
    """Width and height of the whole image."""
    inverse_depth: Floats
    """(h, w) [1/m], zero where the mesh is not visible."""
    face: NDArray[np.int32]
    """(h, w) index of the visible face, -1 where there is none."""
    projected: Floats
    """(V, 3) the vertices as x, y [px] and inverse depth [1/m]; NaN where they are not visible."""

    @property
    def covered(self) -> Mask:
        """(h, w) true where the mesh is visible, for the part of the image."""
        return self.face >= 0

    def mask(self) -> Mask:
        """(height, width) true where the mesh is visible, for the whole image."""
        full = np.zeros((self.size[1], self.size[0]), bool)
        x, y = self.corner
        full[y : y + self.face.shape[0], x : x + self.face.shape[1]] = self.face >= 0
        return full

    def rim(self, faces: Integers) -> Rim:
        """Find the rim: covered pixels next to an uncovered one; the border of the image is not an outline.

        Args:
            faces: (T, 3) the rendered mesh.
        """
        return Rim(*rim_pixels(self.face, self.projected, faces, self.corner[0], self.corner[1]))

    def interior_rim(self, faces: Integers, limb: Integers, *, jump: float = JUMP) -> Rim:
        """Find the rims inside the outline: pixels of a limb next to a pixel of another limb farther away.

        Args:
            faces: (T, 3) the rendered mesh.
            limb: (T,) limb of each face.
            jump: smallest depth difference to the other limb [m].
        """
        x, y = self.corner
        return Rim(*interior_rim_pixels(self.face, self.inverse_depth, self.projected, faces, limb, x, y, jump))


MARGIN = 3
"""Width of the empty border around the rendered mesh [px]; chosen by hand."""


def see(projected: Floats, faces: Integers, size: tuple[int, int], *, margin: int = MARGIN) -> View:
    """Render a mesh into a depth buffer.

    Only faces whose counter-clockwise side faces the camera are drawn. A pixel is covered if
    its centre lies in a face; inverse depth is linear in the image.

    Args:
        projected: (V, 3) x, y [px] and inverse depth [1/m] of the vertices; NaN if not visible.
        faces: (T, 3).
        size: width and height of the image.
        margin: width of the border around the mesh [px].
    """
    corner, inverse_depth, face = draw_window(projected, faces, size[0], size[1], margin)
    return View(corner, size, inverse_depth, face, projected)


@kernel
def draw_window(projected, faces, width, height, margin):
    """Find the part of the image that the vertices may cover, and draw the faces into it."""
    left, top, right, bottom = find_window(projected, width, height, margin)
    count = (bottom - top) * (right - left)
    inverse_depth = np.zeros(count + LANES)[:count].reshape((bottom - top, right - left))
    face = np.full(count + LANES, -1, np.int32)[:count].reshape((bottom - top, right - left))
    draw_faces(projected, faces, left, top, inverse_depth, face)
    return (left, top), inverse_depth, face


@kernel
def find_window(projected, width, height, margin):
    """Find the part of the image that the vertices may cover: first x, first y, and the ones behind the last."""
    left, top, right, bottom = np.inf, np.inf, -np.inf, -np.inf
    for v in range(projected.shape[0]):
        x, y = projected[v, 0], projected[v, 1]
        # Comparisons with NaN are false: what is not to be seen does not count.
        left = x if x < left else left
        right = x if x > right else right
        top = y if y < top else top
        bottom = y if y > bottom else bottom
    if not left <= right:
        return 0, 0, 0, 0
    x0 = int(min(max(np.floor(left) - margin, 0), width))
    y0 = int(min(max(np.floor(top) - margin, 0), height))
    x1 = int(min(max(np.ceil(right) + margin + 1, x0), width))
    y1 = int(min(max(np.ceil(bottom) + margin + 1, y0), height))
    return x0, y0, x1, y1


class Scratch(NamedTuple):
    """Buffers in which a view is drawn again and again: memory that is new to a process costs more than the drawing."""

    projected: Floats
    """(V, 3)."""
    inverse_depth: Floats
    """(width height + 8,)."""
    face: NDArray[np.int32]
    """(width height + 8,)."""

    @staticmethod
    def of(vertices: int, size: tuple[int, int]) -> "Scratch":
        """Return this thread's buffers for a mesh of so many vertices in a image of a size."""
        known = _BUFFERS.__dict__.setdefault("known", {})
        if (vertices, size) not in known:
            if len(known) > 8:
                known.clear()
            pixels = size[0] * size[1] + LANES
            known[vertices, size] = Scratch(np.empty((vertices, 3)), np.empty(pixels), np.empty(pixels, np.int32))
        scratch: Scratch = known[vertices, size]
        return scratch


_BUFFERS = threading.local()
"""Buffers of each thread, by numbers of vertices and image size."""


@kernel
def draw_into(scratch, faces, width, height, margin):
    """Do what `draw_window` does with the scratch's projected vertices; what is given lives in the scratch."""
    left, top, inverse_depth, face = drawn_last(scratch, width, height, margin)
    inverse_depth[:] = 0.0
    face[:] = -1
    draw_faces(scratch.projected, faces, left, top, inverse_depth, face)
    return left, top, inverse_depth, face


@kernel
def drawn_last(scratch, width, height, margin):
    """Return what `draw_into` gave, as long as nothing else was drawn into the scratch."""
    left, top, right, bottom = find_window(scratch.projected, width, height, margin)
    count = (bottom - top) * (right - left)
    inverse_depth = scratch.inverse_depth[:count].reshape((bottom - top, right - left))
    face = scratch.face[:count].reshape((bottom - top, right - left))
    return left, top, inverse_depth, face


@kernel
def draw_faces(projected, faces, left, top, inverse_depth, face):
    """Fill the depth buffer and the buffer of visible faces, see `see`; each lies in memory eight numbers longer."""
    height, width = face.shape
    depths, labels = inverse_depth.ravel(), face.ravel()
    shown = shown_faces(projected, faces, left, top)
    for k in range(len(shown)):
        f = shown[k]
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        x0, y0, z0 = projected[a, 0] - left, projected[a, 1] - top, projected[a, 2]
        x1, y1, z1 = projected[b, 0] - left, projected[b, 1] - top, projected[b, 2]
        x2, y2, z2 = projected[c, 0] - left, projected[c, 1] - top, projected[c, 2]
        area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
        xmin = max(0, int(np.ceil(min(x0, min(x1, x2)))))
        xmax = min(width - 1, int(np.floor(max(x0, max(x1, x2)))))
        ymin = max(0, int(np.ceil(min(y0, min(y1, y2)))))
        ymax = min(height - 1, int(np.floor(max(y0, max(y1, y2)))))
        scale = 1.0 / area
        d0, d1 = -(y2 - y1) * scale, -(y0 - y2) * scale
        dz = d0 * (z0 - z2) + d1 * (z1 - z2)
        for y in range(ymin, ymax + 1):
            e0 = ((x2 - x1) * (y - y1) - (y2 - y1) * (xmin - x1)) * scale
            e1 = ((x0 - x2) * (y - y2) - (y0 - y2) * (xmin - x2)) * scale
            z = e0 * (z0 - z2) + e1 * (z1 - z2) + z2
            for x in range(xmin, xmax + 1, LANES):
                on = float(x - xmin)
                paint_row(
                    depths, labels, y * width + x, xmax + 1 - x,
                    (e0 + on * d0, d0), (e1 + on * d1, d1), (z + on * dz, dz), np.int32(f),
                )  # fmt: skip


@kernel
def shown_faces(projected, faces, left, top):
    """List the front faces (n,) that may cover the centre of a pixel.

    Args:
        projected: (V, 3) columns and rows [px] first.
        faces: (T, 3).
        left: x of the first pixel of the part of the image that is drawn.
        top: y of that pixel.
    """
    shown = np.empty(faces.shape[0], np.int32)
    count = 0
    # Without branches: which faces are seen from the front cannot be predicted.
    for f in range(faces.shape[0]):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        x0, y0 = projected[a, 0] - left, projected[a, 1] - top
        x1, y1 = projected[b, 0] - left, projected[b, 1] - top
        x2, y2 = projected[c, 0] - left, projected[c, 1] - top
        # Rows run down, so a face seen from outside has a negative area; a NaN fails the test too.
        front = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0) < 0.0
        across = np.ceil(min(x0, min(x1, x2))) <= np.floor(max(x0, max(x1, x2)))
        down = np.ceil(min(y0, min(y1, y2))) <= np.floor(max(y0, max(y1, y2)))
        shown[count] = f
        count += front & across & down
    return shown[:count]


@kernel
def rim_pixels(face, projected, faces, left, top):
    """List the rim's pixels, inward normals, faces, barycentric weights and depths, see `View.rim`."""
    found = _covered_beside_uncovered(face)
    inward = np.empty((len(found), 2))
    for i in range(len(found)):
        _normal_of_covered(face, found[i, 0], found[i, 1], inward[i])
    return _on_surface(found, inward, face, projected, faces, left, top)


@kernel
def outline_pixels(face, left, top, width, height, border):
    """List the pixels (n, 2) of the rim in the image that have a normal, and are at least `border` from its border.

    The normals of both sides of what is one pixel wide cancel.
    """
    rim = _covered_beside_uncovered(face)
    found, inward, count = np.empty((len(rim), 2)), np.empty(2), 0
    for i in range(len(rim)):
        x, y = rim[i, 0] + left, rim[i, 1] + top
        if border <= x < width - border and border <= y < height - border:
            _normal_of_covered(face, rim[i, 0], rim[i, 1], inward)
            if inward[0] != 0.0 or inward[1] != 0.0:
                found[count, 0], found[count, 1] = x, y
                count += 1
    return found[:count].copy()


@kernel
def _covered_beside_uncovered(face):
    """List the rim's pixels (n, 2), x first, row by row."""
    height, width = face.shape
    stride = 8 * ((width + 7) // 8)
    on_rim = np.zeros(height * stride, np.uint8)
    total = 0
    # Without branches, which cost more here.
    for y in range(1, height - 1):
        above, here, below, own = face[y - 1], face[y], face[y + 1], on_rim[y * stride : (y + 1) * stride]
        for x in range(1, width - 1):
            beside = above[x] | below[x] | here[x - 1] | here[x + 1]
            own[x] = (here[x] >= 0) & (beside < 0)
            total += own[x]
    found = np.empty((total, 2), np.int64)
    count = 0
    # Eight pixels at a time: nearly all of them are not on the rim.
    eights = on_rim.view(np.uint64)
    for e in range(len(eights)):
        if eights[e] != 0:
            y = 8 * e // stride
            for k in range(8 * e, 8 * e + 8):
                if on_rim[k]:
                    found[count, 0], found[count, 1] = k - y * stride, y
                    count += 1
    return found


@kernel
def interior_rim_pixels(face, inverse_depth, projected, faces, limb, left, top, jump):
    """List the rims inside the outline as `rim_pixels` lists the outline, see `View.interior_rim`."""
    suspects = _beside_something_behind(inverse_depth, jump)
    found = np.empty((len(suspects), 2), np.int64)
    count = 0
    for i in range(len(suspects)):
        y, x = suspects[i]
        if _hides(face, inverse_depth, limb, y, x, jump):
            found[count, 0], found[count, 1] = x, y
            count += 1
    found = found[:count]
    inward = np.empty((count, 2))
    for i in range(count):
        _normal_of_limb(face, limb, found[i, 0], found[i, 1], inward[i])
    return _on_surface(found, inward, face, projected, faces, left, top)


@kernel
def _beside_something_behind(inverse_depth, jump):
    """List the pixels (n, 2), rows first, beside one that lies farther away by more than a jump, or shows nothing."""
    height, width = inverse_depth.shape
    suspect = np.zeros((height, width), np.uint8)
    count = 0
    # Without branches: nearly all pixels have neighbours of about their own depth.
    for y in range(1, height - 1):
        above, here, below = inverse_depth[y - 1], inverse_depth[y], inverse_depth[y + 1]
        for x in range(1, width - 1):
            z = here[x]
            s = 1.0 + jump * z
            suspect[y, x] = (above[x] * s < z) | (below[x] * s < z) | (here[x - 1] * s < z) | (here[x + 1] * s < z)
            count += suspect[y, x]
    found = np.empty((count, 2), np.int64)
    count = 0
    for y in range(1, height - 1):
        for x in range(1, width - 1):
            if suspect[y, x]:
                found[count, 0], found[count, 1] = y, x
                count += 1
    return found


@kernel
def _hides(face, inverse_depth, limb, y, x, jump):
    """Return whether a pixel's limb hides another limb that is seen beside it."""
    own, near = limb[face[y, x]], inverse_depth[y, x]
    for k in range(4):
        yy, xx = y + (k == 0) - (k == 1), x + (k == 2) - (k == 3)
        f = face[yy, xx]
        if f >= 0 and limb[f] != own and inverse_depth[yy, xx] * (1.0 + jump * near) < near:
            return True
    return False


@kernel
def _normal_of_covered(face, x, y, inward):
    """Write the unit normal towards what is covered near a pixel."""
    height, width = face.shape
    nx = ny = 0
    if 2 <= x < width - 2 and 2 <= y < height - 2:
        # Whole rows of five pixels at a time, without branches.
        for yy in range(y - 2, y + 3):
            row = face[yy]
            a, b, c, d, e = row[x - 2] >= 0, row[x - 1] >= 0, row[x] >= 0, row[x + 1] >= 0, row[x + 2] >= 0
            nx += 2 * (int(e) - int(a)) + int(d) - int(b)
            ny += (yy - y) * (int(a) + int(b) + int(c) + int(d) + int(e))
    else:
        for yy in range(max(y - 2, 0), min(y + 3, height)):
            for xx in range(max(x - 2, 0), min(x + 3, width)):
                if face[yy, xx] >= 0:
                    nx += xx - x
                    ny += yy - y
    _write_unit(float(nx), float(ny), inward)


@kernel
def _normal_of_limb(face, limb, x, y, inward):
    """Write the unit normal towards what a pixel's own limb covers near it."""
    height, width = face.shape
    own = limb[face[y, x]]
    nx = ny = 0.0
    for yy in range(max(y - 2, 0), min(y + 3, height)):
        for xx in range(max(x - 2, 0), min(x + 3, width)):
            if face[yy, xx] >= 0 and limb[face[yy, xx]] == own:
                nx += xx - x
                ny += yy - y
    _write_unit(nx, ny, inward)


@kernel
def _write_unit(nx, ny, inward):
    length = np.sqrt(nx * nx + ny * ny)
    scale = 1.0 / length if length > 0.0 else 0.0
    inward[0], inward[1] = nx * scale, ny * scale


@kernel
def _on_surface(found, inward, face, projected, faces, left, top):
    """Return what `Rim` holds of pixels (n, 2) of the buffers."""
    count = len(found)
    pixels = np.empty((count, 2))
    rim_face = np.empty(count, np.int64)
    barycentric = np.empty((count, 3))
    depth = np.empty(count)
    for i in range(count):
        x, y = found[i, 0], found[i, 1]
        pixels[i, 0], pixels[i, 1] = x + left, y + top
        rim_face[i] = face[y, x]
        depth[i] = _perspective_weights(projected, faces, rim_face[i], x + left, y + top, barycentric[i])
    return pixels, inward, rim_face, barycentric, depth


@kernel
def _perspective_weights(projected, faces, f, x, y, weights):
    """Write the barycentric weights of the face's point seen at a pixel; give its depth."""
    a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
    x0, y0 = projected[a, 0], projected[a, 1]
    x1, y1 = projected[b, 0], projected[b, 1]
    x2, y2 = projected[c, 0], projected[c, 1]
    area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
    w0 = ((x2 - x1) * (y - y1) - (y2 - y1) * (x - x1)) / area * projected[a, 2]
    w1 = ((x0 - x2) * (y - y2) - (y0 - y2) * (x - x2)) / area * projected[b, 2]
    w2 = (1.0 - w0 / projected[a, 2] - w1 / projected[b, 2]) * projected[c, 2]
    total = w0 + w1 + w2
    weights[0] = w0 / total
    weights[1] = w1 / total
    weights[2] = w2 / total
    return 1.0 / total
