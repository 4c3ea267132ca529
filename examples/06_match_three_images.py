"""Measure a surface from three images of one instant by least-squares matching.

    python examples/06_match_three_images.py [FOLDER IMAGE IMAGE IMAGE]

Input: a folder with a calibration, and one image per camera; by default a speckled wall that this example draws as
three cameras 15 degrees apart would see it.
Output: the number of points and their standard deviations, on the terminal.
Features: `marey.Camera`, `marey.Rig`, `marey.match_images`, `Surface.to_pandas`.
"""

import argparse
from pathlib import Path

import cv2
import numpy as np

import marey
from marey.geometry.rigid import RigidTransform

SIZE, FOCAL, DISTANCE_M = (480, 360), 900.0, 2.0
"""Width and height of an image [px], focal length [px], distance of the cameras from the wall [m]."""


def speckled_wall() -> tuple[marey.Rig, list[np.ndarray]]:
    """Return three cameras that look at the plane z = 0, and what each of them sees."""
    rng = np.random.default_rng(0)
    speckle = cv2.GaussianBlur(rng.uniform(0, 255, (1200, 1600)).astype(np.float32), (0, 0), 2.0)
    speckle = cv2.normalize(speckle, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    # The speckle covers 1.6 m by 1.2 m of the wall: 1000 pixels per metre.
    speckle_from_wall = np.array([[1000.0, 0.0, 800.0], [0.0, 1000.0, 600.0], [0.0, 0.0, 1.0]])
    cameras, images = [], []
    for number, angle in enumerate(np.radians([-15.0, 0.0, 15.0])):
        matrix = np.array([[FOCAL, 0.0, (SIZE[0] - 1) / 2], [0.0, FOCAL, (SIZE[1] - 1) / 2], [0.0, 0.0, 1.0]])
        pose = RigidTransform.from_vector(np.array([0.0, angle, 0.0]), np.array([0.0, 0.0, DISTANCE_M]))
        cameras.append(
            marey.Camera(
                name=f"cam{number + 1}", size=SIZE, matrix=matrix, distortion=np.zeros(5), camera_from_world=pose
            )
        )
        # A plane is seen through a homography: columns x, y and origin of the wall in the camera.
        image_from_wall = matrix @ np.column_stack([pose.rotation[:, 0], pose.rotation[:, 1], pose.translation])
        image_from_speckle = image_from_wall @ np.linalg.inv(speckle_from_wall)
        image = cv2.warpPerspective(speckle, image_from_speckle, SIZE, flags=cv2.INTER_AREA)
        images.append(np.repeat(image[..., None], 3, axis=2))
    return marey.Rig(tuple(cameras)), images


def main(arguments: list[str] | None = None) -> marey.Surface:
    """Match the images and print the statistics of the points."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("files", nargs="*", type=Path, help="folder with the calibration, and one image per camera")
    parser.add_argument("--spacing", type=int, default=8, help="distance of neighbouring points in the image [px]")
    given = parser.parse_args(arguments)

    if given.files:
        rig, images = marey.read_cameras(given.files[0]), given.files[1:]
    else:
        rig, images = speckled_wall()
    with marey.tuned_process():
        surface = marey.match_images(images, rig, spacing=given.spacing)
    print(surface)
    table = surface.to_pandas()
    print(table.describe().to_string())
    if not given.files:
        off = surface.points[:, 2]
        print(f"Distance from the wall: {1000 * np.sqrt(np.mean(off**2)):.3f} mm (RMS)")
    return surface


if __name__ == "__main__":
    main()
