import json
from typing import Any

import numpy as np
import pytest
from tests.made_scans import made_scan

from marey.errors import FileProblem
from marey.io.mr.correspondence import write_correspondence
from marey.io.mr.scanner_markers import read_landmarks, read_scanner_markers
from marey.knee.markers.correspondence import correspond
from marey.knee.markers.reference_posture import reference_posture
from marey.markers.kinematics.transform_chain import CAPTURE_ANATOMIC, MR_ANATOMIC, MR_GLOBAL, NamedTransform


def test_a_written_correspondence_is_read(rng, tmp_path):
    scan = made_scan(rng, noise_mm=0.5)
    posture = reference_posture(scan.activity, scan.standing)
    found = correspond(scan.scanner, posture, scan.bones, segment_of_label=scan.activity.segment_of_label)
    write_correspondence(tmp_path / "correspondence.json", found)
    bones = json.loads((tmp_path / "correspondence.json").read_text(encoding="utf-8"))["bones"]
    assert set(bones) == {"femur", "tibia"}
    for bone, written in bones.items():
        transform, right = transform_of(written), found.bones[bone].capture_anatomic_from_mr_global
        assert transform.matrix() == pytest.approx(right.matrix(), abs=1e-9)
        assert transform.covariance == pytest.approx(right.covariance, abs=1e-9)
    tibia = bones["tibia"]
    assert tibia["segment"] == "shank"
    assert list(tibia["markers"]) == [f"MR{n}" for n in range(5, 10)]
    assert tibia["rotation_sd_deg"] == pytest.approx(
        np.degrees(np.sqrt(np.diag(found.bones["tibia"].fit.covariance)[:3]))
    )


def transform_of(written: dict[str, Any]) -> NamedTransform:
    """Return the transform to `capture anatomic` from `MR global` [mm], composed of the written matrices."""
    direct, optimised = (
        np.array(written[key]) for key in ("mr_anatomic_from_mr_global", "capture_anatomic_from_mr_anatomic")
    )
    first = NamedTransform(to=MR_ANATOMIC, from_=MR_GLOBAL, rotation=direct[:3, :3], translation=direct[:3, 3])
    second = NamedTransform(
        to=CAPTURE_ANATOMIC, from_=MR_ANATOMIC, rotation=optimised[:3, :3], translation=optimised[:3, 3],
        covariance=np.array(written["covariance_rad_mm"]),
    )  # fmt: skip
    return second @ first


def test_what_a_user_wrote_beside_the_markers_is_read(tmp_path):
    table = {
        "marker_centres_lps_mm": [[1, 2, 3], [4, 5, 6]], "marker_centres_sd_mm": [[0.1, 0.1, 0.1]] * 2,
        "marker_names": ["KNE1", ""], "marker_segment": [None, "tibia"], "diameter_mm": [6, 6],
    }  # fmt: skip
    (tmp_path / "markers.json").write_text(json.dumps(table), encoding="utf-8")
    read = read_scanner_markers(tmp_path / "markers.json")
    assert read.centres_mm.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert read.names == ("KNE1", None)
    assert read.bones == (None, "tibia")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"marker_centres_lps_mm": [], "marker_centres_sd_mm": []}, "contains no marker"),
        ({"marker_names": ["A", "A"]}, "have the name A"),
        ({"marker_segment": ["hip", "femur"]}, "hip"),
    ],
)
def test_markers_that_cannot_be_used_are_reported(tmp_path, change, message):
    table = {"marker_centres_lps_mm": [[1, 2, 3], [4, 5, 6]], "marker_centres_sd_mm": [[0.1, 0.1, 0.1]] * 2, **change}
    (tmp_path / "markers.json").write_text(json.dumps(table), encoding="utf-8")
    with pytest.raises(FileProblem, match=message):
        read_scanner_markers(tmp_path / "markers.json")


def test_landmarks_are_read_and_invalid_ones_are_named(tmp_path):
    path = tmp_path / "landmarks.json"
    path.write_text('{"landmarks_lps_mm": {"LE": [1, 2, 3]}}', encoding="utf-8")
    assert read_landmarks(path).places_mm["LE"].tolist() == [1, 2, 3]
    path.write_text('{"landmarks_lps_mm": {"LE": [1, 2]}}', encoding="utf-8")
    with pytest.raises(FileProblem, match="does not have three numbers for LE"):
        read_landmarks(path)
    path.write_text("{}", encoding="utf-8")
    with pytest.raises(FileProblem, match="landmarks_lps_mm"):
        read_landmarks(path)
