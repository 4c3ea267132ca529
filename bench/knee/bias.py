"""How even marrow is without the coil's bias, beside N4 of SimpleITK.

For each simulated volume: the spread of the marrow (1.48 median absolute deviations over the median) of femur and
tibia 3 mm within their true labels, the image smoothed by 1.5 mm on cubes of 3 mm so that noise does not count. N4
runs on the same cubes, with the tissue that marey takes for its mask and its own settings.
"""

import time

import numpy as np
from scipy import ndimage

from bench.declaration import Bench
from bench.recording import Column, Run
from marey.arrays import Mask
from marey.io.mr.volumes import read_volume, simple_itk
from marey.knee.space.bias_field import between_two_classes, bias_field
from marey.knee.space.resampling import on_grid, resampled, upright_grid
from marey.knee.space.structures import LABELS

BENCH = Bench(
    measures="Spread of the marrow's grey values with and without correction of the coil's bias.",
    sources=("src/marey/knee/space",),
    minutes=2,
)
NAMES = ("phantom_a", "phantom_spl", "phantom_spl_t1")
CUBE_MM, SMOOTHING_MM, WITHIN_MM = 3.0, 1.5, 3.0
TISSUE = 0.25
"""Of the level between air and tissue: what is brighter is in the mask, as in `bias_field`."""


def spread(values: np.ndarray, marrow: Mask) -> float:
    inside = values[marrow]
    middle = np.median(inside)
    return float(1.4826 * np.median(np.abs(inside - middle)) / middle)


def by_n4(values: np.ndarray) -> np.ndarray:
    sitk = simple_itk()
    image = sitk.GetImageFromArray(values.astype(np.float32))
    image.SetSpacing([CUBE_MM] * 3)
    sitk.ProcessObject.SetGlobalDefaultNumberOfThreads(1)
    tissue = sitk.GetImageFromArray((values > TISSUE * between_two_classes(values.ravel())).astype(np.uint8))
    tissue.CopyInformation(image)
    done = sitk.N4BiasFieldCorrectionImageFilter().Execute(image, tissue)
    return np.asarray(sitk.GetArrayFromImage(done))


def run(run: Run) -> None:
    """Correct, and measure the spread."""
    table = run.table(
        "Spread of the marrow", "volume", Column("uncorrected", "", 3), Column("marey", "", 3), Column("N4", "", 3),
        Column("marey", "s", 1), Column("N4", "s", 1),
    )  # fmt: skip
    for name in NAMES:
        folder = run.shared / "data" / "knee" / name
        volume = read_volume(folder / "image.nii.gz")
        labels = read_volume(folder / "truth_labels.nii.gz").intensity
        cubes = upright_grid(volume.grid, CUBE_MM)
        values = on_grid(volume, cubes, SMOOTHING_MM)
        marrow = np.zeros(cubes.shape, dtype=bool)
        for bone in ("femur", "tibia"):
            there = resampled((labels == LABELS[bone]).astype(np.float32), volume.grid, cubes) > 0.5
            marrow |= ndimage.distance_transform_edt(there) * CUBE_MM > WITHIN_MM
        began = time.process_time()
        ours = values / bias_field(volume).on(cubes)
        middle = time.process_time()
        theirs = by_n4(values)
        ended = time.process_time()
        spreads = (spread(each, marrow) for each in (values, ours, theirs))
        table.row(name, *spreads, middle - began, ended - middle)
