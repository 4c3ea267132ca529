"""The marker sets that are recognised: labels, the landmarks that they mark, and the markers that follow each bone."""

from collections.abc import Mapping
from dataclasses import dataclass

SIDE_LETTERS = (("left", "L"), ("right", "R"))
"""Names of the body's sides and their letters in labels."""
LabelChoices = tuple[tuple[str, ...], ...]
"""Alternatives for one landmark, the best first; each is one label, or several whose midpoint is the landmark."""


@dataclass(frozen=True, kw_only=True)
class MarkerSet:
    """A set of markers with agreed labels."""

    key: str
    """Short name, as `--marker-set` takes it."""
    name: str
    labels: tuple[str, ...]
    """Markers that the model of the set follows in motion; medial markers, which a static trial adds, are left out."""
    landmarks: Mapping[str, LabelChoices]
    """Maps landmarks such as `RASIS` or `left_LE` to the labels on them. `left_TOE` is between the second and third
    heads of the metatarsals."""
    segments: Mapping[str, tuple[str, ...]]
    """Maps segments such as `left_thigh` to the labels of the markers that follow them."""
    planes: Mapping[str, str]
    """Maps joint centres (`left_KJC`) to the label of the marker that lies in the frontal plane of the proximal segment
    with the proximal centre and the lateral marker."""


def _both(*names: str) -> tuple[str, ...]:
    """Return labels with the letters of the two sides."""
    return tuple(f"{letter}{name}" for _, letter in SIDE_LETTERS for name in names)


def _sided(table: Mapping[str, tuple[str, ...]]) -> dict[str, LabelChoices]:
    """Return the landmarks of both sides; a name of the table is a landmark, a value lists labels without letters."""
    return {
        f"{side}_{name}": tuple((f"{letter}{label}",) for label in labels)
        for side, letter in SIDE_LETTERS for name, labels in table.items()
    }  # fmt: skip


def _on_bones(table: Mapping[str, tuple[str, ...]]) -> dict[str, tuple[str, ...]]:
    """Return the segments of both sides with the labels of their markers."""
    return {
        f"{side}_{name}": tuple(f"{letter}{label}" for label in labels)
        for side, letter in SIDE_LETTERS for name, labels in table.items()
    }  # fmt: skip


_LOWER = _both("ASI", "PSI", "THI", "KNE", "TIB", "ANK", "HEE", "TOE")
"""Labels of pelvis and legs in Plug-in Gait."""
_UPPER = ("C7", "T10", "CLAV", "STRN", *_both("FHD", "BHD", "SHO", "ELB", "WRA", "WRB", "FIN"))
"""Labels of head, trunk and arms in Plug-in Gait."""
_ADDED = _both("THAP", "THAD", "TIAP", "TIAD")
"""Labels on thighs and shanks that CGM2.3 adds."""
_PELVIS: dict[str, LabelChoices] = {
    "RASIS": (("RASI",),), "LASIS": (("LASI",),), "RPSIS": (("RPSI",), ("SACR",)), "LPSIS": (("LPSI",), ("SACR",)),
}  # fmt: skip
"""Landmarks of the pelvis in Plug-in Gait; a marker on the sacrum is midway between the posterior spines."""
_LEG = {
    "LE": ("KNE",), "ME": ("KNM", "KNEIN"), "LM": ("ANK",), "MM": ("MED", "ANKIN"), "CA": ("HEE",), "TOE": ("TOE",),
}  # fmt: skip
"""Landmarks of a leg in Plug-in Gait. The medial markers are KNM and MED in pyCGM2; KNEin and ANKin are the labels of
recordings of one laboratory with Plug-in Gait (Vicon Workstation 5.2)."""
_PLANES = {"left_KJC": "LTHI", "left_AJC": "LTIB", "right_KJC": "RTHI", "right_AJC": "RTIB"}
"""Markers in the frontal planes of thighs and shanks in Plug-in Gait."""
_PELVIS_LABELS = ("LASI", "RASI", "LPSI", "RPSI", "SACR")
"""Labels that follow the pelvis in Plug-in Gait."""


def _conventional(
    key: str, name: str, labels: tuple[str, ...], thigh: tuple[str, ...], shank: tuple[str, ...]
) -> MarkerSet:  # fmt: skip
    """Return a set with the landmarks of Plug-in Gait."""
    legs = _on_bones({"thigh": thigh, "shank": shank, "foot": ("HEE", "TOE")})
    return MarkerSet(
        key=key, name=name, labels=labels, landmarks={**_PELVIS, **_sided(_LEG)}, planes=_PLANES,
        segments={"pelvis": _PELVIS_LABELS, **legs},
    )  # fmt: skip


_WANDS, _CLUSTERS = (("THI", "KNE"), ("TIB", "ANK")), (("THI", "KNE", "THAP", "THAD"), ("TIB", "ANK", "TIAP", "TIAD"))
"""Markers on thigh and shank of one leg in Plug-in Gait and in CGM2.3."""

MARKER_SETS = (
    _conventional("pig-lower", "Plug-in Gait, lower body", _LOWER, *_WANDS),
    _conventional("pig-full", "Plug-in Gait, full body", (*_LOWER, *_UPPER), *_WANDS),
    _conventional("cgm2.3-lower", "CGM2.3, lower body", (*_LOWER, *_ADDED), *_CLUSTERS),
    _conventional("cgm2.3-full", "CGM2.3, full body", (*_LOWER, *_ADDED, *_UPPER), *_CLUSTERS),
)
"""The sets that are recognised. The labels are those in the settings of the program pyCGM2 for its models CGM1, which
reproduces Plug-in Gait, and CGM2.3. Markers of Plug-in Gait that CGM1 does not list (RBAK, LUPA, LFRM) are left out."""
