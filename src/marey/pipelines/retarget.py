"""`marey retarget`: transfer a measured motion to another character."""

import os
from pathlib import Path

from marey.body.articulation.surface import Body
from marey.errors import FileProblem
from marey.io.gltf.gltf import Gltf
from marey.io.gltf.rig import is_animated_copy, read_map, read_rig, retargeted, write_rig_motion
from marey.io.npz import read_motion
from marey.io.results.body import read_body
from marey.motion.retarget import CharacterRig, RigMotion
from marey.pipelines.capture.motion import Motion, motion_file
from marey.pipelines.labelled import Described, Summary
from marey.pipelines.verdict import Verdict, VerdictReason


class RetargetedCharacter(Described):
    """A character with a motion, to be saved as a copy of its file.

    Args:
        gltf: The character's file.
        rig: Skeleton of the character.
        moved: The motion of its nodes.
        planted: Whether feet that stand still were kept in place.
    """

    def __init__(self, gltf: Gltf, rig: CharacterRig, moved: RigMotion, *, planted: bool):
        self._gltf, self._rig, self._moved, self._planted = gltf, rig, moved, planted

    @property
    def joints(self) -> dict[str, str]:
        """The character's joint for each segment of the body."""
        return {segment: self._gltf.name(node) for segment, node in self._rig.nodes.items()}

    @property
    def guessed(self) -> tuple[str, ...]:
        """Segments whose joints were identified by their positions, because their names are unknown."""
        return tuple(self._rig.guessed)

    @property
    def gaps(self) -> tuple[tuple[float, float], ...]:
        """Spans of time without a result [s]; they have no keys, and viewers interpolate over them."""
        return self._moved.gaps

    @property
    def verdict(self) -> Verdict:
        """How far the copy can be used, and what limits it."""
        reasons = []
        if self.guessed:
            names = ", ".join(f"{segment} = {self.joints[segment]}" for segment in self.guessed)
            remedy = "If this is wrong, name the joints in a TOML file: names (--map)."
            reasons.append(VerdictReason.limit(f"Joints were identified by their positions: {names}.", remedy))
        if self.gaps:
            spans = ", ".join(f"{a:.2f}-{b:.2f} s" for a, b in self.gaps)
            reasons.append(VerdictReason.limit(f"There is no result at {spans}: viewers interpolate over these spans."))
        return Verdict.of(reasons)

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks on the copy, one sentence each."""
        gltf, rig = self._gltf, self._rig
        notes = ["Joints: " + ", ".join(f"{segment} = {name}" for segment, name in self.joints.items())]
        if rig.twists:
            shared = ", ".join(f"{gltf.name(node)} {share:.2f}" for node, (_, share) in rig.twists.items())
            notes.append(f"Shares of the rotation of a limb about its own axis: {shared}.")
        if self._planted:
            notes.append(self._slides_text())
        return tuple(notes)

    def _slides_text(self) -> str:
        """Describe what keeping the feet in place has changed."""
        if self._moved.slides is None:
            return "Feet: no foot stands still in this motion."
        before, after = self._moved.slides
        slid = f"{before:.3g} before the correction and {after:.3g} after it"
        return f"Feet: standing feet slid by {slid} (RMS, the character's unit)."

    def save(self, path: Path | str) -> Path:
        """Write a copy of the character's file with the motion as a further animation.

        Args:
            path: The copy, with the same suffix as the character.

        Returns:
            The path.

        Raises:
            FileProblem: The suffix differs, or the path is the character itself.
        """
        path, character = Path(path), self._gltf.path
        check_copy(path, character)
        write_rig_motion(path, self._gltf, self._rig, self._moved)
        return path

    def summary(self) -> Summary:
        """Return the readable description."""
        time = self._moved.time
        lines = {"keys": f"{len(time)}, {time[0]:.2f} to {time[-1]:.2f} s", "joints": f"{len(self.joints)}"}
        return Summary(f"Motion on {self._gltf.path.name}", lines)


def check_copy(path: Path, character: Path) -> None:
    """Check the path of a copy of a character.

    Args:
        path: The copy.
        character: The character.

    Raises:
        FileProblem: The suffix differs, the path is the character itself, or another file of this name exists.
    """
    if path.suffix.lower() != character.suffix.lower():
        has = f"has the suffix {path.suffix}" if path.suffix else "has no suffix"
        raise FileProblem(path, has, f"Use the character's: {character.suffix}.")
    if path.resolve() == character.resolve():
        raise FileProblem(path, "is the character itself", "Give another name for the copy.")
    if os.path.lexists(path) and not is_animated_copy(path):
        raise FileProblem(path, "exists, and is not a copy that marey wrote", "Give another name for the copy (--out).")


def copy_beside(motion: Path, character: Path) -> Path:
    """Return the default path of a copy: beside the motion, named after the character.

    Args:
        motion: A folder of results, or a motion.npz.
        character: The character.
    """
    return motion_file(motion).parent / f"{character.stem}_retargeted{character.suffix}"


def retarget(
    motion: Motion | Path | str,
    character: Path | str,
    *,
    names: Path | str | None = None,
    grounded: bool = True,
    planted: bool = False,
) -> RetargetedCharacter:
    """Transfer a motion to another character, as the command `marey retarget` does.

    Args:
        motion: A motion, a folder of results, or a motion.npz; the body beside it gives the height of the soles.
        character: A GLB or glTF file with a skinned mesh.
        names: A TOML file that names the character's joints.
        grounded: Keep the lower foot at the person's height above the floor.
        planted: Keep feet that stand still exactly in place by bending the legs.

    Returns:
        The character with the motion; `save` writes it.

    Raises:
        FileProblem: The motion or the character cannot be used.

    Example:
        >>> import marey
        >>> moved = marey.retarget("walk01", "knight.glb")
        >>> moved.joints["left_thigh"]
        'mixamorig:LeftUpLeg'
        >>> moved.save("knight_walks.glb").name
        'knight_walks.glb'
    """
    if isinstance(motion, Motion):
        data, source = motion.data, motion.folder or Path("motion.npz")
        beside = motion.folder
    else:
        source = motion_file(motion)
        data, beside = read_motion(source), source.parent
    if not data.answered.any():
        raise FileProblem(source, "has no frame with a result", "Capture the trial again.")
    gltf, rig = read_rig(Path(character), None if names is None else read_map(Path(names)))
    floor = None if beside is None else _floor(beside / "body.npz")
    moved = retargeted(gltf, rig, data, floor=floor, grounded=grounded, planted=planted)
    return RetargetedCharacter(gltf, rig, moved, planted=planted)


def _floor(path: Path) -> float | None:
    """Return the height of a body's lowest skin above its pelvis [m]; None without a body."""
    if not path.is_file():
        return None
    body: Body = read_body(path)[0]
    standing = any(name.endswith("foot") for name in body.skeleton.segment_names)
    return float(body.vertices[:, 2].min() - body.joint_centres[0, 2]) if standing else None
