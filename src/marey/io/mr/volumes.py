"""Reading and writing of MR volumes and label volumes: DICOM series, NIfTI, NRRD and MetaImage."""

import gzip
import json
import locale
import os
import sys
import zlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from marey.arrays import Floats
from marey.errors import FileProblem
from marey.extras import missing_package
from marey.io.atomic import replacing, require_complete
from marey.io.documents import read_json_table
from marey.io.mr.dicom_structure import require_dicom_structure
from marey.io.mr.image_sizes import non_finite_values, require_header, require_possible_size
from marey.knee.space.structures import LABELS, structure_named
from marey.knee.space.volume import Labels, Volume, VoxelGrid

_SWIG_TABLES: list[ModuleType] = []
"""SWIG type tables that SimpleITK still uses; kept here so that they are not freed."""

FORMATS = (".nii", ".nii.gz", ".nrrd", ".nhdr", ".mha", ".mhd", ".dcm")
"""File name extensions of the formats that are read."""
_NAME_FILES = ("labels.json", "names.json")
"""Files that name the values of a label volume, besides one of the volume's own name."""
_SPACING_TOLERANCE = 0.05
"""Largest difference of a slice distance from the median, as a fraction of it; a missing slice differs by 1.

Chosen by hand."""
_FEWEST_VOXELS = 4
"""Smallest number of voxels along each axis of a volume; chosen by hand."""
_MOST_UNNAMED = 200
"""Largest number of unnamed values in a label volume; a volume with more is treated as an image. Chosen by hand."""
_LONGEST_LINE = 1000
"""Largest length of a line in the header of an NRRD [bytes]. Lines of 3,000 end the program, those of programs that
write images have at most some hundred."""
_AGAIN = "Copy or export the series again."
"""Remedy for a series that SimpleITK cannot read."""
_NEGATIVE_FRACTION = 0.05
"""An image whose 1st percentile is below this negative fraction of its 99th is not accepted as MR.

The margin allows for negative air values after resampling. Chosen by hand."""


def read_volume(path: Path | str) -> Volume:
    """Read an MR image.

    Args:
        path: A file of `FORMATS`, or a folder with one DICOM series.

    Raises:
        FileProblem: It is missing or has an unknown format, colours, four dimensions or a modality other than MR, or is
            constant or far below zero, or its slices are unevenly spaced.
        MareyError: SimpleITK is not installed.

    Example:
        >>> import marey
        >>> volume = marey.read_volume("knee.nii.gz")
        >>> volume.intensity.shape
        (60, 55, 55)
    """
    path = Path(path)
    image = _read_series(path) if path.is_dir() else _read_file(path)
    intensity = simple_itk().GetArrayFromImage(image).astype(np.float32)
    if lost := max(int((~np.isfinite(intensity)).sum()), _non_finite_in_nifti(path)):
        wrong = f"has {lost} of {intensity.size} voxels whose values are not finite (NaN or infinite)"
        raise FileProblem(path, wrong, "Replace them, for example by 0.")
    if not np.ptp(intensity):
        raise FileProblem(
            path, f"has the same value {intensity.flat[0]:g} in all voxels", "Check that it is the MR image itself."
        )
    low, high = np.percentile(intensity, [1, 99])
    if low < -_NEGATIVE_FRACTION * abs(high):
        raise FileProblem(path, f"has values down to {intensity.min():g}, as in CT", "Give an MR image.")
    return Volume(intensity=intensity, grid=_grid(image))


def _non_finite_in_nifti(path: Path) -> int:
    """Count the values of a NIfTI file that are not finite; 0 for other files."""
    return non_finite_values(path) if path.is_file() and path.name.lower().endswith((".nii", ".nii.gz")) else 0


def read_labels(path: Path | str) -> Labels:
    """Read a label volume with the names of its values; the medial and lateral parts of a structure are merged.

    Args:
        path: A file with `<its name>.json`, `labels.json` or `names.json` beside it, or a folder in which such a file
            is named `labels.nii.gz`: a template, or the results of `marey knee segment`.

    Raises:
        FileProblem: The volume or the names are missing or damaged, or none of the names is a structure of the knee.
    """
    path = Path(path)
    path = path / "labels.nii.gz" if path.is_dir() else path
    image = _read_file(path)
    values = simple_itk().GetArrayFromImage(image)
    number_of = _numbers_by_value(_names_beside(path))
    if (other := len(set(np.unique(values).tolist()) - {0, *number_of})) > _MOST_UNNAMED:
        raise FileProblem(
            path, f"has {other} values without a name: it seems to be an image", "Give a volume of integer labels."
        )
    labels = np.zeros(values.shape, dtype=np.uint8)
    for value, number in number_of.items():
        labels[values == value] = number
    if not labels.any():
        raise FileProblem(path, "has no voxel of a bone or cartilage", f"Known structures: {', '.join(LABELS)}.")
    return Labels(labels=labels, grid=_grid(image))


def read_template(folder: Path | str) -> Labels:
    """Read a template: a folder with `labels.nii.gz` and the names of its values in `names.json` or `labels.json`.

    Raises:
        FileProblem: As for `read_labels`, or the path is not a folder.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise FileProblem(folder, "is not a folder", "A template is a folder with labels.nii.gz and names.json.")
    return read_labels(folder)


def write_labels(folder: Path | str, labels: Labels, *, missing: Mapping[str, str] | None = None) -> None:
    """Write `labels.nii.gz` and, with the names of its values, `labels.json`.

    Args:
        folder: Output folder, created where missing.
        labels: On the image's own grid.
        missing: Requested structures that are not among the labels, with the reason; written as `missing`.
    """
    image = _image(labels.labels, labels.grid)
    folder = Path(folder)
    # SimpleITK needs the extension .nii.gz, of which `replacing` keeps the last part only.
    with replacing(folder / "labels.nii.gz") as beside:
        whole = beside.with_name(f"{beside.name}.nii.gz")
        try:
            try:
                simple_itk().WriteImage(image, str(whole), useCompression=True)
            except RuntimeError:
                require_complete(folder, complete=False)
            require_complete(whole, complete=_is_whole_gzip(whole))
            whole.replace(beside)
        finally:
            whole.unlink(missing_ok=True)
    names: dict[str, Mapping[str, str]] = {
        "labels": {"0": "background"} | {str(number): name for name, number in LABELS.items()}
    }
    if missing:
        names["missing"] = dict(missing)
    with replacing(folder / "labels.json") as beside:
        beside.write_text(json.dumps(names, indent=1) + "\n", encoding="utf-8")


def _is_whole_gzip(path: Path) -> bool:
    """Return whether a compressed file ends with its checksum; SimpleITK does not report a full disk."""
    try:
        with gzip.open(path) as file:
            while file.read(1 << 20):
                pass
    except (OSError, EOFError, zlib.error):
        return False
    return path.stat().st_size > 0


def write_volume(path: Path | str, volume: Volume) -> None:
    """Write an image in the format given by the file name extension."""
    with _quiet():
        simple_itk().WriteImage(_image(volume.intensity, volume.grid), str(path))


@cache
def simple_itk() -> Any:
    """Import SimpleITK so that C3D files can still be written.

    ezc3d and SimpleITK register their types in the same SWIG table and confuse each other's vectors of strings, which
    crashes ezc3d. The table of ezc3d is therefore hidden while SimpleITK creates its own.

    Raises:
        MareyError: SimpleITK is not installed.
    """
    import ezc3d  # noqa: F401

    tables = _tables()
    for name in tables:
        del sys.modules[name]
    try:
        import SimpleITK
    except ModuleNotFoundError as error:
        raise missing_package("SimpleITK", extra="knee", purpose="MR volumes") from error
    finally:
        _SWIG_TABLES.extend(_tables().values())
        sys.modules.update(tables)
    return SimpleITK


def _tables() -> dict[str, ModuleType]:
    return {name: module for name, module in sys.modules.items() if name.startswith("swig_runtime_data")}


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress the warnings of ITK, and what its libraries write to the terminal: causes are reported here in one line.

    The DICOM reader leaves the process in the C locale, which is not UTF-8: the former locale is restored.
    """
    process = simple_itk().ProcessObject
    shown, former = process.GetGlobalWarningDisplay(), locale.setlocale(locale.LC_ALL)
    process.SetGlobalWarningDisplay(False)
    terminal, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 2)
    try:
        yield
    finally:
        os.dup2(terminal, 2)
        os.close(terminal)
        os.close(nowhere)
        process.SetGlobalWarningDisplay(shown)
        locale.setlocale(locale.LC_ALL, former)


def _grid(image: Any) -> VoxelGrid:
    lps_from_voxel = np.eye(4)
    lps_from_voxel[:3, :3] = np.reshape(image.GetDirection(), (3, 3)) * image.GetSpacing()
    lps_from_voxel[:3, 3] = image.GetOrigin()
    i, j, k = image.GetSize()
    return VoxelGrid(shape=(k, j, i), lps_from_voxel=lps_from_voxel)


def _image(array: np.ndarray, grid: VoxelGrid) -> Any:
    image = simple_itk().GetImageFromArray(array)
    image.SetSpacing(grid.spacing_mm.tolist())
    image.SetDirection((grid.lps_from_voxel[:3, :3] / grid.spacing_mm).ravel().tolist())
    image.SetOrigin(grid.lps_from_voxel[:3, 3].tolist())
    return image


def _read_file(path: Path) -> Any:
    if not path.exists():
        raise FileProblem(path, "does not exist", "Check its name.")
    if not path.name.lower().endswith(FORMATS):
        remedy = f"The known formats are {', '.join(FORMATS)} and folders of DICOM slices."
        raise FileProblem(path, "has an unknown format", remedy)
    if not path.stat().st_size:
        raise FileProblem(path, "is empty", "Copy it again.")
    if path.suffix.lower() in (".nrrd", ".nhdr"):
        _require_short_lines(path)
    require_header(path)
    if path.suffix.lower() == ".dcm":
        require_dicom_structure(path)
    return _checked(path, _read_image(path))


def _read_image(path: Path) -> Any:
    """Read an image whose header states a size that its file can have."""
    with _quiet():
        try:
            reader = simple_itk().ImageFileReader()
            reader.SetFileName(str(path))
            reader.ReadImageInformation()
            require_possible_size(path, reader)
            return reader.Execute()
        except RuntimeError as error:
            if "Unable to determine ImageIO" in str(error):
                raise FileProblem(
                    path, "does not have the format of its file name extension", "Copy or write it again."
                ) from error
            raise FileProblem(path, f"cannot be read ({_last_line(error)})", "Copy or write it again.") from error


def _require_short_lines(path: Path) -> None:
    """Refuse an NRRD whose header has lines of impossible length, for which ITK ends the program."""
    with path.open("rb") as file:
        for line in iter(lambda: file.readline(_LONGEST_LINE + 1), b""):
            if not line.strip():
                return
            if len(line) > _LONGEST_LINE:
                wrong = f"has a line of more than {_LONGEST_LINE} characters in its header"
                raise FileProblem(path, wrong, "Copy or export it again.")


def _last_line(error: Exception) -> str:
    return str(error).strip().splitlines()[-1].removeprefix("ITK ERROR: ").rstrip(". ")


def _checked(path: Path, image: Any) -> Any:
    """Return the image if it is a three-dimensional scalar volume, else raise an error."""
    if image.GetDimension() == 4 and image.GetSize()[3] == 1:
        image = image[:, :, :, 0]
    if image.GetDimension() != 3:
        raise FileProblem(path, f"has {image.GetDimension()} dimensions", "Give one volume of three dimensions.")
    if image.GetNumberOfComponentsPerPixel() != 1:
        raise FileProblem(path, "has colours or several values per voxel", "Give the scalar volume.")
    if image.HasMetaDataKey("0008|0060"):
        _check_modality(path, image.GetMetaData("0008|0060"))
    size = image.GetSize()
    if size[2] == 1 and path.suffix.lower() == ".dcm":
        raise FileProblem(path, "is a single slice", "Give the folder with the whole series.")
    if min(size) < _FEWEST_VOXELS:
        raise FileProblem(path, f"has only {' x '.join(map(str, size))} voxels", "Give the whole volume.")
    return image


def _check_modality(path: Path, modality: str) -> None:
    if modality.strip() not in ("", "MR"):
        raise FileProblem(path, f"has the modality {modality.strip()}", "Give an MR image.")


@dataclass(frozen=True, eq=False, kw_only=True)
class _Slice:
    file: str
    size: tuple[int, ...]
    """Columns and rows."""
    orientation: Floats
    """(6,) unit vectors along the rows, then along the columns."""
    position: Floats
    """(3,) centre of the first pixel [mm]."""

    @property
    def normal(self) -> Floats:
        return np.cross(self.orientation[:3], self.orientation[3:])


def _read_series(folder: Path) -> Any:
    itk = simple_itk()
    for path in sorted(folder.iterdir()):
        if path.is_file():
            require_dicom_structure(path)
    series = _series_in(folder)
    if not series:
        raise FileProblem(folder, "has no DICOM series", f"Give a folder of slices, or a file: {', '.join(FORMATS)}.")
    if len(series) > 1:
        raise FileProblem(
            folder, f"has {len(series)} DICOM series: {_described_series(folder, series)}",
            "Put each series into its own folder.",
        )  # fmt: skip
    with _quiet():
        files = itk.ImageSeriesReader.GetGDCMSeriesFileNames(str(folder), series[0])
        if len(files) == 1:
            image = _read_image(Path(files[0]))
            if image.GetDepth() <= 1:
                raise FileProblem(folder, "has a single DICOM slice", "Give the folder with the whole series.")
            return _checked(folder, image)
        slices = _in_order(folder, _of_one_size(folder, [_slice(folder, file) for file in files]))
        reader = itk.ImageSeriesReader()
        reader.SetFileNames([each.file for each in slices])
        try:
            image = reader.Execute()
        except RuntimeError as error:
            raise FileProblem(
                folder, f"cannot be read as a series ({_last_line(error)})", _AGAIN
            ) from error
    return _checked(folder, image)


def _series_in(folder: Path) -> Sequence[str]:
    """Return the identifiers of the DICOM series in a folder."""
    itk = simple_itk()
    with _quiet():
        try:
            return tuple(itk.ImageSeriesReader.GetGDCMSeriesIDs(str(folder)))
        except RuntimeError as error:
            reader = itk.ImageFileReader()
            for path in sorted(path for path in folder.iterdir() if path.is_file()):
                reader.SetFileName(str(path))
                try:
                    reader.ReadImageInformation()
                except RuntimeError as own:
                    raise FileProblem(
                        path, f"cannot be read as a slice of a series ({_last_line(own)})", _AGAIN
                    ) from own
            raise FileProblem(folder, f"cannot be read as a series ({_last_line(error)})", _AGAIN) from error


def _slice(folder: Path, file: str) -> _Slice:
    reader = simple_itk().ImageFileReader()
    reader.SetFileName(file)
    try:
        reader.ReadImageInformation()
        values = [float(value) for key in ("0020|0037", "0020|0032") for value in reader.GetMetaData(key).split("\\")]
    except (RuntimeError, ValueError) as error:
        raise FileProblem(
            Path(file), "has no position or orientation of its slice", "Export the series again."
        ) from error
    require_possible_size(Path(file), reader)
    if reader.HasMetaDataKey("0008|0060"):
        _check_modality(folder, reader.GetMetaData("0008|0060"))
    return _Slice(
        file=file, size=tuple(reader.GetSize()[:2]), orientation=np.array(values[:6]), position=np.array(values[6:9])
    )


def _described_series(folder: Path, series: Sequence[str]) -> str:
    """Return the description, number of files and first file of each series as text."""
    reader, described = simple_itk().ImageFileReader(), []
    for each in series:
        with _quiet():
            files = simple_itk().ImageSeriesReader.GetGDCMSeriesFileNames(str(folder), each)
            reader.SetFileName(files[0])
            reader.ReadImageInformation()
            name = reader.GetMetaData("0008|103e").strip() if reader.HasMetaDataKey("0008|103e") else ""
        described.append(f"{name or 'without a name'} ({len(files)} files, {Path(files[0]).name} the first)")
    return "; ".join(described)


def _of_one_size(folder: Path, slices: list[_Slice]) -> list[_Slice]:
    """Return the slices if all have the same size, else raise an error."""
    usual = Counter(each.size for each in slices).most_common(1)[0][0]
    others = [each for each in slices if each.size != usual]
    if others:
        sizes = [" x ".join(map(str, size)) for size in (others[0].size, usual)]
        raise FileProblem(
            folder, f"has slices of several sizes: {Path(others[0].file).name} of {sizes[0]}, most of {sizes[1]}",
            "Put each stack into its own folder.",
        )  # fmt: skip
    return slices


def _unreadable_file(folder: Path, slices: list[_Slice]) -> str:
    """Return a sentence on a file with the extension of the slices that is not one of them, if there is one."""
    read = {Path(each.file).name for each in slices}
    ending = Path(slices[0].file).suffix
    left = sorted(file.name for file in folder.iterdir() if file.suffix == ending and file.name not in read)
    return f" {left[0]} there cannot be read." if left and ending else ""


def _in_order(folder: Path, slices: list[_Slice]) -> list[_Slice]:
    """Sort the slices along their normal, and check that they are evenly spaced."""
    first = slices[0]
    if max(float(np.abs(each.orientation - first.orientation).max()) for each in slices) > 1e-3:
        raise FileProblem(folder, "has slices of several orientations", "Put each stack into its own folder.")
    places = np.array([each.position @ first.normal for each in slices])
    order = np.argsort(places, kind="stable")
    gaps = np.diff(places[order])
    usual = float(np.median(gaps))
    if usual <= 0 or float(gaps.min()) < _SPACING_TOLERANCE * usual:
        same = int(np.argmin(gaps)) if usual > 0 else 0
        pair = " and ".join(sorted(Path(slices[order[same + each]].file).name for each in (0, 1)))
        raise FileProblem(
            folder, f"has several images of one slice, for example {pair}",
            "Keep one echo or time point of the series, and no copies.",
        )  # fmt: skip
    worst = int(np.argmax(np.abs(gaps - usual)))
    if abs(gaps[worst] - usual) > _SPACING_TOLERANCE * usual:
        pair = f"slices {worst + 1} and {worst + 2}"
        raise FileProblem(
            folder,
            f"has missing slices: {pair} are {gaps[worst]:.2f} mm apart, the others {usual:.2f} mm",
            f"Export the whole series.{_unreadable_file(folder, slices)}",
        )
    return [slices[index] for index in order]


def _names_beside(path: Path) -> dict[str, str]:
    stem = path.name.removesuffix(".gz").rsplit(".", 1)[0]
    names = (f"{stem}.json", *_NAME_FILES)
    file = next((path.with_name(name) for name in names if path.with_name(name).exists()), None)
    if file is None:
        raise FileProblem(path, "has no file with the names of its values", f"Add names.json: {_EXAMPLE}.")
    table = read_json_table(file, f"Expected is, for example, {_EXAMPLE}.")
    try:
        table = table.get("labels", table)
        return {str(int(value)): str(name) for value, name in table.items()}
    except (ValueError, AttributeError) as error:
        raise FileProblem(
            file, f"is not a table of values and names ({error})", f"Expected is, for example, {_EXAMPLE}."
        ) from error


_EXAMPLE = '{"1": "femur", "2": "femoral cartilage", "3": "tibia"}'
"""Example of the names of label values, for the error messages."""


def _numbers_by_value(names: dict[str, str]) -> dict[int, int]:
    """Return our label number for each value of a label volume, by the names of the structures."""
    found = {int(value): structure_named(name) for value, name in names.items()}
    return {value: LABELS[structure] for value, structure in found.items() if structure is not None}
