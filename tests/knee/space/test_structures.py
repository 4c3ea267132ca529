import pytest

from marey.knee.space.structures import structure_named


@pytest.mark.parametrize(
    ("text", "structure"),
    [
        ("lateral tibial cartilage", "tibial_cartilage"),
        ("Medial_Tibial_Cartilage", "tibial_cartilage"),
        ("femoral cartilage (trusted slices only)", "femoral_cartilage"),
        ("left femur", "femur"),
        ("biceps femoris muscle", None),
        ("fibula", None),
    ],
)
def test_names_of_others_tables_are_understood(text, structure):
    assert structure_named(text) == structure
