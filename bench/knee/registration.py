"""Registration of bones made from label maps: back from where they were moved, and one person's bent into another's.

`rigid`: a bone on a coarser mesh, its shaft cut 15 mm shorter, is moved by 30 degrees about an axis through its
middle and by 30 mm, both in random directions: median and worst errors of what `register_rigidly` finds. `noise`: the
same from up to 30 degrees and 30 mm, both shafts cut by other, oblique planes, and with errors of 0.3 mm as two
outlines of one bone have them, smooth over 2 to 8 mm; and the share of the six numbers within 1.96 stated standard
deviations. `sides`: every pair of people, the template unchanged and mirrored. `elastic`: every pair of people, bent
there and, from the same rigid motion, back: mean distance of the surfaces before and after bending, 95 %, the least
determinant of the Jacobian, the error of the inverse, and how far off a point comes back by the two. `known`: a bone
bent by a known smooth field. `normals`: the angle between the normals of the template's covered bone, carried along,
and the subject's own. `peer`: SimpleITK's demons and B-splines (12 mm from node to node) on the same distances.
`thickness`: of given cartilage, beside the closest-point distance.
"""

import argparse
import resource
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import trimesh

from bench.common.parts import add_parts, run_parts
from bench.declaration import Bench
from bench.recording import Column, Run, Table
from marey.arrays import Floats
from marey.geometry import rotations
from marey.geometry.rigid import RigidTransform
from marey.io.mr.meshes import read_mesh
from marey.io.mr.volumes import read_labels, simple_itk
from marey.io.npz import write_arrays
from marey.knee.cartilage.thickness import cartilage_thickness
from marey.knee.registration.deformation import Deformation
from marey.knee.registration.elastic import ElasticSettings, _images, register_elastically, surface_distances
from marey.knee.registration.rigid import RigidRegistration, register_rigidly
from marey.knee.registration.sided import register_on_either_side
from marey.knee.space.cut_ends import cut_planes
from marey.knee.space.mesh_repair import with_holes_closed
from marey.knee.space.sides import mirrored
from marey.knee.space.structures import CARTILAGE_OF_BONE
from marey.knee.space.surface import TriangleSurface
from marey.knee.space.surfacing import surface_of_labels
from marey.knee.space.triangle_tree import TriangleTree, corner_weights
from marey.knee.space.volume import Labels, VoxelGrid
from marey.pipelines.knee.meshes import SMALL_HOLE

BENCH = Bench(
    measures=(
        "Rigid and elastic registration of bones, and thickness of given cartilage, against known motions and meshes."
    ),
    sources=("src/marey/knee/registration", "src/marey/knee/space", "src/marey/knee/cartilage/thickness.py"),
    minutes=30,
)
SHORTER_MM = 15.0
FIELDS = 2
"""Known fields by which each bone is bent."""
PEOPLE = {"femur": ("atlas", "template_a", "dess", "thickness"), "tibia": ("atlas", "template_a", "dess", "thickness"),
          "patella": ("atlas", "template_a", "dess")}  # fmt: skip
LEFT = ("atlas",)


class Rows:
    """A table that is begun by the names of its first row; a name ends with its unit."""

    def __init__(self, run: Run, title: str, *labels: str):
        self.run, self.title, self.labels = run, title, labels
        self.table: Table | None = None
        self.names: list[str] = []

    def add(self, **values: float | str | bool | None) -> None:
        """Append a row."""
        if self.table is None:
            self.names = [name for name in values if name not in self.labels]
            self.table = self.run.table(self.title, self.labels, *map(column, self.names))
        numbers = (
            ("yes" if value else "no") if isinstance(value, (bool, np.bool_)) else value
            for value in map(values.get, self.names)
        )
        self.table.row([str(values[label]) for label in self.labels], *numbers)


def column(name: str) -> Column:
    """A column by a name such as `median_deg`."""
    words, _, unit = name.rpartition("_")
    digits = {"mm": 3, "deg": 3, "seconds": 1, "gigabytes": 1, "draws": None, "vertices": None, "found": 3}
    if unit in ("mm", "deg"):
        return Column(words.replace("_", " "), unit, digits[unit])
    units = {"seconds": "s", "gigabytes": "GB"}
    return Column(name.replace("_", " "), units.get(name, ""), digits.get(name, 3))


def labels_of(shared: Path, name: str) -> Labels:
    folder = shared / "data" / "knee" / name
    return read_labels(folder / "reference_labels.nii.gz" if name == "dess" else folder)


def surface_of(shared: Path, name: str, bone: str) -> TriangleSurface:
    if name == "thickness":
        return read_mesh(shared / "data" / "knee" / "thickness" / f"{bone}.npz")
    return surface_of_labels(labels_of(shared, name), bone)


def shortened(labels: Labels, bone: str) -> Labels:
    """The same without the last of the shaft."""
    filled = np.argwhere(labels.mask(bone))
    heights = labels.grid.lps(filled[:, ::-1].astype(float))[:, 2]
    keep = heights < heights.max() - SHORTER_MM if bone == "femur" else heights > heights.min() + SHORTER_MM
    cut = np.zeros_like(labels.labels)
    spots = tuple(filled[keep].T)
    cut[spots] = labels.labels[spots]
    return Labels(labels=cut, grid=VoxelGrid(shape=labels.grid.shape, lps_from_voxel=labels.grid.lps_from_voxel))


def bones() -> list[tuple[str, str]]:
    return [(name, bone) for bone, names in PEOPLE.items() for name in names]


def coarse_and_short(shared: Path, name: str, bone: str) -> TriangleSurface:
    if name == "thickness":
        return shorn(surface_of(shared, name, bone), bone, SHORTER_MM, np.zeros(2))
    labels = labels_of(shared, name)
    return surface_of_labels(labels if bone == "patella" else shortened(labels, bone), bone, edge_mm=1.5)


def shorn(surface: TriangleSurface, bone: str, mm: float, lean: Floats) -> TriangleSurface:
    """Press the end of a shaft flat, mm below its top, by a plane that leans."""
    if bone == "patella":
        return surface
    normal = rotations.exp(np.array([*lean, 0.0])) @ [0, 0, 1.0 if bone == "femur" else -1.0]
    height = surface.vertices_mm @ normal
    over = np.maximum(height - height.max() + mm, 0)
    return TriangleSurface(vertices_mm=surface.vertices_mm - over[:, None] * normal, faces=surface.faces)


def rough(surface: TriangleSurface, rng: np.random.Generator, length_mm: float, sd_mm: float) -> TriangleSurface:
    """Move a surface along its normals by what is smooth over a length."""
    waves, phases = rng.normal(0, 1 / length_mm, (200, 3)), rng.uniform(0, 2 * np.pi, 200)
    bumps = sd_mm * np.sqrt(2 / 200) * np.cos(surface.vertices_mm @ waves.T + phases).sum(1)
    return TriangleSurface(
        vertices_mm=surface.vertices_mm + bumps[:, None] * surface.vertex_normals, faces=surface.faces
    )


def motion(rng: np.random.Generator, middle: Floats, degrees: float, mm: float) -> RigidTransform:
    axis, shift = rng.normal(size=(2, 3))
    turn = rotations.exp(np.radians(degrees) * axis / np.linalg.norm(axis))
    return RigidTransform(turn, middle - turn @ middle + mm * shift / np.linalg.norm(shift))


def moved(surface: TriangleSurface, by: RigidTransform) -> TriangleSurface:
    return TriangleSurface(vertices_mm=by.apply(surface.vertices_mm), faces=surface.faces)


Draw = Callable[
    [np.random.Generator, TriangleSurface, TriangleSurface, str], tuple[TriangleSurface, TriangleSurface, float, float]
]


def exact_draw(
    rng: np.random.Generator, template: TriangleSurface, subject: TriangleSurface, bone: str
) -> tuple[TriangleSurface, TriangleSurface, float, float]:
    return template, subject, 30.0, 30.0


def noisy_draw(
    rng: np.random.Generator, template: TriangleSurface, subject: TriangleSurface, bone: str
) -> tuple[TriangleSurface, TriangleSurface, float, float]:
    first, second = (rng.normal(0, np.radians(10), 2) for _ in range(2))
    template = shorn(template, bone, rng.uniform(0, 15), first)
    subject = shorn(rough(subject, rng, rng.uniform(2, 8), 0.3), bone, rng.uniform(0, 15), second)
    return template, subject, rng.uniform(0, 30), rng.uniform(0, 30)


def rigid(run: Run, draw: Draw = exact_draw, title: str = "Moved and found again") -> None:
    rows = Rows(run, title, "bone")
    shared, draws = run.shared, run.arguments.draws
    for name, bone in bones():
        rng = np.random.default_rng(1)
        whole, short = surface_of(shared, name, bone), coarse_and_short(shared, name, bone)
        errors, whitened, spent = [], [], []
        for _ in range(draws):
            template, subject, degrees, mm = draw(rng, whole, short, bone)
            middle = template.vertices_mm.mean(0)
            true = motion(rng, middle, degrees, mm)
            began = time.process_time()
            found = register_rigidly(template, moved(subject, true))
            spent.append(time.process_time() - began)
            left = found.subject_from_template @ true.inverse()
            off = found.subject_from_template.apply(middle) - true.apply(middle)
            errors.append((np.degrees(np.linalg.norm(left.rotation_vector)), np.linalg.norm(off)))
            whitened.append(np.r_[left.rotation_vector, off] / np.sqrt(np.diag(found.covariance)))
        turn, shift = np.array(errors).T
        rows.add(bone=f"{name} {bone}", draws=draws, median_deg=np.median(turn), worst_deg=turn.max(),
            median_mm=np.median(shift), worst_mm=shift.max(), within_95=(np.abs(whitened) < 1.96).mean(),
            off_by_sd=np.sqrt(np.mean(np.square(whitened))), seconds=np.median(spent))  # fmt: skip


def pairs() -> list[tuple[str, str, str]]:
    return [(bone, a, b) for bone, names in PEOPLE.items() for a in names for b in names if a != b]


def sides(run: Run) -> None:
    rows = Rows(run, "Sides", "pair")
    shared = run.shared
    for bone, first, second in pairs():
        found = register_on_either_side(surface_of(shared, first, bone), surface_of(shared, second, bone))
        true = (first in LEFT) != (second in LEFT)
        right, wrong = (found.other_side_mm, found.same_side_mm)[:: 1 if true else -1]
        rows.add(pair=f"{bone}: {first} to {second}", found=found.mirrored == true, stated_as_clear=found.clear,
            right_side_mm=right, wrong_side_mm=wrong)  # fmt: skip


def aligned(template: TriangleSurface, subject: TriangleSurface) -> tuple[TriangleSurface, RigidRegistration]:
    found = register_rigidly(template, subject)
    return moved(template, found.subject_from_template), found


def elastic(run: Run) -> None:
    rows = Rows(run, "Bent into another person's bone", "pair")
    shared = run.shared
    for bone, first, second in [pair for pair in pairs() if pair[1] < pair[2]]:
        template, subject = surface_of(shared, first, bone), surface_of(shared, second, bone)
        template = mirrored(template) if (first in LEFT) != (second in LEFT) else template
        began = time.process_time()
        start, _ = aligned(template, subject)
        before = surface_distances(start, subject, cut_planes(start), cut_planes(subject))
        bent = register_elastically(start, subject)
        spent = time.process_time() - began
        back = register_elastically(subject, start)
        there = bent.deformation.subject_points(start.vertices_mm)
        inverse = np.linalg.norm(bent.deformation.template_points(there) - start.vertices_mm, axis=1)
        again = np.linalg.norm(back.deformation.subject_points(there) - start.vertices_mm, axis=1)
        rows.add(pair=f"{bone}: {first} to {second}", rigid_mm=before.mean(), mean_mm=bent.surface_distance_mm,
            within_95_mm=bent.farthest_mm, least_determinant=bent.least_determinant, seconds=spent,
            back_mean_mm=back.surface_distance_mm, back_within_95_mm=back.farthest_mm,
            back_least_determinant=back.least_determinant, inverse_mm=inverse.max(),
            there_and_back_mm=np.median(again))  # fmt: skip


def known_field(
    surface: TriangleSurface, rng: np.random.Generator, mm: float, length_mm: float
) -> Callable[[Floats], Floats]:
    """Return a smooth motion of space: waves of some length, mm in each direction on the average."""
    waves, phases = rng.normal(0, 1 / length_mm, (3, 30, 3)), rng.uniform(0, 2 * np.pi, (3, 30))
    middle = surface.vertices_mm.mean(0)
    turn = rotations.exp(rng.normal(0, np.radians(5), 3))

    def carried(points: Floats) -> Floats:
        shift = [np.cos(points @ k.T + p).sum(1) for k, p in zip(waves, phases, strict=True)]
        return (points - middle) @ turn.T + middle + mm * np.sqrt(2 / 30) * np.stack(shift, 1)

    return carried


def known(run: Run) -> None:
    rows = Rows(run, "Bent by a known field", "bone", "waves_mm")
    shared = run.shared
    for name, bone in (("atlas", "femur"), ("template_a", "tibia"), ("dess", "patella")):
        template, other = surface_of(shared, name, bone), coarse_and_short(shared, name, bone)
        for length in (60.0, 30.0):
            errors = []
            for seed in range(FIELDS):
                field = known_field(template, np.random.default_rng(seed), 2.0, length)
                subject = TriangleSurface(vertices_mm=field(other.vertices_mm), faces=other.faces)
                start, _ = aligned(template, subject)
                bent = register_elastically(start, subject)
                true = field(template.vertices_mm)
                own = np.ones(len(true), bool)
                for cut in cut_planes(template):
                    own &= cut.depth_mm(template.vertices_mm) > (SHORTER_MM + 5 if bone != "patella" else 5)
                normals = TriangleSurface(vertices_mm=true, faces=template.faces).vertex_normals[own]
                off = (bent.registered.vertices_mm - true)[own]
                errors.append([np.linalg.norm((start.vertices_mm - true)[own], axis=1).mean(),
                             np.linalg.norm(off, axis=1).mean(), np.abs((off * normals).sum(1)).mean(),
                             bent.least_determinant])  # fmt: skip
            rigid_mm, bent_mm, across_mm, _ = np.mean(errors, 0)
            rows.add(bone=f"{name} {bone}", waves_mm=length, draws=len(errors), rigid_mm=rigid_mm, bent_mm=bent_mm,
                along_normal_mm=across_mm, least_determinant=min(error[3] for error in errors))  # fmt: skip


def normals(run: Run) -> None:
    rows = Rows(run, "Normals carried along", "bone")
    shared = run.shared
    for bone in PEOPLE:
        template, subject = mirrored(surface_of(shared, "atlas", bone)), surface_of(shared, "template_a", bone)
        cartilage = mirrored(surface_of(shared, "atlas", CARTILAGE_OF_BONE[bone]))
        covered = cartilage_thickness(template, [cartilage]) > 0
        bent = register_elastically(aligned(template, subject)[0], subject)
        near = TriangleTree.of(subject).nearest(bent.registered.vertices_mm)
        weights = corner_weights(subject.corners_mm[near.face], near.points_mm)
        own = np.einsum("nk,nki->ni", weights, subject.vertex_normals[subject.faces[near.face]])
        cosine = (bent.normals * own).sum(1) / np.linalg.norm(own, axis=1)
        off = np.degrees(np.arccos(np.clip(cosine, -1, 1)))[covered]
        rows.add(
            bone=f"{bone}: atlas to template_a", median_deg=np.median(off), tenth_more_than_deg=np.percentile(off, 90)
        )


def peer(run: Run) -> None:
    """Bend by other programs' methods what this one bends: signed distances of both bones."""
    rows = Rows(run, "Beside SimpleITK", "pair", "by")
    shared = run.shared
    sitk = simple_itk()
    sitk.ProcessObject.SetGlobalDefaultNumberOfThreads(1)
    for bone, first, second in (("femur", "thickness", "dess"), ("tibia", "template_a", "dess")):
        subject = surface_of(shared, second, bone)
        start, _ = aligned(surface_of(shared, first, bone), subject)
        settings, cuts = ElasticSettings(), (cut_planes(start), cut_planes(subject))
        began = time.process_time()
        bent = register_elastically(start, subject, settings)
        rows.add(pair=f"{bone}: {first} to {second}", by="marey", mean_mm=bent.surface_distance_mm,
            within_95_mm=bent.farthest_mm, least_determinant=bent.least_determinant,
            seconds=time.process_time() - began)  # fmt: skip
        pictures = _images(start, subject, cuts, settings)
        model, fixed = (picture_of(sitk, image, settings.bands_mm[0]) for image in pictures)
        for by, bend in (("SimpleITK demons", demons), ("SimpleITK B-spline", b_spline)):
            began = time.process_time()
            field = sitk.GetArrayFromImage(bend(sitk, fixed, model)).transpose(3, 2, 1, 0)
            spent = time.process_time() - began
            found = Deformation(origin_mm=pictures[0].origin_mm, step_mm=settings.image_mm, displacement_mm=-field)
            row = {"pair": f"{bone}: {first} to {second}", "by": by, "least_determinant": found.least_determinant}
            if found.least_determinant > 0:
                there = found.subject_surface(start)
                off = surface_distances(there, subject, cuts[0], cuts[1])
                row |= {"mean_mm": off.mean(), "within_95_mm": np.percentile(off, 95)}
            rows.add(**row, seconds=spent)


def picture_of(sitk, image, band):
    picture = sitk.GetImageFromArray(np.clip(image.distance_mm, -band, band).transpose(2, 1, 0))
    picture.SetOrigin(image.origin_mm.tolist())
    picture.SetSpacing([image.step_mm] * 3)
    return sitk.Cast(picture, sitk.sitkFloat32)


def demons(sitk, fixed, moving):
    method = sitk.FastSymmetricForcesDemonsRegistrationFilter()
    method.SetNumberOfIterations(200)
    method.SetStandardDeviations(1.5)
    return method.Execute(fixed, moving)


def b_spline(sitk, fixed, moving):
    size = [max(int(n * s / 12), 3) for n, s in zip(fixed.GetSize(), fixed.GetSpacing(), strict=True)]
    method = sitk.ImageRegistrationMethod()
    method.SetMetricAsMeanSquares()
    # All nodes would take a quarter of an hour.
    method.SetMetricSamplingStrategy(method.REGULAR)
    method.SetMetricSamplingPercentage(0.2, 1)
    method.SetInterpolator(sitk.sitkLinear)
    method.SetOptimizerAsLBFGSB(numberOfIterations=50)
    method.SetInitialTransform(sitk.BSplineTransformInitializer(fixed, size))
    method.SetShrinkFactorsPerLevel([2, 1])
    method.SetSmoothingSigmasPerLevel([2, 0])
    found = method.Execute(fixed, moving)
    return sitk.TransformToDisplacementField(
        found, sitk.sitkVectorFloat64, fixed.GetSize(), fixed.GetOrigin(), fixed.GetSpacing(), fixed.GetDirection()
    )


def thickness(run: Run) -> None:
    rows = Rows(run, "Thickness of given cartilage", "bone", "by")
    shared = run.shared
    folder = shared / "data" / "knee" / "thickness"
    parts = {"femur": ("femoral_cartilage",), "tibia": ("medial_tibial_cartilage", "lateral_tibial_cartilage")}
    for bone, cartilages in parts.items():
        surfaces = [read_mesh(folder / f"{name}.npz") for name in cartilages]
        surface = read_mesh(folder / f"{bone}.npz")
        true = true_of(folder / f"{bone}.npz")
        began = time.process_time()
        found = cartilage_thickness(surface, surfaces)
        spent = time.process_time() - began
        write_arrays(run.out / f"thickness_{bone}.npz", {"thickness_mm": found})
        for by, answer in (("marey", found), ("closest point", closest(surface, surfaces))):
            both = (true > 0.01) & (answer > 0.01)
            rows.add(
                bone=bone,
                by=by,
                map_mm=np.abs(answer - true)[both].mean(),
                found=both.sum() / (true > 0.01).sum(),
                false=((true <= 0.01) & (answer > 0.01)).sum() / (true <= 0.01).sum(),
                seconds=spent,
            )

    spoilt(
        run, read_mesh(folder / "femur.npz"), read_mesh(folder / "femoral_cartilage.npz"), true_of(folder / "femur.npz")
    )


def true_of(path: Path) -> Floats:
    return np.load(path)["thickness_mm"].ravel()


def spoilt(run: Run, bone: TriangleSurface, cartilage: TriangleSurface, true: Floats) -> None:
    """Measure with 1 % of the faces missing, and a bone of sixteen times the faces."""
    rows = Rows(run, "With 1 % of the faces missing", "bone", "by")
    keep = np.random.default_rng(0).random(len(cartilage.faces)) > 0.01
    holed = TriangleSurface(vertices_mm=cartilage.vertices_mm, faces=cartilage.faces[keep])
    for by, sheet in (("holes left", holed), ("holes closed", with_holes_closed(holed, SMALL_HOLE)[0])):
        answer = cartilage_thickness(bone, [sheet])
        rows.add(bone="femur", by=by, found=((true > 0.01) & (answer > 0.01)).sum() / (true > 0.01).sum())
    vertices, faces = trimesh.remesh.subdivide(*trimesh.remesh.subdivide(bone.vertices_mm, bone.faces))
    began = time.process_time()
    cartilage_thickness(TriangleSurface(vertices_mm=vertices, faces=faces), [cartilage])
    gigabytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    dense = Rows(run, "Duration with many vertices", "bone")
    dense.add(bone="femur", vertices=len(vertices), seconds=time.process_time() - began, gigabytes=gigabytes)


def closest(bone: TriangleSurface, cartilages: list[TriangleSurface]) -> Floats:
    """The distance from where the bone has cartilage to the nearest place of its outer sheet."""
    answer = np.zeros(len(bone.vertices_mm))
    tree = TriangleTree.of(bone)
    for cartilage in cartilages:
        near = tree.nearest(cartilage.corners_mm.mean(1))
        outer = (cartilage.face_normals * bone.face_normals[near.face]).sum(1) > 0
        inner, outside = (
            TriangleTree.of(TriangleSurface(vertices_mm=cartilage.vertices_mm, faces=cartilage.faces[part]))
            for part in (~outer, outer)
        )
        on = inner.nearest(bone.vertices_mm)
        far = outside.nearest(on.points_mm).distance_mm
        answer = np.maximum(answer, np.where(on.distance_mm < 1.0, far, 0.0))
    return answer


def noise(run: Run) -> None:
    """Register bones with errors of outlines."""
    rigid(run, noisy_draw, "Moved and found again, with errors of outlines")


PARTS = {
    "rigid": rigid,
    "noise": noise,
    "sides": sides,
    "elastic": elastic,
    "known": known,
    "normals": normals,
    "peer": peer,
    "thickness": thickness,
}


def arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    add_parts(parser, PARTS)
    parser.add_argument("--draws", type=int, default=3, help="random motions per bone")


def run(run: Run) -> None:
    """Run the parts."""
    run_parts(run, PARTS)
