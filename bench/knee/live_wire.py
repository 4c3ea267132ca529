"""The live wire: its response time, its distance from true outlines, and templates outlined with it.

No person takes part: anchors lie on the true outlines, evenly along them and off by half a pixel (one standard
deviation, each way) as a hand is.
"""

import argparse
import http.client
import json
import tempfile
import threading
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy import ndimage
from scipy.interpolate import interp1d
from scipy.spatial import cKDTree
from skimage.measure import find_contours

from bench.common.parts import add_parts, run_parts
from bench.declaration import Bench
from bench.recording import Column, Run
from marey.arrays import Floats, Mask
from marey.io.mr.volumes import read_template, read_volume
from marey.knee.bones.bones import segment_bones
from marey.knee.bones.template import checked_template
from marey.knee.outlines.boundary_elements import LearnedCosts, learned_costs
from marey.knee.outlines.contours import (
    AXES,
    Contour,
    labels_of_contours,
    outlined_mask,
    slice_of,
    slice_shape,
    slice_spacing_mm,
    structure_distance,
)
from marey.knee.outlines.live_wire import LiveWire
from marey.knee.outlines.outlining import drawn
from marey.knee.space.distances import signed_distance
from marey.knee.space.structures import BONES, LABELS
from marey.knee.space.volume import Labels, Volume
from marey.pipelines.knee.outline import serve
from marey.view.outline.server import OutlineServer
from marey.view.outline.session import OutlineSession

BENCH = Bench(
    measures="Response time and accuracy of outlines by the live wire, against true outlines.",
    sources=("src/marey/knee/outlines", "src/marey/knee/space", "src/marey/view/outline"),
    minutes=5,
)
HAND_PX = 0.5
SHORTEST_PX = 60
EVERY = 6
PIXELS_PER_ANCHOR = 50


def volume_and_truth(folder: Path) -> tuple[Volume, Labels, str]:
    """A volume, its true labels, and the axis across which its slices lie farthest apart."""
    volume = read_volume(folder / "image.nii.gz")
    name = "reference_labels.nii.gz" if folder.name == "dess" else "truth_labels.nii.gz"
    labels = read_volume(folder / name).intensity.astype(np.uint8)
    return volume, Labels(labels=labels, grid=volume.grid), AXES[int(np.argmax(volume.grid.spacing_mm))]


def true_outlines(mask: Mask) -> list[Floats]:
    """(N, 2) x and y of the level lines of a mask that is smoothed by a pixel: its staircase is not the truth."""
    smooth = ndimage.gaussian_filter(np.pad(mask.astype(float), 6), 1.0)
    return [line[:-1, ::-1] - 6 for line in find_contours(smooth, 0.5) if len(line) > SHORTEST_PX]


def hand_set(outline: Floats, count: int, draw: np.random.Generator) -> Floats:
    """(count, 2) anchors evenly along an outline, begun anywhere, as a hand sets them."""
    start = draw.integers(len(outline))
    places = (start + np.arange(count) * len(outline) // count) % len(outline)
    return outline[places] + draw.normal(0, HAND_PX, (count, 2))


def distance_mm(first: Floats, second: Floats, spacing_mm: tuple[float, float]) -> float:
    """Mean distance of two outlines, both ways."""
    dense = []
    for outline in (first, second):
        corners = np.vstack([outline, outline[:1]]) * spacing_mm[::-1]
        along = np.r_[0, np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))]
        at = np.arange(0, along[-1], 0.05)
        dense.append(np.column_stack([np.interp(at, along, corners[:, n]) for n in range(2)]))
    there, back = cKDTree(dense[1]).query(dense[0])[0], cKDTree(dense[0]).query(dense[1])[0]
    return float(there.mean() + back.mean()) / 2


def dice(first: Mask, second: Mask) -> float:
    return float(2 * (first & second).sum() / (first.sum() + second.sum()))


def speed(run: Run) -> None:
    """A slice of 512 x 512: all corners as anchors, the farthest corner first, then moves about the image."""
    folder = run.shared / "data" / "knee"
    volume, truth, axis = volume_and_truth(folder / "dess")
    index = 30
    image, spacing = slice_of(volume.intensity, axis, index), slice_spacing_mm(volume.grid, axis)
    mask = slice_of(truth.mask("femur"), axis, index)
    LiveWire(image, spacing).closed([(100, 100), (300, 120), (200, 300)])  # compiled, or read from Numba's cache
    started = time.perf_counter()
    wire = LiveWire(image, spacing)
    made = time.perf_counter() - started
    learned = learned_costs([(wire.elements, mask)])
    started = time.perf_counter()
    wire.learn(learned)
    trained = time.perf_counter() - started
    table = run.table(
        f"Time of the wire's moves, a slice of {image.shape[0]} x {image.shape[1]}", "wire",
        *(Column(f"{move} move, {what}", "ms", 1) for move in ("first", "every next") for what in ("median", "worst")),
        note=f"The slice is prepared in {1e3 * made:.0f} ms, and trained in {1e3 * trained:.0f} ms.",
    )  # fmt: skip
    for name, costs in (("not trained", None), ("trained on another slice", learned)):
        wire.learn(costs)
        table.row(name, *timed_moves(wire))
    table.row("by HTTP, request and response", *timed_answers(volume, axis, index))


def timed_moves(wire: LiveWire) -> list[float]:
    far, near = [], []
    draw = np.random.default_rng(1)
    corners = [(0.0, 0.0), (511.0, 0.0), (511.0, 511.0), (0.0, 511.0), (255.0, 255.0)]
    for anchor in corners * 4:
        wire.forget()
        opposite = max(corners, key=lambda each: np.hypot(each[0] - anchor[0], each[1] - anchor[1]))
        started = time.perf_counter()
        wire.anchor(anchor)
        wire.path_to(opposite)
        far.append(time.perf_counter() - started)
        for point in draw.uniform(0, 511, (10, 2)):
            started = time.perf_counter()
            wire.path_to(point)
            near.append(time.perf_counter() - started)
    return [*spread(far), *spread(near)]


def timed_answers(volume: Volume, axis: str, index: int) -> list[float]:
    """The same by the page: from the request to the response."""
    with tempfile.TemporaryDirectory() as folder:
        server = OutlineServer(OutlineSession(volume, Path(folder) / "contours.json", "dess"))
        thread = threading.Thread(target=serve, args=(server,))
        thread.start()
        connection = http.client.HTTPConnection("127.0.0.1", server.server_address[1])

        def seconds(path: str, body: dict[str, object]) -> float:
            started = time.perf_counter()
            connection.request("POST", server.root + path, json.dumps(body), {"Content-Type": "application/json"})
            answer = connection.getresponse()
            answer.read()
            assert answer.status == 200
            return time.perf_counter() - started

        asking = {"axis": axis, "index": index, "structure": "femur"}
        seconds("/prepare", asking)
        far, near = [], []
        draw = np.random.default_rng(2)
        for anchor in draw.uniform(0, 60, (20, 2)):
            far.append(seconds("/wire", asking | {"anchors": [anchor.tolist()], "pointer": [500, 500]}))
            for point in draw.uniform(0, 511, (5, 2)):
                near.append(seconds("/wire", asking | {"anchors": [anchor.tolist()], "pointer": point.tolist()}))
        connection.close()
        server.shutdown()
        thread.join()
    return [*spread(far), *spread(near)]


def spread(seconds: list[float]) -> tuple[float, float]:
    """Median and worst, in milliseconds."""
    return 1e3 * float(np.median(seconds)), 1e3 * max(seconds)


def outlines(run: Run) -> None:
    """Outlines through some anchors in eight slices, not trained, and trained on the true outline before each."""
    folder = run.shared / "data" / "knee"
    table = run.table(
        "Mean distance of outlines from the truth",
        ("volume", "structure", "anchors"),
        Column("not trained", "mm", 2),
        Column("trained", "mm", 2),
        Column("moved onto the edge", "mm", 2),
        Column("Dice", "", 3),
        Column("95 % within", "mm", 2),
    )
    for name, structures in (("phantom_a", tuple(LABELS)), ("phantom_spl", BONES), ("dess", ("femur", "tibia"))):
        volume, truth, axis = volume_and_truth(folder / name)
        for structure in structures:
            for count in (4, 8, 12):
                table.row((name, structure, str(count)), *judged(volume, truth, axis, structure, count))


def judged(volume: Volume, truth: Labels, axis: str, structure: str, count: int) -> list[float]:
    spacing, draw = slice_spacing_mm(volume.grid, axis), np.random.default_rng(7)
    masks = np.moveaxis(truth.mask(structure), len(AXES) - 1 - AXES.index(axis), 0)
    filled = np.flatnonzero(masks.sum(axis=(1, 2)) > 150)
    indices = filled[np.linspace(2, len(filled) - 3, 9).astype(int)]
    found = []
    before = LiveWire(slice_of(volume.intensity, axis, indices[0]), spacing)
    for teacher, index in pairwise(indices):
        learned = learned_costs([(before.elements, masks[teacher])])
        wire = before = LiveWire(slice_of(volume.intensity, axis, index), spacing)
        for true in true_outlines(masks[index]):
            found.append(measured(wire, learned, true, hand_set(true, count, draw), spacing, masks.shape[1:]))
    means = np.mean(found, axis=0)
    return [*means, np.percentile(np.array(found)[:, 2], 95)]


def measured(
    wire: LiveWire, learned: LearnedCosts | None, true: Floats, anchors: Floats, spacing: tuple[float, float],
    shape: tuple[int, int],
) -> tuple[float, float, float, float]:  # fmt: skip
    wire.learn(None)
    plain = distance_mm(wire.closed(anchors).outline, true, spacing)
    wire.learn(learned)
    trained = distance_mm(wire.closed(anchors).outline, true, spacing)
    contour = drawn(wire, anchors, structure="femur", axis="k", index=0)
    whole = outlined_mask([Contour(structure="femur", axis="k", index=0, anchors=anchors, outline=true)], shape)
    overlap = dice(outlined_mask([contour], shape), whole)
    return plain, trained, distance_mm(contour.outline, true, spacing), overlap


def between(run: Run) -> None:
    """Every fourth, sixth or eighth true slice of a bone given, the others interpolated; and linearly, as the paper."""
    folder = run.shared / "data" / "knee"
    table = run.table(
        "Slices interpolated, phantom_a",
        ("bone", "every n-th slice given"),
        Column("Dice", "", 3),
        Column("linearly, Dice", "", 3),
    )
    volume, truth, axis = volume_and_truth(folder / "phantom_a")
    along = len(AXES) - 1 - AXES.index(axis)
    for bone in BONES:
        masks = np.moveaxis(truth.mask(bone), along, 0)
        filled = np.flatnonzero(masks.any(axis=(1, 2)))
        for every in (4, 6, 8):
            given = list(dict.fromkeys([*range(filled[0], filled[-1], every), filled[-1]]))
            contours = [
                Contour(structure=bone, axis=axis, index=index, anchors=line[:2, ::-1] - 1, outline=line[:-1, ::-1] - 1)
                for index in given
                for line in find_contours(np.pad(masks[index], 1).astype(float), 0.5)
            ]
            cubic = np.moveaxis(structure_distance(contours, volume.grid, bone) > 0, along, 0)
            apart = [signed_distance(masks[index], slice_spacing_mm(volume.grid, axis)) for index in given]
            straight = interp1d(given, np.maximum(apart, -1e3), axis=0)(np.arange(filled[0], filled[-1] + 1)) > 0
            scores = dice(cubic, masks), dice(straight, masks[filled[0] : filled[-1] + 1])
            table.row((bone, str(every)), *scores)


def template(run: Run) -> None:
    """The bones of phantom_a outlined in every sixth slice, made a template, and phantom_spl segmented by it."""
    folder = run.shared / "data" / "knee"
    table = run.table(
        "Templates outlined with the wire, Dice", ("volume", "by"), *(Column(bone, "", 3) for bone in BONES)
    )
    volume, truth, axis = volume_and_truth(folder / "phantom_a")
    started = time.perf_counter()
    contours = [contour for bone in BONES for contour in outlined(volume, truth, axis, bone)]
    own = checked_template(labels_of_contours(contours, volume.grid))
    slices = len({(contour.structure, contour.index) for contour in contours})
    anchors = sum(len(contour.anchors) for contour in contours)
    table.note = (
        f"{len(contours)} outlines in {slices} slices with {anchors} anchors, {time.perf_counter() - started:.0f} s. "
        f"The program reports: {' '.join([str(own.side), *own.faults, *own.notes])}"
    )
    table.row(
        ("phantom_a", "the outlines themselves"), *(dice(own.labels.mask(bone), truth.mask(bone)) for bone in BONES)
    )
    for name in ("phantom_spl",):
        image, wanted, _ = volume_and_truth(folder / name)
        for label, by in (("own outlines", own.labels), ("template_a", read_template(folder / "template_a"))):
            found = segment_bones([image], template=by)
            table.row((name, label), *(dice(found.labels.mask(bone), wanted.mask(bone)) for bone in BONES))


def outlined(volume: Volume, truth: Labels, axis: str, bone: str) -> list[Contour]:
    """Outline a bone as a person would: slice by slice, each trained on the nearest three before."""
    draw, spacing = np.random.default_rng(LABELS[bone]), slice_spacing_mm(volume.grid, axis)
    masks = np.moveaxis(truth.mask(bone), len(AXES) - 1 - AXES.index(axis), 0)
    filled = np.flatnonzero([bool(true_outlines(mask)) for mask in masks])
    contours: list[Contour] = []
    wires: dict[int, LiveWire] = {}
    for index in dict.fromkeys([*range(filled[0], filled[-1], EVERY), filled[-1]]):
        wire = wires[int(index)] = LiveWire(slice_of(volume.intensity, axis, index), spacing)
        near = list(wires)[-4:-1]
        shape = slice_shape(volume.grid, axis)
        lessons = [(wires[n].elements, outlined_mask([c for c in contours if c.index == n], shape)) for n in near]
        wire.learn(learned_costs(lessons))
        for true in true_outlines(masks[index]):
            count = max(4, round(len(true) / PIXELS_PER_ANCHOR))
            contours.append(drawn(wire, hand_set(true, count, draw), structure=bone, axis=axis, index=int(index)))
    return contours


PARTS = {"speed": speed, "outlines": outlines, "between": between, "template": template}


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_parts(parser, PARTS)


def run(run: Run) -> None:
    """Run the parts."""
    run_parts(run, PARTS)
