"""Reading and writing `body.npz`: a person's body, complete, so that another run can continue with it."""

from pathlib import Path

import numpy as np

from marey.arrays import Floats
from marey.body.articulation.skeleton import Coordinate, Skeleton
from marey.body.articulation.surface import Body, ShapeSpace
from marey.body.metaballs.metaball_person import MetaballSpace, metaballs_of
from marey.body.metaballs.metaballs import Metaballs
from marey.body.people.scan import scanned_body
from marey.errors import FileProblem, MareyError
from marey.io.gltf.character import read_character
from marey.io.npz import consistent_arrays, read_arrays, write_arrays

_SPACE = ("vertex_mean", "vertex_modes", "joint_mean", "joint_modes", "prior_mean", "prior_covariance")
"""Fields of the shape space, in the file under `space_` and their names."""
_NEXT = {"pelvis": "abdomen", "abdomen": "thorax", "thorax": "neck", "neck": "head"} | {
    f"{side}_{segment}": f"{side}_{below}"
    for side in ("left", "right")
    for segment, below in (
        ("clavicle", "upperarm"), ("upperarm", "forearm"), ("forearm", "hand"),
        ("thigh", "shank"), ("shank", "foot"), ("foot", "toes"),
    )
}  # fmt: skip
"""Segment at whose joint centre the length of a segment ends; the other segments end at their farthest vertex."""
_TEXTS = ("preset", "segment_names", "coordinate_names", "number_names")
"""Names of the arrays that hold texts."""
_WANTED = (
    "preset", "segment_names", "parents", "coordinate_names", "coordinate_segment", "coordinate_numbers", "numbers",
    "numbers_covariance", "number_names", "segment_origin_sd", "segment_origin_offset_sd", "segment_followed", "faces",
    "face_outlined", "vertex_segments", "vertex_weights", "metaball_segment", *(f"space_{n}" for n in _SPACE),
)  # fmt: skip
"""Keys that every file contains."""


def write_body(path: Path | str, body: Body, *, preset: str) -> None:
    """Write `body.npz`.

    The file contains names, joint centres, lengths of segments, and the skin; the skeleton (`parents`,
    `coordinate_...`: axis, mean, sd, lower and upper limit in radians); and the shape parameters with their covariance
    and shape space (`space_...`), so that `read_body` returns the same body. `segment_origin_sd` and
    `segment_origin_offset_sd` (S,) are standard deviations per axis of the distance of joint centres from where the
    skin puts them [m]: the part that varies between postures, and the constant part. `face_outlined` (T,) marks the
    faces whose outline is used, and `segment_followed` (S,) the segments whose motion is measured. A mesh has no
    metaballs: their arrays are empty. For metaballs, the file also contains their axes `metaball_rotation`
    (M, 3, 3) in the segment, one per column, and their dependence on the shape parameters: `metaball_mean_centre`,
    `metaball_mean_radii` (M, 3) and `metaball_mean_weight` (M,) for parameters of zero, `metaball_centre_modes` and
    `metaball_radii_modes` (N, M, 3) [m per unit of the parameter], `metaball_sharpness_modes` (N, M) and
    `metaball_fall` (M,); see `MetaballSpace`.

    Args:
        path: The file.
        body: The body at rest.
        preset: Name of the preset.
    """
    skeleton = body.skeleton
    length, length_sd = segment_lengths(body)
    count = len(body.numbers)
    no_covariance, no_sd = np.full((count, count), np.nan), np.full(len(length), np.nan)
    numbers = [(*c.axis, c.mean, c.sd, c.lower, c.upper) for c in skeleton.coordinates]
    write_arrays(
        path,
        {
            "preset": preset,
            "joint_names": body.joint_names,
            "joint_centres": body.joint_centres[body.joint_segments],
            "segment_names": skeleton.segment_names,
            "segment_length": length,
            "segment_length_sd": length_sd,
            "segment_origin": body.joint_centres,
            "segment_origin_sd": no_sd if body.joint_sd is None else body.joint_sd,
            "segment_origin_offset_sd": no_sd if body.joint_offset_sd is None else body.joint_offset_sd,
            **_metaball_arrays(body),
            "vertices": body.vertices,
            "faces": body.faces,
            "face_outlined": body.outline_counts,
            "vertex_segments": body.vertex_segments,
            "vertex_weights": body.vertex_weights,
            "segment_followed": np.ones(len(length), bool) if body.followed is None else body.followed,
            "parents": skeleton.parents,
            "coordinate_names": np.array([c.name for c in skeleton.coordinates], dtype=str),
            "coordinate_segment": skeleton.coordinate_segment,
            "coordinate_numbers": np.array(numbers).reshape(-1, 7),
            "number_names": np.array(body.space.names, dtype=str),
            "numbers": body.numbers,
            "numbers_covariance": no_covariance if body.numbers_covariance is None else body.numbers_covariance,
            **{f"space_{name}": getattr(body.space, name) for name in _SPACE},
            "space_ranked": body.space.ranked,
        },
    )


def _metaball_arrays(body: Body) -> dict[str, np.ndarray]:
    """Return the arrays of the metaballs by their keys; empty arrays for a body without metaballs."""
    space = metaballs_of(body)
    if space is None:
        none = {f"metaball_{name}": np.zeros((0, 3)) for name in ("centre", "radii", "radii_sd")}
        return none | {"metaball_segment": np.zeros(0, np.int64), "metaball_weight": np.zeros(0)}
    balls, covariance = space.balls(body.numbers), body.numbers_covariance
    radii, log_weight = space.rates(balls)
    radii_sd, weight_sd = np.full(balls.radii.shape, np.nan), np.full(len(balls), np.nan)
    if covariance is not None:
        variance = np.einsum("iab,ij,jab->ab", radii, covariance, radii, optimize=True)
        radii_sd = np.sqrt(np.maximum(variance, 0.0))
        variance = np.einsum("ia,ij,ja->a", log_weight, covariance, log_weight, optimize=True)
        weight_sd = balls.weight * np.sqrt(np.maximum(variance, 0.0))
    own = {name: getattr(balls, name) for name in ("segment", "centre", "rotation", "radii", "weight")}
    whole = own | {
        "radii_sd": radii_sd, "weight_sd": weight_sd, "mean_centre": space.mean.centre, "mean_radii": space.mean.radii,
        "mean_weight": space.mean.weight, "centre_modes": space.centre_modes, "radii_modes": space.radii_modes,
        "sharpness_modes": space.sharpness_modes, "fall": space.fall,
    }  # fmt: skip
    return {f"metaball_{name}": values for name, values in whole.items()}


def _metaballs(stored: dict[str, np.ndarray], skeleton: Skeleton, space: ShapeSpace) -> MetaballSpace | None:
    """Return the metaballs of a file, or None if it has none.

    Raises:
        KeyError: The file lacks the dependence of the metaballs on the shape parameters.
        ValueError: The metaballs differ from those of the shape parameters.
    """
    if not len(stored["metaball_segment"]):
        return None
    mean = Metaballs(
        skeleton=skeleton, joint_centres=space.joint_mean, segment=stored["metaball_segment"],
        centre=stored["metaball_mean_centre"], rotation=stored["metaball_rotation"],
        radii=stored["metaball_mean_radii"], weight=stored.get("metaball_mean_weight", stored["metaball_weight"]),
    )  # fmt: skip
    # Files that were written before weights were fitted have neither.
    sharp = {name: stored[f"metaball_{name}"] for name in ("sharpness_modes", "fall") if f"metaball_{name}" in stored}
    found = MetaballSpace(
        names=space.names, mean=mean, centre_modes=stored["metaball_centre_modes"],
        radii_modes=stored["metaball_radii_modes"], joint_modes=space.joint_modes, prior_mean=space.prior_mean,
        prior_covariance=space.prior_covariance, ranked=space.ranked, **sharp,
    )  # fmt: skip
    balls = found.balls(stored["numbers"])
    if not all(np.allclose(getattr(balls, name), stored[f"metaball_{name}"]) for name in ("centre", "radii", "weight")):
        raise ValueError("its metaballs differ from those of its shape parameters")
    return found


def read_body(path: Path | str) -> tuple[Body, str]:
    """Read `body.npz`.

    Args:
        path: The file.

    Returns:
        The body and its preset.

    Raises:
        FileProblem: The file cannot be read, lacks a key, or has inconsistent arrays.
    """
    stored = read_arrays(path, _WANTED, texts=_TEXTS)
    with consistent_arrays(path, "Give a body.npz of `marey capture` or `marey shape`."):
        names = tuple(str(name) for name in stored["segment_names"])
        joints = zip(
            stored["coordinate_names"], stored["coordinate_segment"], stored["coordinate_numbers"], strict=True
        )
        coordinates = tuple(_coordinate(str(name), names[int(k)], numbers) for name, k, numbers in joints)
        space = ShapeSpace(
            names=tuple(str(name) for name in stored["number_names"]),
            **{name: stored[f"space_{name}"] for name in _SPACE},
            ranked=bool(stored.get("space_ranked", True)),
        )
        skeleton = Skeleton(segment_names=names, parents=stored["parents"], coordinates=coordinates)
        body = Body(
            skeleton=skeleton,
            metaballs=_metaballs(stored, skeleton, space),
            space=space,
            numbers=stored["numbers"],
            faces=stored["faces"],
            vertex_segments=stored["vertex_segments"],
            vertex_weights=stored["vertex_weights"],
            outlined=stored["face_outlined"].astype(bool),
            followed=stored["segment_followed"].astype(bool),
            joint_sd=_known(stored["segment_origin_sd"]),
            joint_offset_sd=_known(stored["segment_origin_offset_sd"]),
            numbers_covariance=_known(stored["numbers_covariance"]),
        )
        fits = np.allclose(body.vertices, stored["vertices"]) and len(body.joint_centres) == len(names)
        fits = fits and bool(np.all((body.faces >= 0) & (body.faces < len(body.vertices))))
    if not fits:
        wrong = "has a skin that differs from that of its shape parameters"
        raise FileProblem(path, wrong, "Give a body.npz of `marey capture` or `marey shape`, unchanged.")
    return body, str(stored["preset"])


def open_body(path: Path | str, template: Body) -> Body:
    """Read a person's body from a body.npz, a skinned GLB, or a TOML that names a mesh, as for `capture --body`.

    Args:
        path: The file.
        template: An average body at rest, whose skeleton is used for a GLB or a scan.

    Returns:
        The body at rest.

    Raises:
        FileProblem: The file cannot be read, or lacks joint centres.
    """
    if Path(path).suffix.lower() == ".npz":
        return read_body(path)[0]
    character = read_character(path)
    try:
        return scanned_body(
            template,
            vertices=character.vertices,
            faces=character.faces,
            joint_centres=character.joint_centres,
            weights=character.weights,
        )
    except MareyError as error:
        wrong = f"cannot be used as a body ({str(error).rstrip('.')})"
        raise FileProblem(path, wrong, "Add the joint centres to the file, or give a body.npz.") from error


def _known(values: Floats) -> Floats | None:
    """Return the values, or None if they are empty or not all finite."""
    return values if values.size and np.isfinite(values).all() else None


def _coordinate(name: str, segment: str, numbers: Floats) -> Coordinate:
    """Return a coordinate from its row of `coordinate_numbers`."""
    x, y, z, mean, sd, lower, upper = (float(v) for v in numbers)
    return Coordinate(name=name, segment=segment, axis=(x, y, z), mean=mean, sd=sd, lower=lower, upper=upper)


def segment_lengths(body: Body) -> tuple[Floats, Floats]:
    """Return the lengths of the segments, from their joint centres to the next ones, or to the farthest vertex.

    Args:
        body: The body at rest.

    Returns:
        Lengths (S,) and standard deviations (S,) [m]. The standard deviations include the distance of joint centres
        from where the skin puts them, which outlines do not determine; they are NaN if the covariance of the shape is
        unknown.
    """
    names, space = body.skeleton.segment_names, body.space
    lengths, deviations = np.zeros(len(names)), np.full(len(names), np.nan)
    share = [np.where(body.vertex_segments == k, body.vertex_weights, 0).sum(1) for k in range(len(names))]
    offset = np.zeros(len(names)) if body.joint_offset_sd is None else body.joint_offset_sd
    for k, name in enumerate(names):
        offset_variance = offset[k] ** 2
        if _NEXT.get(name) in names:
            offset_variance += offset[names.index(_NEXT[name])] ** 2
            end = names.index(_NEXT[name])
            along, modes = body.joint_centres[end] - body.joint_centres[k], space.joint_modes[:, end]
        else:
            away = np.where(share[k] > 0.5, np.linalg.norm(body.vertices - body.joint_centres[k], axis=1), 0)
            far = int(np.argmax(away))
            along, modes = body.vertices[far] - body.joint_centres[k], space.vertex_modes[:, far]
        lengths[k] = np.linalg.norm(along)
        if body.numbers_covariance is not None and lengths[k] > 0:
            per_number = (modes - space.joint_modes[:, k]) @ along / lengths[k]
            deviations[k] = np.sqrt(per_number @ body.numbers_covariance @ per_number + offset_variance)
    return lengths, deviations
