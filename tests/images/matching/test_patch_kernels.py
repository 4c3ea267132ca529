import pytest

from marey.images.matching.patch_kernels import padded_size
from marey.lanes import LANES


@pytest.mark.parametrize("half", [1, 2, 3, 6, 10, 11, 13, 24, 50])
def test_the_last_row_of_a_patch_has_place_for_whole_vectors(half):
    side, padded = 2 * half + 1, padded_size(half)
    assert padded >= side**2 - side + -(-side // LANES) * LANES
    assert padded % 32 == 0
