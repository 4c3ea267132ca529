import pytest

from marey.errors import MareyError
from marey.markers.data.labels import clusters_from_names, find_clusters, segment_from_label


@pytest.mark.parametrize(
    ("label", "segment"),
    [
        ("thigh_01", "thigh"),
        ("LF05", "LF"),
        ("left_shank.3", "left_shank"),
        ("genou1_NewMarker12", "genou1_NewMarker"),
        ("heel", None),
        ("*110", None),
        ("*Unnamed_58", None),
        ("12", None),
    ],
)
def test_a_segment_is_the_label_without_its_number(label: str, segment: str | None):
    assert segment_from_label(label) == segment


def test_clusters_need_three_markers_and_the_rest_is_listed():
    found = find_clusters(["heel", "thigh_01", "thigh_02", "C7", "thigh_03", "*4"])
    assert [(c.segment, c.labels) for c in found.clusters] == [("thigh", ("thigh_01", "thigh_02", "thigh_03"))]
    assert found.skipped == ("heel", "C7", "*4")
    assert "heel, *4" in " ".join(found.notes)
    assert "C7" in found.notes[0]


def test_many_labels_of_no_segment_are_one_short_note():
    letters = [f"{a}{b}" for a in "ABCDEFGH" for b in "KLMNPQRSTU"]
    notes = (find_clusters(letters).notes, clusters_from_names({"t": ("t*",)}, ["t1", "t2", "t3", *letters]).notes)
    for note in notes:
        assert len(note) == 1
        assert note[0].endswith("AK, AL, AM, AN, AP, AQ, AR, AS, AT, AU, BK, BL and 68 more.")


def test_all_groups_of_fewer_than_three_markers_are_one_note():
    (note,) = find_clusters(["C7", "T10", "heel_1", "heel_2"]).notes
    assert note.endswith("at least 3 markers; labels of smaller groups are ignored: C7, T10, heel_1, heel_2.")


def test_named_clusters_accept_patterns_and_report_what_is_missing():
    found = clusters_from_names({"knee": ("k*", "*9", "gone")}, ["k1", "k2", "*9", "x"])
    assert found.clusters[0].labels == ("k1", "k2", "*9")
    assert any("without gone" in note for note in found.notes)
    assert found.skipped == ("x",)


def test_all_faults_of_named_clusters_come_at_once():
    with pytest.raises(MareyError, match=r"thigh has 2 markers.*missing: c.*marker a belongs to both"):
        clusters_from_names({"thigh": ("a", "b", "c"), "shank": ("a", "d", "e")}, ["a", "b", "d", "e"])
