"""Decimation of a closed symmetric mesh by half-edge collapses in mirrored pairs; coarse meshes nest in fine ones.

Every vertex that stays is one of the mesh's own, the surface stays closed (link condition), and the order in which
vertices leave gives an order of importance: the first n vertices carry the mesh of n vertices.
"""

import heapq

import numpy as np

UNIFORM = 0.006
"""Weight of an edge's length in the cost of a collapse, which favours evenly spaced vertices. Chosen by hand."""
LEAST_COSINE = 0.3
"""Least cosine between a face's normals before and after a collapse. Chosen by hand."""


def triangulate(quads: np.ndarray, points: np.ndarray, mirror: np.ndarray) -> np.ndarray:
    """Triangles (2Q, 3) of quads (Q, 4), cut along the shorter diagonal, the same way on both sides."""
    chosen: dict[frozenset, frozenset] = {}
    triangles = []
    for quad in quads[np.argsort(-points[quads][:, :, 0].mean(1), kind="stable")]:
        key = frozenset(quad.tolist())
        image = frozenset(mirror[quad].tolist())
        if image in chosen:
            first = frozenset(mirror[list(chosen[image])].tolist()) == frozenset((quad[0], quad[2]))
        else:
            across = points[quad[:2]] - points[quad[2:]]
            first = across[0] @ across[0] <= across[1] @ across[1]
        chosen[key] = frozenset((quad[0], quad[2]) if first else (quad[1], quad[3]))
        a, b, c, d = quad
        triangles += [(a, b, c), (a, c, d)] if first else [(a, b, d), (b, c, d)]
    return np.array(triangles)


class Collapser:
    """A mesh that loses vertices one mirrored pair at a time."""

    def __init__(self, points: np.ndarray, triangles: np.ndarray, mirror: np.ndarray, hidden: np.ndarray):
        self.points, self.mirror, self.hidden = points, mirror, hidden
        self.faces = {i: tuple(t) for i, t in enumerate(triangles.tolist())}
        self.around: dict[int, set[int]] = {}
        for i, face in self.faces.items():
            for vertex in face:
                self.around.setdefault(vertex, set()).add(i)
        corner = points[triangles]
        normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        area = np.linalg.norm(normal, axis=1) / 2
        normal /= np.maximum(2 * area, 1e-12)[:, None]
        plane = np.concatenate([normal, -np.sum(normal * corner[:, 0], axis=1)[:, None]], axis=1)
        quadric = area[:, None, None] / 3 * plane[:, :, None] * plane[:, None, :]
        self.quadric = np.zeros((len(points), 4, 4))
        self.area = np.zeros(len(points))
        for column in range(3):
            np.add.at(self.quadric, triangles[:, column], quadric)
            np.add.at(self.area, triangles[:, column], area / 3)
        self.quadric[hidden] *= 1e-6
        self.area[hidden] *= 1e-6
        self.heap: list[tuple[float, int, int, int]] = []
        self.stamp = dict.fromkeys(self.around, 0)
        for vertex in self.around:
            self.propose(vertex)

    def neighbours(self, vertex: int) -> set[int]:
        """The vertices that share an edge with one."""
        return {v for i in self.around[vertex] for v in self.faces[i]} - {vertex}

    def propose(self, vertex: int) -> None:
        """Put the collapses of a vertex into the heap."""
        self.stamp[vertex] += 1
        targets = [v for v in self.neighbours(vertex) if self.may(vertex, v)]
        if not targets:
            return
        ends = np.concatenate([self.points[targets], np.ones((len(targets), 1))], axis=1)
        bent = np.einsum("ni,ij,nj->n", ends, self.quadric[vertex], ends)
        long = np.sum((ends[:, :3] - self.points[vertex]) ** 2, axis=1)
        for target, cost in zip(targets, bent + UNIFORM * self.area[vertex] * long, strict=True):
            heapq.heappush(self.heap, (float(cost), vertex, target, self.stamp[vertex]))

    def may(self, vertex: int, target: int) -> bool:
        """Whether symmetry allows the collapse: the middle stays in the middle, no pair closes on itself."""
        middle = self.mirror[vertex] == vertex
        if middle and self.mirror[target] != target:
            return False
        if self.mirror[vertex] == target:
            return False
        return not (self.hidden[target] and not self.hidden[vertex])

    def sound(self, vertex: int, target: int) -> bool:
        """Whether the mesh stays a closed surface without folds after the collapse."""
        if len(self.neighbours(vertex) & self.neighbours(target)) != 2:
            return False
        end = self.points[target]
        for i in self.around[vertex] - self.around[target]:
            a, b, c = (self.points[v] for v in self.faces[i])
            d, e, f = (end if v == vertex else self.points[v] for v in self.faces[i])
            before, after = cross(b - a, c - a), cross(e - d, f - d)
            size = np.sqrt(after @ after)
            longest = max((e - d) @ (e - d), (f - e) @ (f - e), (d - f) @ (d - f))
            if size < 0.15 * longest and not self.hidden[vertex]:
                return False
            if before @ after < LEAST_COSINE * np.sqrt(before @ before) * size and not self.hidden[vertex]:
                return False
        return True

    def collapse(self, vertex: int, target: int) -> list:
        """Remove a vertex, and return the faces needed to undo it."""
        undo = [(i, self.faces[i]) for i in self.around[vertex]]
        for i, face in undo:
            if target in face:
                for v in face:
                    self.around[v].discard(i)
                del self.faces[i]
            else:
                self.faces[i] = tuple(target if v == vertex else v for v in face)
                self.around[target].add(i)
                self.around[vertex].discard(i)
        self.quadric[target] += self.quadric[vertex]
        self.area[target] += self.area[vertex]
        return undo

    def restore(self, vertex: int, target: int, undo: list) -> None:
        """Undo a collapse."""
        for i, face in undo:
            if i in self.faces:
                self.around[target].discard(i)
            self.faces[i] = face
            for v in face:
                self.around[v].add(i)
        self.quadric[target] -= self.quadric[vertex]
        self.area[target] -= self.area[vertex]

    def step(self) -> list[int]:
        """Make the cheapest sound collapse with its mirror image; return the removed vertices, none if stuck."""
        while self.heap:
            _, vertex, target, stamp = heapq.heappop(self.heap)
            if vertex not in self.around or self.stamp[vertex] != stamp or target not in self.around:
                continue
            if target not in self.neighbours(vertex) or not self.sound(vertex, target):
                continue
            pairs = [(vertex, target)]
            if self.mirror[vertex] != vertex:
                pairs.append((int(self.mirror[vertex]), int(self.mirror[target])))
            undo = self.collapse(*pairs[0])
            if len(pairs) == 2:
                if pairs[1][1] not in self.neighbours(pairs[1][0]) or not self.sound(*pairs[1]):
                    self.restore(*pairs[0], undo)
                    continue
                self.collapse(*pairs[1])
            for removed, _ in pairs:
                del self.around[removed]
            changed = {v for _, t in pairs for v in self.neighbours(t) | {t}}
            for v in changed:
                self.propose(v)
            return [removed for removed, _ in pairs]
        return []


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The cross product of two vectors, without NumPy's overhead."""
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def decimate(
    points: np.ndarray, triangles: np.ndarray, mirror: np.ndarray, hidden: np.ndarray, counts: tuple[int, ...]
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Vertices in order of importance, and the triangles of the meshes with about so many vertices.

    Args:
        points: (V, 3), symmetric about x = 0.
        triangles: (T, 3) of a closed surface, symmetric.
        mirror: (V,) the mirror image of each vertex.
        hidden: (V,) true for vertices that cannot be seen (mouth, eye sockets), which are removed first.
        counts: Numbers of vertices wanted, largest first; the meshes have this many or one less.

    Returns:
        order (n,) indices into points for the largest mesh, and for each count the triangles as indices into order.
    """
    mesh = Collapser(points, triangles, mirror, hidden)
    removed: list[int] = []
    kept = []
    for count in counts:
        while len(mesh.around) > count:
            gone = mesh.step()
            if not gone:
                raise ValueError(f"no sound collapse left at {len(mesh.around)} vertices")
            removed += gone
        kept.append((set(mesh.around), np.array(list(mesh.faces.values()))))
    first = sorted(kept[-1][0], key=lambda v: (-points[v, 2], points[v, 0]))
    order = np.array(first + [v for v in reversed(removed) if v in kept[0][0]])
    place = np.full(len(points), -1)
    place[order] = np.arange(len(order))
    return order, [place[faces] for _, faces in kept]
