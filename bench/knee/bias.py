"""How even marrow is without the coil's bias, beside N4 of SimpleITK: `python bench/knee_bias.py SHARED`.

Printed for each simulated volume: the spread of the marrow (1.48 median absolute deviations over the median) of femur
and tibia 3 mm within their true labels, the image smoothed by 1.5 mm on cubes of 3 mm so that noise does not count, and
seconds of process time. N4 runs on the same cubes, with the tissue that marey takes for its mask and its own settings.
"""

import argparse
import time
from pathlib import Path

import numpy as np
from scipy import ndimage
from threadpoolctl import threadpool_limits

from marey.arrays import Mask
from marey.io.mr.volumes import read_volume, simple_itk
from marey.knee.space.bias_field import between_two_classes, bias_field
from marey.knee.space.resampling import on_grid, resampled, upright_grid
from marey.knee.space.structures import LABELS

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


def measure(folder: Path) -> None:
    volume = read_volume(folder / "image.nii.gz")
    labels = read_volume(folder / "truth_labels.nii.gz").intensity
    cubes = upright_grid(volume.grid, CUBE_MM)
    values = on_grid(volume, cubes, SMOOTHING_MM)
    marrow = np.zeros(cubes.shape, dtype=bool)
    for bone in ("femur", "tibia"):
        there = resampled((labels == LABELS[bone]).astype(np.float32), volume.grid, cubes) > 0.5
        marrow |= ndimage.distance_transform_edt(there) * CUBE_MM > WITHIN_MM
    print(f"{folder.name}, as it is: {spread(values, marrow):.3f}")
    for name, corrected in (("marey", values / timed(bias_field, volume).on(cubes)), ("N4", timed(by_n4, values))):
        print(f"{folder.name}, {name}: {spread(corrected, marrow):.3f}", flush=True)


def timed(work, given):
    """Do it and say how long it took."""
    started = time.process_time()
    done = work(given)
    print(f"{work.__name__}: {time.process_time() - started:.1f} s")
    return done


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("shared", type=Path)
    shared = parser.parse_args().shared
    with threadpool_limits(1):
        for name in NAMES:
            measure(shared / "data" / "knee" / name)


if __name__ == "__main__":
    main()
