"""Faults of glTF documents."""

import copy

import pytest

from marey.io.gltf.structure import array_fits, document_fault

SOUND = {
    "nodes": [{"children": [1, 2]}, {"translation": [0, 1, 2]}, {"mesh": 0, "skin": 0}],
    "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
    "skins": [{"joints": [0, 1]}],
    "accessors": [{"bufferView": 0, "componentType": 5126, "type": "VEC3", "count": 3}],
    "bufferViews": [{"buffer": 0, "byteOffset": 12}],
    "buffers": [{"byteLength": 48}],
}


def test_a_sound_document_has_no_fault():
    assert document_fault(SOUND) is None
    assert document_fault({}) is None


@pytest.mark.parametrize(
    ("place", "value", "wrong"),
    [
        (("nodes",), 3, "list of tables called nodes"),
        (("nodes", 0), "x", "list of tables called nodes"),
        (("nodes", 1, "children"), [0], "its own ancestor"),
        (("nodes", 1, "children"), [1], "its own ancestor|two parents"),
        (("nodes", 1, "children"), [2], "two parents"),
        (("nodes", 0, "children"), [7], "children that do not exist"),
        (("nodes", 0, "children"), 1, "children that do not exist"),
        (("nodes", 1, "translation"), [0, 1], "translation is not 3 numbers"),
        (("nodes", 1, "matrix"), [1e400] * 16, "matrix is not 16 numbers"),
        (("nodes", 2, "mesh"), True, "a mesh that does not exist"),
        (("nodes", 2, "skin"), -1, "a skin that does not exist"),
        (("skins", 0, "joints"), [], "without joints"),
        (("skins", 0, "joints"), [3], "joints that do not exist"),
        (("meshes", 0, "primitives"), [{}], "without primitives"),
        (("accessors", 0, "type"), "VEC9", "array 0 of an unknown type"),
        (("accessors", 0, "count"), -3, "outside its buffer"),
        (("accessors", 0, "bufferView"), 1, "outside its buffer"),
        (("bufferViews", 0, "buffer"), None, "part 0 of a buffer that does not exist"),
        (("bufferViews", 0, "byteOffset"), 10**400, "part 0 of a buffer that does not exist"),
    ],
)
def test_each_fault_is_named(place, value, wrong):
    document = copy.deepcopy(SOUND)
    node = document
    for key in place[:-1]:
        node = node[key]
    node[place[-1]] = value
    fault = document_fault(document)
    assert fault is not None
    assert any(each in fault for each in wrong.split("|"))


def test_an_array_must_lie_within_its_buffer():
    assert array_fits(3, 3, "<f4", 12, 12, 48)
    assert not array_fits(3, 3, "<f4", 13, 12, 48)
    assert not array_fits(4, 3, "<f4", 12, 12, 48)
    assert array_fits(0, 3, "<f4", 99, 12, 48)
