import base64
import json
import re
from dataclasses import replace

import numpy as np
import pytest
from tests.made_knees import made_grid, made_labels, made_volume

from marey.knee.cartilage.outer_surface import CartilageSheet
from marey.knee.cartilage.subregions import subregions, whole
from marey.knee.space.structures import BONES
from marey.knee.space.surfacing import surface_of_labels
from marey.view.pages.knee_scene import thickness_codes
from marey.view.pages.knee_segment_report import SegmentReport, segment_html
from marey.view.pictures.flat_cartilage import flat_picture


@pytest.fixture(scope="module")
def report() -> SegmentReport:
    """A made knee with 2 mm of cartilage on the upper half of its tibia."""
    grid = made_grid((2.0, 2.0, 4.0))
    labels = made_labels(grid)
    bones = {bone: surface_of_labels(labels, bone, edge_mm=3.0) for bone in BONES}
    tibia = bones["tibia"]
    top = tibia.vertices_mm[:, 2] > -12
    sheet = CartilageSheet(
        bone=tibia, normals=tibia.vertex_normals, thickness_mm=np.where(top, 2.0, 0.0),
        thickness_sd_mm=np.where(top, 0.2, np.nan), confidence=np.ones(len(top)),
    )  # fmt: skip
    places = tibia.vertices_mm
    return SegmentReport(
        title="a & b", volume=made_volume(grid, "dark"), labels=labels, bones=bones, kinds=("dark",), left=True,
        sheets={"tibia": sheet}, parts={"tibial_cartilage": subregions("tibia", sheet, left=True)},
        flat={"tibial_cartilage": flat_picture(places[:, 0], places[:, 1], sheet.thickness_mm)},
        marker_diameter_mm=np.array([6.0, 6.2, 6.1]), notes=["<careful>"], settings={"template": "atlas"},
        files=["labels.nii.gz", "cartilage.csv"],
    )  # fmt: skip


def data_of(page: str) -> dict:
    return json.loads(re.search(r'application/json">(.*?)</script>', page, re.S)[1])  # type: ignore[index]


def unpacked(text: str, kind: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), kind)


def test_the_page_contains_sizes_notes_slices_parts_and_the_run(report):
    page = segment_html(report)
    for bone in report.bones.values():
        assert f"{bone.volume_mm3 / 1000:.1f} cm³" in page
        assert f"{bone.area_mm2 / 100:.0f} cm²" in page
    assert "2.00 mm" in page
    assert ">left<" in page
    assert "6.1 mm diameter" in page
    assert "a &amp; b" in page
    assert "&lt;careful&gt;" in page
    assert "<careful>" not in page
    assert page.count("data:image/jpeg") == 12 + 1
    assert "medial central" in page
    assert "cartilage.csv" in page
    assert "atlas" in page
    assert "femur.ply</code>" not in page
    assert 'id="play"' not in page
    assert 'id="slider"' not in page
    assert len(page) < 8e6


def test_bones_and_cartilage_have_the_positions_in_the_scanner(report):
    knee = data_of(segment_html(report))["knee"]
    assert [part["switch"] for part in knee["parts"]] == ["femur", "tibia", "patella", "tibial_cartilage"]
    assert all(part["shown"] for part in knee["parts"])
    part, outer = knee["parts"][-1], report.sheets["tibia"].outer
    places = unpacked(part["places"], "<u2").reshape(-1, 3) * part["step"] + part["low"]
    np.testing.assert_allclose(places, outer.vertices_mm, atol=part["step"])
    pose = unpacked(knee["motions"][0]["poses"]["tibia"], "<f4").reshape(3, 4)
    np.testing.assert_array_equal(pose, np.eye(4)[:3])
    codes = unpacked(part["maps"][0], "u1")
    assert (codes == thickness_codes(np.array([2.0]), 4.0)).all()
    assert len(codes) == len(outer.vertices_mm)


def test_thick_cartilage_has_the_colour_of_what_is_near():
    codes = thickness_codes(np.array([0.0, 1e-9, 2.0, 4.0, 6.0, np.nan]), 4.0)
    np.testing.assert_array_equal(codes, [0, 255, 2 + round(253 / 2), 2, 2, 0])


def test_without_cartilage_the_page_shows_bones_with_a_note(report):
    page = segment_html(replace(report, sheets={}, parts={}, flat={}, left=None, marker_diameter_mm=np.zeros(0)))
    assert "Bones only" in page
    assert "Bones of a knee" in page
    assert "none found on the skin" in page
    assert ">unknown<" in page
    knee = data_of(page)["knee"]
    assert knee["scale"] is None
    assert knee["left"] is None
    assert len(knee["parts"]) == 3
    assert "Parts of the cartilage" not in page
    assert page.count("data:image/jpeg") == 12


def test_the_whole_of_a_cartilage_needs_no_side_and_its_mesh_has_its_thickness(report):
    sheet = report.sheets["tibia"]
    assert whole(sheet).volume_mm3 == pytest.approx(report.parts["tibial_cartilage"][-1].volume_mm3)
    uneven = replace(sheet, thickness_mm=np.where(sheet.thickness_mm > 0, 1 + np.arange(len(sheet.normals)) * 1e-3, 0))
    inner = len(uneven.outer.vertices_mm) // 2
    height = np.linalg.norm(uneven.outer.vertices_mm[inner:] - uneven.outer.vertices_mm[:inner], axis=1)
    np.testing.assert_allclose(uneven.outer_thickness_mm, np.tile(height, 2))
