import numpy as np
import pytest
from scipy import ndimage
from tests.made_knees import made_grid, made_labels

from marey.errors import MareyError
from marey.knee.bones.template import CheckedTemplate, checked_template
from marey.knee.space.structures import LABELS
from marey.knee.space.volume import Labels

pytest.importorskip("skimage")
pytest.importorskip("fast_simplification")

GRID = made_grid((3.0, 3.0, 3.0))


def checked(labels: np.ndarray) -> CheckedTemplate:
    return checked_template(Labels(labels=labels, grid=GRID), edge_mm=5.0)


def whole_knee(*, mirror: bool = False) -> np.ndarray:
    """Bones, each covered by a sheet of cartilage 3 to 6 mm thick."""
    labels = np.array(made_labels(GRID, mirror=mirror).labels)
    for bone, cartilage in ((1, 2), (3, 4), (5, 6)):
        labels[ndimage.binary_dilation(labels == bone) & (labels == 0)] = cartilage
    return labels


def test_a_whole_knee_is_a_template_without_faults():
    found = checked(whole_knee())
    assert list(found.surfaces) == list(LABELS)
    assert found.faults == ()
    assert found.notes == ()
    assert all(surface.volume_mm3 > 0 for surface in found.surfaces.values())


def test_the_patella_shows_the_side():
    sides = {checked(whole_knee(mirror=mirror)).side for mirror in (False, True)}
    assert sides == {"left", "right"}


@pytest.mark.parametrize("bone", ["femur", "tibia"])
def test_a_missing_long_bone_is_a_fault(bone: str):
    labels = whole_knee()
    labels[labels == LABELS[bone]] = 0
    found = checked(labels)
    assert [fault.split(":")[0] for fault in found.faults] == [f"The {bone} is missing"]
    assert any(f"but no {bone}." in note for note in found.notes)


def test_a_template_of_bones_alone_names_the_cartilage_that_will_not_be_found():
    labels = made_labels(GRID).labels.copy()
    labels[labels == LABELS["patella"]] = 0
    found = checked(labels)
    assert found.side is None
    text = " ".join(found.notes)
    assert "femoral cartilage is missing" in text
    assert "patella is missing" in text


def test_cartilage_away_from_its_bone_is_reported():
    labels = whole_knee()
    labels[labels == LABELS["tibial_cartilage"]] = 0
    top = np.flatnonzero((labels == LABELS["tibia"]).any(axis=(1, 2)))[0]
    labels[top : top + 6, 2:8, 2:8] = LABELS["tibial_cartilage"]
    found = checked(labels)
    assert any("tibial cartilage" in note and "away from the tibia" in note for note in found.notes)


def test_pieces_and_hollows_of_a_bone_are_reported():
    labels = whole_knee()
    labels[-6:, :6, :6] = LABELS["femur"]
    inner = ndimage.binary_erosion(labels == LABELS["tibia"], iterations=4)
    labels[inner] = 0
    text = " ".join(checked(labels).notes)
    assert "femur is in 2 pieces" in text
    assert "tibia is hollow" in text


def test_labels_without_any_bone_are_no_template():
    labels = np.where(whole_knee() == LABELS["femoral_cartilage"], LABELS["femoral_cartilage"], 0)
    with pytest.raises(MareyError, match="contains no bone"):
        checked(labels)
