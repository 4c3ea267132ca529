import pytest

from marey.markers.data.marker_set_tables import MARKER_SETS, MarkerSet, plain_label
from marey.markers.data.marker_sets import cluster_marker_set, recognise_marker_sets

SETS = {known.name: known for known in MARKER_SETS}
LOWER = SETS["Plug-in Gait, lower body"].labels


@pytest.mark.parametrize("known", MARKER_SETS, ids=lambda known: known.name)
def test_each_set_is_recognised_from_its_own_labels_in_any_order(known: MarkerSet):
    labels = [*reversed(known.labels), "*110", "thigh_01"]
    (found,) = recognise_marker_sets(labels)
    assert (found.marker_set, found.missing, found.person) == (known, (), "")
    assert found.sentence == f"The labels are those of the marker set {known.name}; none is missing."


@pytest.mark.parametrize("known", MARKER_SETS, ids=lambda known: known.name)
def test_the_labels_of_a_set_are_distinct_and_have_both_sides(known: MarkerSet):
    assert len(set(known.labels)) == len(known.labels)
    left = {label[1:] for label in known.labels if label.startswith("L")}
    assert left == {label[1:] for label in known.labels if label[0] in "Rr"}
    assert len({plain_label(label) for label in known.labels}) == len(known.labels)


@pytest.mark.parametrize("known", MARKER_SETS, ids=lambda known: known.name)
def test_every_set_has_the_landmarks_and_segments_of_pelvis_and_legs(known: MarkerSet):
    assert {"RASIS", "LASIS", "RPSIS", "LPSIS"} <= set(known.landmarks)
    for side in ("left", "right"):
        assert {f"{side}_{name}" for name in ("LE", "ME", "LM", "MM", "CA")} <= set(known.landmarks)
        assert {f"{side}_TOE", f"{side}_M1"} & set(known.landmarks)
        assert {f"{side}_{name}" for name in ("thigh", "shank", "foot")} <= set(known.segments)
        letter = {"left": "L", "right": "R"}[side]
        marks = [label for name, choices in known.landmarks.items() if name.startswith(side) for (label,) in choices]
        marks += [label for name, labels in known.segments.items() if name.startswith(side) for label in labels]
        assert {label[0].upper() for label in marks} == {letter}
    assert len({one.key for one in MARKER_SETS}) == len(MARKER_SETS)


@pytest.mark.parametrize("part", ["lower", "full"])
def test_of_two_sets_with_as_many_markers_in_the_trial_the_one_without_a_missing_marker_is_recognised(part: str):
    keys = {known.key: known for known in MARKER_SETS}
    (found,) = recognise_marker_sets(keys[f"cgm2.3-{part}"].labels)
    assert (found.marker_set.key, found.missing) == (f"cgm2.3-{part}", ())


def test_dots_and_underscores_are_not_distinguished():
    labels = [f"{label[0]}_{label[1:]}" for label in SETS["IOR"].labels]
    assert recognise_marker_sets(labels)[0].missing == ()


def test_numbers_of_markers_are_those_of_the_models():
    assert [len(known.labels) for known in MARKER_SETS] == [16, 34, 24, 42, 28, 46, 22, 28, 35, 23]


def test_missing_markers_are_named():
    (found,) = recognise_marker_sets([label for label in LOWER if label not in ("LKNE", "RTOE")])
    assert found.missing == ("LKNE", "RTOE")
    assert found.sentence.endswith("Plug-in Gait, lower body; missing: LKNE, RTOE.")


def test_a_set_is_recognised_from_four_fifths_of_its_markers():
    assert recognise_marker_sets(LOWER[:13])
    assert not recognise_marker_sets(LOWER[:12])


def test_one_marker_on_the_sacrum_replaces_two():
    (found,) = recognise_marker_sets([*(label for label in LOWER if "PSI" not in label), "SACR"])
    assert found.missing == ()


def test_upper_and_lower_case_are_not_distinguished():
    (found,) = recognise_marker_sets([label.lower() for label in LOWER])
    assert found.missing == ()


def test_two_people_are_recognised_separately():
    labels = [f"Ann:{label}" for label in LOWER] + [f"Bo:{label}" for label in LOWER[1:]]
    ann, bo = recognise_marker_sets(labels)
    assert (ann.person, ann.missing, bo.person, bo.missing) == ("Ann", (), "Bo", (LOWER[0],))
    assert bo.sentence.startswith("The labels of Bo are")


@pytest.mark.parametrize("labels", [[], ["thigh_01", "thigh_02"], ["LASI", "RASI", "SACR"], ["", ":", "*1"]])
def test_other_labels_are_no_set(labels: list[str]):
    assert recognise_marker_sets(labels) == ()


def numbered(*words: str, count: int = 4, form: str = "{side}{word}{k}") -> list[str]:
    return [form.format(side=side, word=word, k=k) for side in "RL" for word in words for k in range(1, count + 1)]


SHOWN = ["RASI", "LASI", "SACR", *(f"{side}{name}" for side in "RL" for name in ("LK", "MK", "LA", "MA", "HEE", "TOE"))]


@pytest.mark.parametrize(
    "labels",
    [
        numbered("TH", "SK"),
        numbered("Thigh", "Shank", count=3, form="{side}_{word}_{k:02d}"),
        numbered("thigh", "tibia", form="{word}.{side}.{k}"),
        [
            label.replace("R", "right_").replace("L", "left_")
            for label in numbered("thigh", "shank", form="{side}{word}{k}")
        ],
    ],
)
def test_numbered_clusters_are_recognised_with_landmarks_of_the_static_trial(labels):
    found = cluster_marker_set([*labels, "RHEE"], [*labels, *SHOWN])
    assert found is not None
    segments = found.marker_set.segments
    half = len(labels) // 4
    assert [len(segments[f"{side}_{part}"]) for side in ("left", "right") for part in ("thigh", "shank")] == [half] * 4
    assert (segments["right_foot"], segments["left_foot"], segments["pelvis"]) == (("RHEE",), (), ())
    assert found.marker_set.landmarks["right_LE"][0] == ("RLK",)
    assert found.marker_set.landmarks["left_CA"][0] == ("LHEE",)


def test_a_cluster_on_the_pelvis_follows_it():
    labels = [*numbered("TH", "SK"), "PV1", "PV2", "PV3", "RASI"]
    found = cluster_marker_set(labels, [*labels, *SHOWN])
    assert found is not None
    assert found.marker_set.segments["pelvis"] == ("PV1", "PV2", "PV3")


def test_one_leg_is_enough_and_a_leg_without_landmarks_is_left_out():
    labels = numbered("TH", "SK")
    found = cluster_marker_set(labels, [*labels, *(label for label in SHOWN if label not in ("LLK", "LLA"))])
    assert found is not None
    assert {name for name, own in found.marker_set.segments.items() if own} == {"right_thigh", "right_shank"}


@pytest.mark.parametrize(
    ("labels", "shown"),
    [
        (numbered("TH", "SK", count=2), SHOWN),
        (["thigh1", "thigh2", "thigh3"], SHOWN),
        (["RTHL1", "RTHL2", "RTHL3"], SHOWN),
        (numbered("TH", "SK"), SHOWN[2:]),
        (numbered("TH", "SK"), [label for label in SHOWN if label[1:] != "LA"]),
        (numbered("AR", "BOX"), SHOWN),
    ],
    ids=["two markers", "no side", "two sides", "no spines", "no ankles", "other segments"],
)
def test_other_labels_are_no_clusters_with_landmarks(labels, shown):
    assert cluster_marker_set(labels, shown) is None
