import numpy as np
import pytest
from tests.made_joints import made_joint

from marey.knee.space.structures import BONE_OF_CARTILAGE
from marey.view.pictures.knee_maps import FAR, OVERLAP, proximity_colours
from marey.view.pictures.knee_picture import PANEL, VIEWS, DrawnPart, KneeCamera, KneeInstant, KneePicture, axes_of_view

BAR = 30


def picture(*views: str, left: bool = False) -> tuple[KneePicture, dict[str, DrawnPart]]:
    parts = {
        name: DrawnPart(bone=BONE_OF_CARTILAGE.get(name, name), surface=part, cartilage=name in BONE_OF_CARTILAGE)
        for name, part in made_joint(left=left, fine=3).items()
    }
    corners = np.concatenate([part.surface.vertices_mm for part in parts.values()])
    cameras = {view: KneeCamera(axes_of_view(view, left=left), corners) for view in views}
    return KneePicture(parts, cameras, limit_mm=5.0), parts


def instant(parts: dict[str, DrawnPart], *bones: str, **more: object) -> KneeInstant:
    return KneeInstant(caption="", poses={bone: np.eye(4) for bone in bones}, distance_mm={}, **more)  # type: ignore[arg-type]


def inked(drawn: np.ndarray, number: int = 0) -> np.ndarray:
    """Where something is drawn in a panel, its captions left out."""
    panel = drawn[BAR : BAR + PANEL - 24, number * PANEL : (number + 1) * PANEL]
    return np.asarray((panel.astype(int) < 240).any(2))


@pytest.mark.parametrize("left", [False, True])
def test_the_axes_of_views_are_right_handed_and_look_from_their_sides(left: bool):
    for view in VIEWS:
        axes = axes_of_view(view, left=left)
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(axes) == pytest.approx(1)
    np.testing.assert_allclose(axes_of_view("anterior", left=left)[2], [0, 1, 0])
    # LPS x grows to the left: of a left knee the medial side is that of low x, and one looks from there towards high.
    np.testing.assert_allclose(axes_of_view("medial", left=left)[2], [1 if left else -1, 0, 0])
    np.testing.assert_allclose(axes_of_view("plateau", left=left)[1], [0, 1, 0])


def test_the_femur_is_above_and_the_patella_in_front():
    drawing, parts = picture("medial")
    rows = {bone: np.argwhere(inked(drawing.draw(instant(parts, bone)))) for bone in ("femur", "tibia", "patella")}
    middle = {bone: places.mean(0) for bone, places in rows.items()}
    assert middle["femur"][0] < middle["tibia"][0]
    # From the medial side of a right knee one sees its front at the left.
    assert middle["patella"][1] < middle["femur"][1] - 20


def test_all_of_the_knee_is_in_the_image_and_fills_it():
    drawing, parts = picture("anterior")
    ink = np.argwhere(inked(drawing.draw(instant(parts, "femur", "tibia", "patella"))))
    low, high = ink.min(0), ink.max(0)
    assert (low > 2).all()
    assert (high < PANEL - 3).all()
    assert (high - low).max() > 0.75 * PANEL


def test_the_plateau_is_seen_without_the_femur():
    drawing, parts = picture("plateau")
    with_femur, without = (drawing.draw(instant(parts, *bones)) for bones in (("tibia", "femur"), ("tibia",)))
    np.testing.assert_array_equal(with_femur, without)


def test_near_cartilage_is_red_and_its_path_is_drawn():
    drawing, parts = picture("plateau")
    plain = drawing.draw(instant(parts, "tibia"))
    count = len(parts["tibial_cartilage"].surface.vertices_mm)
    near = KneeInstant(
        caption="", poses={"tibia": np.eye(4)}, distance_mm={"tibial_cartilage": np.full(count, 0.2)},
        paths_mm=[np.array([[22.0, -10, 0], [22, 10, 0]])],
    )  # fmt: skip
    drawn = drawing.draw(near)[BAR : BAR + PANEL].astype(int)
    red = (drawn[..., 2] > drawn[..., 0] + 60) & (drawn[..., 2] > drawn[..., 1] + 60)
    assert red.mean() > 0.1
    assert (drawn.max(2) < 60).sum() > 40
    assert not ((plain[BAR:-BAR, ..., 2].astype(int) - plain[BAR:-BAR, ..., 0]) > 60).any()


def test_a_frame_without_a_result_shows_no_bone():
    drawing, parts = picture("anterior")
    # Only the words of the note.
    assert inked(drawing.draw(instant(parts))).mean() < 0.01


def test_colours_distinguish_overlap_near_and_far():
    overlap, near, limit, far, unknown = proximity_colours(np.array([-0.5, 0.0, 4.99, 5.0, np.nan]), 5.0)
    assert tuple(overlap) == OVERLAP
    assert near[0] > near[2] + 100
    assert limit[2] > limit[0] + 80
    assert tuple(far) == tuple(unknown) == FAR
