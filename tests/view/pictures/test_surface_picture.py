import numpy as np
from tests import scenes

from marey.surface.points.measured import MeasuredPoints
from marey.view.pictures.surface_picture import depth_picture, lit_picture

RIG = scenes.rig(-10, 0, 10)


def ball_points(spacing=4):
    """Points of the ball on a grid of the middle image."""
    camera = RIG.cameras[1]
    y, x = np.mgrid[8:232:spacing, 8:252:spacing]
    pixels = np.stack([x.ravel(), y.ravel()], axis=-1).astype(float)
    ray = camera.rays(pixels).directions
    along = -ray @ camera.centre
    square = along**2 - camera.centre @ camera.centre + scenes.RADIUS**2
    hit = square > 0
    points = camera.centre + (along - np.sqrt(np.maximum(square, 0)))[hit, None] * ray[hit]
    seen = np.stack([pixels[hit] if c == 1 else other.project(points) for c, other in enumerate(RIG)], axis=1)
    count = len(points)
    return MeasuredPoints(
        frame=np.zeros(count), points=points, covariance=np.tile(1e-8 * np.eye(3), (count, 1, 1)),
        camera_names=RIG.names, pixels=seen, correlation=np.tile([0.9, 1.0, 0.9], (count, 1)),
        residual_px=np.zeros(count), colour=np.zeros((count, 3)),
    )  # fmt: skip


def test_points_cover_their_place_and_near_ones_are_red():
    points, camera = ball_points(), RIG.cameras[1]
    drawn = depth_picture(points, camera, 1, np.full((*camera.size[::-1], 3), 100, np.uint8))
    assert (drawn[3, 3] == 45).all()
    depth = camera.depths(points.points)
    nearest, farthest = (points.pixels[find(depth), 1].astype(int) for find in (np.argmin, np.argmax))
    blue, _, red = np.array([drawn[y, x] for x, y in (nearest, farthest)]).T.astype(int)
    assert red[0] > blue[0]
    assert blue[1] > red[1]


def test_a_ball_is_lit_from_above_and_the_left():
    lit = lit_picture(ball_points(), RIG.cameras[1], 1)[..., 0].astype(int)
    x, y = (RIG.cameras[1].project(np.zeros(3))).astype(int)
    assert lit[y - 45, x - 45] > lit[y, x] > lit[y + 45, x + 45]
    assert lit[5, 5] == 0


def test_a_camera_without_a_template_shows_nothing():
    points, camera = ball_points(), RIG.cameras[0]
    assert not lit_picture(points, camera, 0).any()
    assert (depth_picture(points, camera, 0, np.full((240, 260, 3), 100, np.uint8)) == 45).all()
