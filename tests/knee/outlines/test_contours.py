import numpy as np
import pytest

from marey.errors import MareyError
from marey.knee.outlines.contours import (
    AXES,
    Contour,
    labels_of_contours,
    outlined_mask,
    slice_count,
    slice_distance,
    slice_of,
    slice_shape,
    slice_spacing_mm,
    structure_distance,
)
from marey.knee.space.structures import LABELS
from marey.knee.space.volume import VoxelGrid

GRID = VoxelGrid(
    shape=(20, 24, 28), lps_from_voxel=np.array([[-1.0, 0, 0, 5], [0, 0, 2.0, 6], [0, -1.5, 0, 7], [0, 0, 0, 1]])
)
CENTRE_VOXEL = np.array([14.0, 12.0, 10.0])


def ellipse(axis: str, index: int, *, structure: str = "femur", radius_mm: float = 12.03) -> Contour | None:
    """Where a ball about the middle crosses a slice."""
    spacing, along = GRID.spacing_mm, AXES.index(axis)
    off = (index - CENTRE_VOXEL[along]) * spacing[along]
    if abs(off) >= radius_mm:
        return None
    radius, angle = np.sqrt(radius_mm**2 - off**2), np.linspace(0, 2 * np.pi, 400, endpoint=False)
    x, y = np.delete(CENTRE_VOXEL, along)
    across, down = np.delete(spacing, along)
    outline = np.column_stack([x + radius / across * np.cos(angle), y + radius / down * np.sin(angle)])
    return Contour(structure=structure, axis=axis, index=index, anchors=outline[::100], outline=outline)


def ball(radius_mm: float = 12.03) -> np.ndarray:
    k, j, i = np.meshgrid(*[np.arange(n) for n in GRID.shape], indexing="ij")
    off = GRID.lps(np.stack([i, j, k], -1).astype(float)) - GRID.lps(CENTRE_VOXEL)
    return np.linalg.norm(off, axis=-1) < radius_mm


def cut(axis: str, indices: range | list[int], **how: object) -> list[Contour]:
    found = [ellipse(axis, index, **how) for index in indices]
    return [each for each in found if each is not None]


@pytest.mark.parametrize("axis", AXES)
def test_slices_along_every_axis_are_rows_and_columns_of_the_volume(axis: str):
    array = np.arange(20 * 24 * 28).reshape(GRID.shape)
    part = slice_of(array, axis, 3)
    assert part.shape == slice_shape(GRID, axis)
    assert slice_count(GRID, axis) * part.size == array.size
    row, column = 5, 7
    voxel = np.insert([column, row], AXES.index(axis), 3)
    assert part[row, column] == array[tuple(voxel[::-1])]
    rows_mm, columns_mm = slice_spacing_mm(GRID, axis)
    here, right = GRID.lps(voxel.astype(float)), np.insert([column + 1, row], AXES.index(axis), 3).astype(float)
    assert np.linalg.norm(GRID.lps(right) - here) == pytest.approx(columns_mm)
    assert {rows_mm, columns_mm} <= set(GRID.spacing_mm.tolist())


@pytest.mark.parametrize("axis", AXES)
def test_outlines_in_every_slice_fill_the_body_they_were_cut_from(axis: str):
    labels = labels_of_contours(cut(axis, range(slice_count(GRID, axis))), GRID)
    assert np.array_equal(labels.mask("femur"), ball())


@pytest.mark.parametrize("axis", AXES)
def test_slices_between_outlines_are_interpolated(axis: str):
    every = cut(axis, range(slice_count(GRID, axis)))
    some = [*every[::3], every[-1]]
    filled, whole = labels_of_contours(some, GRID).mask("femur"), ball()
    assert 2 * (filled & whole).sum() / (filled.sum() + whole.sum()) > 0.96


def test_nothing_is_interpolated_before_the_first_outline_and_after_the_last():
    contours = cut("k", [8, 12])
    assert slice_distance(contours, GRID, "femur", 7) is None
    assert slice_distance(contours, GRID, "femur", 13) is None
    assert slice_distance(contours, GRID, "tibia", 10) is None
    inside = labels_of_contours(contours, GRID).mask("femur").any(axis=(1, 2))
    assert np.flatnonzero(inside).tolist() == [8, 9, 10, 11, 12]


def test_one_slice_and_all_slices_agree():
    contours = cut("k", [5, 8, 11, 12, 15])
    whole = structure_distance(contours, GRID, "femur")
    for index in (5, 6, 9, 11, 13, 14):
        one = slice_distance(contours, GRID, "femur", index)
        assert one is not None
        np.testing.assert_allclose(one, whole[index], atol=1e-4)


def test_halfway_between_two_outlines_the_edge_lies_halfway():
    contours = [ellipse("k", 10, radius_mm=6.0), ellipse("k", 10, radius_mm=12.0)]
    contours = [Contour(structure="femur", axis="k", index=10 + 4 * n, anchors=c.anchors, outline=c.outline)
                for n, c in enumerate(contours) if c is not None]  # fmt: skip
    between = slice_distance(contours, GRID, "femur", 12)
    row, column = np.argwhere(np.abs(between) < 0.3).T
    off = np.hypot((column - CENTRE_VOXEL[0]) * GRID.spacing_mm[0], (row - CENTRE_VOXEL[1]) * GRID.spacing_mm[1])
    assert np.abs(off - 9.0).max() < 1.0


def test_two_outlines_of_a_structure_in_one_slice_are_both_filled():
    left, right = (np.array([[2, 2], [2, 6], [6, 6], [6, 2]]) + [shift, 0] - 0.5 for shift in (0, 10))
    both = [
        Contour(structure="tibial_cartilage", axis="k", index=4, anchors=each, outline=each) for each in (left, right)
    ]
    assert outlined_mask(both, (24, 28)).sum() == 32
    assert (labels_of_contours(both, GRID).labels == LABELS["tibial_cartilage"]).sum() == 32


def test_a_voxel_in_two_structures_belongs_to_the_one_in_which_it_lies_deeper():
    contours = [*cut("k", [10]), *cut("k", [10], structure="femoral_cartilage", radius_mm=5.0)]
    assert labels_of_contours(contours, GRID).mask("femur").sum() == ball()[10].sum()


def test_points_of_an_outline_have_the_coordinates_of_the_grid():
    contour = cut("j", [9])[0]
    voxels = np.insert(contour.outline, 1, contour.index, axis=1)
    off = np.linalg.norm(GRID.lps(voxels) - GRID.lps(CENTRE_VOXEL), axis=1)
    np.testing.assert_allclose(off, 12.03)


def test_outlines_across_two_axes_and_none_at_all_are_errors():
    with pytest.raises(MareyError, match="across i and k"):
        labels_of_contours([*cut("k", [10]), *cut("i", [10])], GRID)
    with pytest.raises(MareyError, match="no outlines"):
        labels_of_contours([], GRID)
    with pytest.raises(MareyError, match="no outline of the patella"):
        structure_distance(cut("k", [10]), GRID, "patella")
