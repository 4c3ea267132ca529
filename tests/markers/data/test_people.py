"""People of a trial by the names before their labels."""

import pytest

from marey.markers.data.marker_set_tables import MARKER_SETS
from marey.markers.data.people import UNNAMED, people_of, wearers

LOWER = MARKER_SETS[0].labels
IOR = tuple(f"{label[0]}_{label[1:]}" for label in next(one for one in MARKER_SETS if one.key == "ior").labels)


def named(prefix: str, labels=LOWER) -> list[str]:
    return [f"{prefix}{label}" for label in labels]


def test_labels_without_names_are_of_nobody():
    assert people_of([*LOWER, "*110", "thigh_01", "thigh_02"]) == {}


@pytest.mark.parametrize("labels", [LOWER, IOR], ids=["Plug-in Gait", "IOR"])
@pytest.mark.parametrize("between", [":", "_"])
def test_names_are_before_a_colon_or_an_underscore(between, labels):
    found = people_of([*named(f"Ann{between}", labels), "*110", *named(f"Bo_2{between}", labels)])
    assert list(found) == ["Ann", "Bo_2"]
    assert found["Bo_2"] == {label: f"Bo_2{between}{label}" for label in labels}
    assert wearers(found) == ("Ann", "Bo_2")


def test_the_two_letters_of_the_sides_are_no_people():
    assert people_of(IOR) == {}


def test_prefixes_that_the_file_states_have_its_names():
    found = people_of([*named("A"), *named("AB-")], {"A": "Ann", "AB-": "Bo"})
    assert {name: len(own) for name, own in found.items()} == {"Ann": 16, "Bo": 16}


def test_things_have_names_but_wear_no_set():
    found = people_of([*named("Ann:"), "Box:LASI", "Box:2"])
    assert list(found) == ["Ann", "Box"]
    assert wearers(found) == ("Ann",)


def test_a_person_without_a_name_beside_one_with_it():
    found = people_of([*LOWER, *named("Ann:"), "*3"])
    assert list(found) == ["Ann", UNNAMED]
    assert found[UNNAMED] == {label: label for label in LOWER}


def test_a_label_that_ends_with_the_colon_has_no_name():
    assert people_of(["Ann:", "a"]) == {}
