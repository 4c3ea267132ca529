"""body.npz: a person's body, whole, so that another run can take it up again."""

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
from marey.io.npz import read_arrays, write_arrays

_SPACE = ("vertex_mean", "vertex_modes", "joint_mean", "joint_modes", "prior_mean", "prior_covariance")
_NEXT = {"pelvis": "abdomen", "abdomen": "thorax", "thorax": "neck", "neck": "head"} | {
    f"{side}_{segment}": f"{side}_{below}"
    for side in ("left", "right")
    for segment, below in (
        ("clavicle", "upperarm"), ("upperarm", "forearm"), ("forearm", "hand"),
        ("thigh", "shank"), ("shank", "foot"), ("foot", "toes"),
    )
}  # fmt: skip
_WANTED = (
    "preset", "segment_names", "parents", "coordinate_names", "coordinate_segment", "coordinate_numbers", "numbers",
    "numbers_covariance", "number_names", "segment_origin_sd", "segment_origin_offset_sd", "segment_followed", "faces",
    "face_outlined", "vertex_segments", "vertex_weights", "metaball_segment", *(f"space_{n}" for n in _SPACE),
)  # fmt: skip


def write_body(path: Path | str, body: Body, *, preset: str) -> None:
    """Write `body.npz`.

    It holds names, joint centres, segments' lengths and the skin; the skeleton (`parents`, `coordinate_...`: axis,
    mean, sd, lower and upper limit in radians); the shape numbers with their covariance and the space of shapes
    (`space_...`), so that `read_body` gives back the same body. `segment_origin_sd` and `segment_origin_offset_sd` (S,)
    say how far, by axis, joint centres lie beside the skin's: from posture to posture, and all the time [m];
    `face_outlined` (T,) and `segment_followed` (S,) what the preset believes and follows. A mesh has no metaballs:
    those arrays are empty. With metaballs come their axes `metaball_rotation` (M, 3, 3) in the segment, one a column,
    and how they follow from the numbers: `metaball_mean_centre`, `metaball_mean_radii` (M, 3) and
    `metaball_mean_weight` (M,) where all are zero, `metaball_centre_modes`, `metaball_radii_modes` (N, M, 3) [m by unit
    of the number], `metaball_sharpness_modes` (N, M) and `metaball_fall` (M,), see `MetaballSpace`.

    Args:
        path: The file.
        body: At rest.
        preset: The preset's name.
    """
    skeleton = body.skeleton
    length, length_sd = segment_lengths(body)
    count = len(body.numbers)
    unknown, unsaid = np.full((count, count), np.nan), np.full(len(length), np.nan)
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
            "segment_origin_sd": unsaid if body.joint_sd is None else body.joint_sd,
            "segment_origin_offset_sd": unsaid if body.joint_offset_sd is None else body.joint_offset_sd,
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
            "numbers_covariance": unknown if body.numbers_covariance is None else body.numbers_covariance,
            **{f"space_{name}": getattr(body.space, name) for name in _SPACE},
            "space_ranked": body.space.ranked,
        },
    )


def _metaball_arrays(body: Body) -> dict[str, np.ndarray]:
    """Give what the file holds of the metaballs."""
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
    """Take up the metaballs of a file, or none where it has none.

    Raises:
        KeyError: It has metaballs, but not how they follow from the numbers.
        ValueError: They are not those of the numbers.
    """
    if not len(stored["metaball_segment"]):
        return None
    mean = Metaballs(
        skeleton=skeleton, joint_centres=space.joint_mean, segment=stored["metaball_segment"],
        centre=stored["metaball_mean_centre"], rotation=stored["metaball_rotation"],
        radii=stored["metaball_mean_radii"], weight=stored.get("metaball_mean_weight", stored["metaball_weight"]),
    )  # fmt: skip
    # A file of before weights were fitted has neither.
    sharp = {name: stored[f"metaball_{name}"] for name in ("sharpness_modes", "fall") if f"metaball_{name}" in stored}
    found = MetaballSpace(
        names=space.names, mean=mean, centre_modes=stored["metaball_centre_modes"],
        radii_modes=stored["metaball_radii_modes"], joint_modes=space.joint_modes, prior_mean=space.prior_mean,
        prior_covariance=space.prior_covariance, ranked=space.ranked, **sharp,
    )  # fmt: skip
    balls = found.balls(stored["numbers"])
    if not all(np.allclose(getattr(balls, name), stored[f"metaball_{name}"]) for name in ("centre", "radii", "weight")):
        raise ValueError("its metaballs are not those of its numbers")
    return found


def read_body(path: Path | str) -> tuple[Body, str]:
    """Read `body.npz`.

    Args:
        path: The file.

    Returns:
        The body and its preset.

    Raises:
        FileProblem: It cannot be read, lacks a key, or its arrays do not fit together.
    """
    stored = read_arrays(path, _WANTED)
    names = tuple(str(name) for name in stored["segment_names"])
    covariance = stored["numbers_covariance"]
    try:
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
            numbers_covariance=_known(covariance),
        )
        fits = np.allclose(body.vertices, stored["vertices"]) and len(body.joint_centres) == len(names)
    except (ValueError, IndexError, KeyError, MareyError) as error:
        raise FileProblem(
            path, f"does not fit together ({error})", "Give a body.npz of `capture` or `shape`."
        ) from error
    if not fits:
        raise FileProblem(path, "has a skin that is not that of its numbers", "Give a body.npz as it was written.")
    return body, str(stored["preset"])


def open_body(path: Path | str, template: Body) -> Body:
    """Read a person's body from whatever `capture --body` takes: body.npz, a skinned GLB, or a TOML with a mesh.

    Args:
        path: The file.
        template: An average body at rest, whose skeleton a GLB or a scan gets.

    Raises:
        FileProblem: It cannot be read, or lacks joint centres.
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
        raise FileProblem(path, f"cannot be a body ({str(error).rstrip('.')})") from error


def _known(values: Floats) -> Floats | None:
    return values if values.size and np.isfinite(values).all() else None


def _coordinate(name: str, segment: str, numbers: Floats) -> Coordinate:
    x, y, z, mean, sd, lower, upper = (float(v) for v in numbers)
    return Coordinate(name=name, segment=segment, axis=(x, y, z), mean=mean, sd=sd, lower=lower, upper=upper)


def segment_lengths(body: Body) -> tuple[Floats, Floats]:
    """Give each segment's length: to the next joint centre, or of a last segment to its farthest skin.

    Args:
        body: At rest.

    Returns:
        Lengths (S,) and standard deviations (S,) [m], the latter NaN where the shape's covariance is unknown. They hold
        what outlines cannot tell: how far joint centres lie beside where the skin puts them.
    """
    names, space = body.skeleton.segment_names, body.space
    lengths, deviations = np.zeros(len(names)), np.full(len(names), np.nan)
    share = [np.where(body.vertex_segments == k, body.vertex_weights, 0).sum(1) for k in range(len(names))]
    offset = np.zeros(len(names)) if body.joint_offset_sd is None else body.joint_offset_sd
    for k, name in enumerate(names):
        beside = offset[k] ** 2
        if _NEXT.get(name) in names:
            beside += offset[names.index(_NEXT[name])] ** 2
            end = names.index(_NEXT[name])
            along, modes = body.joint_centres[end] - body.joint_centres[k], space.joint_modes[:, end]
        else:
            away = np.where(share[k] > 0.5, np.linalg.norm(body.vertices - body.joint_centres[k], axis=1), 0)
            far = int(np.argmax(away))
            along, modes = body.vertices[far] - body.joint_centres[k], space.vertex_modes[:, far]
        lengths[k] = np.linalg.norm(along)
        if body.numbers_covariance is not None and lengths[k] > 0:
            by_number = (modes - space.joint_modes[:, k]) @ along / lengths[k]
            deviations[k] = np.sqrt(by_number @ body.numbers_covariance @ by_number + beside)
    return lengths, deviations
