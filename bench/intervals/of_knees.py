"""Knees: centres of gadolinium balls, registered bones, and cartilage thickness on true bones of simulated knees."""

from collections.abc import Iterator

import numpy as np
from tests.made_balls import limb_grid, limb_with_balls, on_skin

from bench.intervals.scoring import Sample, sample, single
from bench.knee.cartilage import CASES, surfaces_of, true_labels
from bench.knee.gadolinium import NEAR_MM, SPACINGS
from bench.knee.registration import bones, coarse_and_short, motion, moved, noisy_draw, surface_of
from bench.recording import Run
from marey.io.mr.volumes import read_labels, read_volume
from marey.knee.cartilage.knee_cartilage import find_knee_cartilage, knee_template
from marey.knee.cartilage.thickness import cartilage_thickness
from marey.knee.markers.gadolinium import find_gadolinium
from marey.knee.registration.rigid import register_rigidly
from marey.knee.space.structures import BONES, CARTILAGE_OF_BONE

LIMBS = 16
"""Made limbs, three to five balls each."""
RADII = (2.0, 3.0, 5.0, 7.0)
"""Radii of the balls [mm]."""
DRAWS = 1
"""Motions of each bone."""
KNEES = ("phantom_a", "phantom_spl")
"""Simulated knees whose cartilage is found."""
SURE = 0.5
"""Thickness with a smaller confidence is not compared, as in `knee/cartilage`."""


def samples(run: Run) -> Iterator[Sample]:
    """Find balls, bones and cartilage."""
    yield from balls()
    yield from registered(run)
    yield from cartilages(run)


def balls() -> Iterator[Sample]:
    """Find balls on made limbs, with fat that is dark, or nearly as bright."""
    rng = np.random.default_rng(29)
    for number in range(LIMBS):
        kind, radius = ("dark", "bright")[number % 2], float(rng.choice(RADII))
        grid = limb_grid(SPACINGS[rng.integers(len(SPACINGS))], turn=rng.uniform(0, 0.6))
        count = 5 if radius < 5 else 3
        angles = np.arange(count) * 2 * np.pi / count + rng.uniform(-0.2, 0.2, count)
        heights, sunk = rng.uniform(-1, 1, count) * (18 - radius), rng.uniform(0, 0.5, count)
        true = np.array([on_skin(*each) for each in zip(angles, heights, np.full(count, radius), sunk, strict=True)])
        noise, bias, blur = rng.uniform(1, 8), rng.uniform(0, 0.3), float(rng.choice([0, 0.3, 0.6]))
        volume = limb_with_balls(
            grid, true, np.full(count, radius), kind, noise=noise, bias=bias, blur_mm=blur, seed=number
        )
        found = find_gadolinium(volume)
        apart = np.linalg.norm(true[:, None] - found.centres_mm[None], axis=2)
        hits = [(n, int(row.argmin())) for n, row in enumerate(apart) if row.size and row.min() < NEAR_MM]
        if hits:
            own, theirs = (list(each) for each in zip(*hits, strict=True))
            error, sd = found.centres_mm[theirs] - true[own], found.centres_sd_mm[theirs]
            yield sample(f"centres of balls, {kind} fat", f"limb {number}", "mm", error, sd)


def registered(run: Run) -> Iterator[Sample]:
    """Register bones that were moved, cut otherwise and outlined anew."""
    for name, bone in bones():
        rng = np.random.default_rng(31)
        whole, short = surface_of(run.shared, name, bone), coarse_and_short(run.shared, name, bone)
        for number in range(DRAWS):
            template, subject, degrees, mm = noisy_draw(rng, whole, short, bone)
            middle = template.vertices_mm.mean(0)
            true = motion(rng, middle, degrees, mm)
            found = register_rigidly(template, moved(subject, true))
            left = found.subject_from_template @ true.inverse()
            turn, off = np.degrees(left.rotation_vector), found.subject_from_template.apply(middle) - true.apply(middle)
            case = f"{name} {bone} {number}"
            yield sample("rotations of registered bones", case, "deg", turn, found.turn_sd_deg)
            yield sample("positions of registered bones", case, "mm", off, found.translation_sd_mm)


def cartilages(run: Run) -> Iterator[Sample]:
    """Find cartilage on the true bones of simulated knees, by the template of another person."""
    knee = run.shared / "data" / "knee"
    for case in KNEES:
        names, template = CASES[case]
        fine = surfaces_of(true_labels(run.shared, names[0], "truth_labels_fine"))
        volumes = [read_volume(knee / name / "image.nii.gz") for name in names]
        model = knee_template(surfaces_of(read_labels(knee / template)), mirror=True)
        found = find_knee_cartilage(volumes, {bone: fine[bone] for bone in BONES}, model)
        for bone, sheet in found.sheets.items():
            cartilage = CARTILAGE_OF_BONE[bone]
            true = cartilage_thickness(fine[bone], [fine[cartilage]])
            sure = (true > 0.01) & (sheet.thickness_mm > 0.01) & (sheet.confidence > SURE)
            error, sd = (sheet.thickness_mm - true)[sure], sheet.thickness_sd_mm[sure]
            yield single(f"thickness of {cartilage.replace('_', ' ')}", case, "mm", error, sd)
