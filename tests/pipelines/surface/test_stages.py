"""Points of a surface that are read from the log of a run when they are used."""

import numpy as np
import pytest
from tests.pipelines.surface.test_verdict import part

from marey.io.stages import FrameLog
from marey.pipelines.surface.stages import KeptFrames
from marey.surface.points.measured import joined, shapes


@pytest.fixture
def log(tmp_path):
    with FrameLog(tmp_path / "surface") as log:
        for frame, count in ((4, 5), (5, 0), (6, 3)):
            arrays = part(frame, 0.1 * frame, count=count).arrays()
            names = arrays.pop("camera_names")
            log.append(
                {name: values.astype(np.float32) if name == "pixels" else values for name, values in arrays.items()}
            )
        yield log, tuple(names)


def test_kept_frames_are_those_that_were_stored(log):
    kept, names = KeptFrames(*log), log[1]
    assert [len(each) for each in kept] == [5, 0, 3]
    for each, expected in zip(
        kept, (part(4, 0.1 * 4), part(5, 0.1 * 5, count=0), part(6, 0.1 * 6, count=3)), strict=True
    ):
        assert each.camera_names == names
        for name in shapes(0):
            np.testing.assert_array_equal(getattr(each, name), getattr(expected, name))
            assert getattr(each, name).dtype == getattr(expected, name).dtype
        np.testing.assert_array_equal(each.views, expected.views)
    np.testing.assert_array_equal(joined(kept).frame, [4] * 5 + [6] * 3)
    assert len(kept[0][[1, 2]]) == 2
    with pytest.raises(IndexError):
        kept[3]


def test_a_field_that_points_do_not_have_is_named(log):
    with pytest.raises(AttributeError, match="weight"):
        assert KeptFrames(*log)[0].weight
