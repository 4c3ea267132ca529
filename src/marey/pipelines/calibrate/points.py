"""The points of a session that are no board: balls or tags of a wand, tags and named points of the room."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from marey.arrays import Floats, Image
from marey.calibration.adjustment.landmarks import LandmarkPixels
from marey.calibration.adjustment.projection import project_corners
from marey.calibration.adjustment.solve import SolvedSession
from marey.calibration.boards.balls import Spots, find_spots, moving_spots, wand_among, without_ball_size
from marey.calibration.boards.corners import BoardSighting, CornerSet
from marey.calibration.boards.detection import find_tags
from marey.calibration.boards.wand import CalibrationWand
from marey.errors import FileProblem, SettingProblem
from marey.io.calibration.session import SessionFiles
from marey.io.calibration.target import Place, SessionTarget
from marey.io.markers.readers import read_markers
from marey.pipelines.calibrate.checkpoints import stored_sightings, stored_spots
from marey.pipelines.calibrate.corners import gathered, over_pictures
from marey.pipelines.progress import Progress
from marey.pipelines.run_record import StageCache

_TAG_PICTURES = 30
"""Number of pictures per camera in which the tags of the room are searched; they do not move. Chosen by hand."""
_LEAST_TAG_SD = 0.05
"""Smallest standard deviation of the centre of a tag [px]; chosen by hand."""


def find_wand(
    session: SessionFiles, wand: CalibrationWand, instants: Sequence[int], progress: Progress, threads: int,
    cache: StageCache,
) -> CornerSet:  # fmt: skip
    """Find the balls or tags of a wand in all pictures.

    Args:
        session: The videos or pictures.
        wand: The wand.
        instants: Numbers of the instants to use.
        progress: Progress reporter.
        threads: Number of cameras at the same time.
        cache: Checkpoints of the run.

    Returns:
        Their centres.

    Raises:
        FileProblem: The wand is in no picture.
    """
    if wand.tags:
        rows = over_pictures(
            session, instants, lambda _p, _c, image: _tags_of(image, wand), "Wand", progress, threads, colour=True,
            stored=stored_sightings(cache, "wand", (wand, tuple(instants))),
        )  # fmt: skip
    else:
        rows = _with_balls(session, wand, instants, progress, threads, cache)
    if not rows:
        what = "numbers and dictionary of its tags" if wand.tags else "number, colours and distances of its balls"
        raise FileProblem(session.folder, f"shows no {wand.describe()}", f"Check the {what} in the board file.")
    return gathered(session, instants, rows)


def _tags_of(image: Image, wand: CalibrationWand) -> BoardSighting | None:
    found = find_tags(_grey(image), wand.dictionary, wand.tags)
    own = [k for k, number in enumerate(wand.tags) if number in found]
    if len(own) < 2:
        return None
    return BoardSighting(
        corner=np.array(own), pixels=np.stack([found[wand.tags[k]][0] for k in own]),
        covariance=np.stack([found[wand.tags[k]][1] for k in own]),
    )  # fmt: skip


def _with_balls(
    session: SessionFiles, wand: CalibrationWand, instants: Sequence[int], progress: Progress, threads: int,
    cache: StageCache,
) -> list[tuple[int, int, BoardSighting]]:  # fmt: skip
    colours = tuple(dict.fromkeys(wand.colours))

    def work(_picture: int, _camera: int, image: Image) -> list[Spots]:
        return [find_spots(image, colour) for colour in colours]

    stored = stored_spots(cache, "wand", (colours, tuple(instants)))
    found = over_pictures(session, instants, work, "Wand", progress, threads, colour=True, stored=stored)
    rows = []
    for camera in range(len(session.names)):
        own = [(picture, spots) for picture, seen_by, spots in found if seen_by == camera]
        moving = [moving_spots([spots[k] for _, spots in own]) for k in range(len(colours))]
        for number, (picture, _) in enumerate(own):
            of_mark = [moving[colours.index(colour)][number] for colour in wand.colours]
            sighting = wand_among(of_mark, wand)
            if sighting is not None:
                rows.append((picture, camera, sighting))
    return rows


def _grey(image: Image) -> Image:
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)


def with_ball_centres(solved: SolvedSession, corners: CornerSet, wand: CalibrationWand) -> CornerSet:
    """Correct centres of balls' images for the size of the balls.

    Args:
        solved: The session, with the poses of the wand.
        corners: All measured points.
        wand: The wand; its diameter may be 0.

    Returns:
        The points, corrected where the pose of the wand is known.
    """
    if wand.tags or not wand.diameter:
        return corners
    problem = solved.adjusted.problem
    _, seen = project_corners(solved.state, replace(problem, corners=corners).places)
    known = np.isin(corners.picture, np.unique(solved.corners.picture)) & (seen[:, 2] > wand.diameter)
    moved = without_ball_size(corners.pixels, seen, solved.state.lens[corners.camera, :2], 0.5 * wand.diameter)
    return replace(corners, pixels=np.where(known[:, None], moved, corners.pixels))


def landmark_pixels(
    session: SessionFiles, target: SessionTarget, instants: Sequence[int], progress: Progress, threads: int
) -> LandmarkPixels:
    """Find the tags of the room, and collect the points that were picked.

    Args:
        session: The videos or pictures.
        target: The points with known coordinates.
        instants: Numbers of the instants in use.
        progress: Progress reporter.
        threads: Number of cameras at the same time.

    Returns:
        Pixel and covariance by camera and name.

    Raises:
        SettingProblem: A picked pixel belongs to an unknown camera.
    """
    unknown = sorted({camera for camera, _ in target.pixels if camera not in session.names})
    if unknown:
        raise SettingProblem(f"There are pixels of camera '{unknown[0]}'; the cameras are {', '.join(session.names)}.")
    spread = target.pixel_sd**2 * np.eye(2)
    pixels: dict[tuple[int, str], tuple[Floats, Floats]] = {
        (session.names.index(camera), name): (np.array(pixel), spread)
        for (camera, name), pixel in target.pixels.items()
    }
    tags = {each.tag: each.name for each in target.landmarks if each.tag is not None}
    if tags:
        chosen = np.unique(np.linspace(0, len(instants) - 1, min(len(instants), _TAG_PICTURES)).astype(int))

        def work(_picture: int, _camera: int, image: Image) -> dict[int, tuple[Floats, Floats]]:
            return find_tags(_grey(image), target.dictionary, tuple(tags))

        rows = over_pictures(
            session, [instants[k] for k in chosen], work, "Tags", progress, threads, colour=True
        )  # fmt: skip
        for camera in range(len(session.names)):
            for number, name in tags.items():
                seen = [found[number] for _, seen_by, found in rows if seen_by == camera and number in found]
                if seen:
                    # Errors of still pictures are hardly independent: the covariance is that of one.
                    middle = np.median([pixel for pixel, _ in seen], axis=0)
                    covariance = np.median([each for _, each in seen], axis=0) + _LEAST_TAG_SD**2 * np.eye(2)
                    pixels[camera, name] = middle, covariance
    return pixels


def static_markers(path: Path, up: str) -> dict[str, Place]:
    """Return the median places of the markers of a static recording, with Z up.

    Args:
        path: A C3D, TRC or CSV.
        up: Axis of the file that points up, z or y.

    Returns:
        Places [m] by label.

    Raises:
        FileProblem: The file cannot be read.
    """
    found = read_markers(path)
    # OpenSim's axes: file (x, y, z) = world (Y, Z, X).
    order = [2, 0, 1] if up == "y" else [0, 1, 2]
    places = {}
    for k, label in enumerate(found.labels):
        seen = found.points[np.isfinite(found.points[:, k]).all(axis=-1), k]
        if len(seen):
            x, y, z = np.median(seen, axis=0)[order].tolist()
            places[label] = x, y, z
    return places
