"""`marey retarget`: a recovered motion on another character."""

from pathlib import Path

from marey.body.articulation.surface import Body
from marey.errors import FileProblem
from marey.io.gltf.rig import read_map, read_rig, write_retargeted
from marey.io.npz import read_motion
from marey.io.results.body import read_body
from marey.motion.retarget import RigMotion


def retarget(
    motion: Path, character: Path, *, out: Path | None, named: Path | None, grounded: bool, planted: bool
) -> tuple[Path, list[str]]:
    """Write a copy of a character's file that has a motion as its animation.

    Args:
        motion: A folder of results, or a motion.npz; body.npz beside it tells where the soles are.
        character: A GLB or glTF with a skinned mesh.
        out: The file to write; without it, one beside the motion, named for the character.
        named: A TOML that names joints.
        grounded: whether the lower foot is kept as high above the floor as the person's.
        planted: whether feet that stand still are kept in their place.

    Returns:
        The file, and what is worth telling.

    Raises:
        FileProblem: Something cannot be used.
    """
    source = motion_file(motion)
    moving = read_motion(source)
    if not moving.answered.any():
        raise FileProblem(source, "has no frame with an answer", "Capture the trial again.")
    gltf, rig = read_rig(character, read_map(named) if named is not None else None)
    path = source.parent / f"{character.stem}_retargeted{character.suffix}" if out is None else out
    if path.suffix.lower() != character.suffix.lower():
        raise FileProblem(path, f"is to be written as {path.suffix or 'nothing'}", f"Name it {character.suffix}.")
    if path.resolve() == character.resolve():
        raise FileProblem(path, "is the character itself", "Give another name with --out.")
    path.parent.mkdir(parents=True, exist_ok=True)
    floor = _floor(source.parent / "body.npz")
    moved = write_retargeted(path, gltf, rig, moving, floor=floor, grounded=grounded, planted=planted)
    notes = ["Joints: " + ", ".join(f"{segment} = {gltf.name(node)}" for segment, node in rig.nodes.items())]
    if rig.guessed:
        listed = ", ".join(f"{segment} = {gltf.name(rig.nodes[segment])}" for segment in rig.guessed)
        notes.append(f"Guessed from where they stand: {listed}. If that is wrong, name them with --map.")
    if rig.twists:
        shared = ", ".join(f"{gltf.name(node)} {share:.2f}" for node, (_, share) in rig.twists.items())
        notes.append(f"Shares of the limbs' twist: {shared}.")
    if planted:
        notes.append(_of_slides(moved))
    if moved.gaps:
        spans = ", ".join(f"{a:.2f}-{b:.2f} s" for a, b in moved.gaps)
        notes.append(f"Nothing was measured at {spans}: there are no keys there, a viewer turns evenly across.")
    return path, notes


def _of_slides(moved: RigMotion) -> str:
    """Say what planting the feet has brought."""
    if moved.slides is None:
        return "Feet: none stands still in this motion."
    before, after = moved.slides
    return f"Feet: where they stand they slid by {before:.3g}, now by {after:.3g} (RMS, the character's unit)."


def motion_file(motion: Path) -> Path:
    """Find the motion.npz that is meant by a file or folder.

    Raises:
        FileProblem: There is none.
    """
    if motion.is_file():
        return motion
    for path in (motion / "motion.npz", motion / "marey" / "motion.npz"):
        if path.is_file():
            return path
    what = "holds no motion.npz" if motion.is_dir() else "does not exist"
    raise FileProblem(motion, what, "Give the folder that `marey capture` or `marey shape` said its results went to.")


def _floor(path: Path) -> float | None:
    """Give the height of a body's lowest skin above its pelvis [m], or None where there is no body."""
    if not path.is_file():
        return None
    body: Body = read_body(path)[0]
    standing = any(name.endswith("foot") for name in body.skeleton.segment_names)
    return float(body.vertices[:, 2].min() - body.joint_centres[0, 2]) if standing else None
