import json
import re
from dataclasses import replace

import numpy as np
from tests.made_knees import made_grid, made_labels, made_volume

from marey.io.mr.gadolinium import MarkersInScanner
from marey.knee.bones.bones import BoneSegmentation
from marey.knee.space.structures import BONES
from marey.knee.space.surfacing import surface_of_labels
from marey.pipelines.knee.found_knee import FoundKnee, knee_verdict
from marey.pipelines.knee.segment_results import write_page
from marey.pipelines.progress import RecordingProgress


def test_bones_without_a_template_have_a_page(tmp_path):
    grid = made_grid((2.0, 2.0, 4.0))
    labels, progress = made_labels(grid), RecordingProgress()
    bones = BoneSegmentation(labels=labels, bones={}, kinds=("dark",), template_fit=None, notes=())
    surfaces = {bone: surface_of_labels(labels, bone, edge_mm=3.0) for bone in BONES}
    progress.warn("A note of the run.")
    (tmp_path / "femur.ply").touch()
    markers = MarkersInScanner(centres_mm=np.zeros((2, 3)), sd_mm=np.ones((2, 3)), diameter_mm=np.full(2, 6.0))
    found = FoundKnee(
        title="made", volume=made_volume(grid, "dark"), bones=bones, surfaces=surfaces, markers=markers, side="right",
        missing={"patella": "It was not found in the image."},
    )  # fmt: skip
    assert knee_verdict(found).texts() == (
        "usable with limits", ["The patella was not found. It was not found in the image."]
    )  # fmt: skip
    settings = {"template": None, "seeds_lps_mm": {"femur": [1.0, 2.5, -3.0]}, "seeds_given": [], "mirrored": False}
    write_page(tmp_path, found, labels, progress, settings=settings, pictures={})
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "No template was given" in page
    assert "A note of the run." in page
    assert "Not found: patella." in page
    assert ">given<" in page
    assert "femur 1.0, 2.5, -3.0" in page
    assert "seeds given" not in page
    assert "6.0 mm diameter" in page
    assert "femur.ply</code>" in page
    assert "tibia.ply</code>" not in page
    knee = json.loads(re.search(r'application/json">(.*?)</script>', page, re.S)[1])["knee"]  # type: ignore[index]
    assert knee["left"] is False
    assert "Page" in progress.timings


def test_the_verdict_on_a_knee_is_that_of_its_gravest_fault():
    labels = made_labels(made_grid((2.0, 2.0, 4.0)))
    bones = BoneSegmentation(labels=labels, bones={}, kinds=("dark",), template_fit=None, notes=())
    volume = made_volume(labels.grid, "dark")
    whole = FoundKnee(title="made", volume=volume, bones=bones, surfaces={}, side="right")
    assert knee_verdict(whole).level == "good"
    leaked = replace(whole, bones=replace(bones, limits=("The femur has an outgrowth.",)))
    assert knee_verdict(leaked).texts() == ("usable with limits", ["The femur has an outgrowth."])
    assert knee_verdict(replace(whole, missing={"tibia": "It is not in view."})).level == "not usable"
