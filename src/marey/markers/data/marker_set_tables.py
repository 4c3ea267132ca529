"""The marker sets that are recognised: labels, the landmarks that they mark, and the markers that follow each bone."""

import re
from collections.abc import Mapping
from dataclasses import dataclass

SIDE_LETTERS = (("left", "L"), ("right", "R"))
"""Names of the body's sides and their letters in labels."""
LabelChoices = tuple[tuple[str, ...], ...]
"""Alternatives for one landmark, the best first; each is one label, or several whose midpoint is the landmark."""


def plain_label(label: str) -> str:
    """Return a label in capital letters without dots, hyphens, underscores and spaces, as labels are compared.

    Args:
        label: A label without the name of a person.
    """
    return re.sub(r"[._\- ]", "", label).upper()


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
_HEADS = _both("FMH", "VMH")
"""Labels on the heads of the first and fifth metatarsals, which CGM2.4 adds."""
_PELVIS: dict[str, LabelChoices] = {
    "RASIS": (("RASI",),), "LASIS": (("LASI",),), "RPSIS": (("RPSI",), ("SACR",)), "LPSIS": (("LPSI",), ("SACR",)),
}  # fmt: skip
"""Landmarks of the pelvis in Plug-in Gait; a marker on the sacrum is midway between the posterior spines."""
_LEG = {
    "LE": ("KNE",), "ME": ("KNM", "KNEIN"), "LM": ("ANK",), "MM": ("MED", "ANKIN"), "CA": ("HEE",), "TOE": ("TOE",),
}  # fmt: skip
"""Landmarks of a leg in Plug-in Gait. The medial markers are KNM and MED in pyCGM2; KNEin and ANKin are the labels of
recordings of one laboratory with Plug-in Gait (Vicon Workstation 5.2)."""
_LEG_24 = {**{name: labels for name, labels in _LEG.items() if name != "TOE"}, "M1": ("FMH",), "M5": ("VMH",)}
"""Landmarks of a leg in CGM2.4, whose TOE is on the forefoot."""
_FOOT_24 = ("HEE", "FMH", "VMH")
"""Markers on a foot in CGM2.4."""
_PLANES = {"left_KJC": "LTHI", "left_AJC": "LTIB", "right_KJC": "RTHI", "right_AJC": "RTIB"}
"""Markers in the frontal planes of thighs and shanks in Plug-in Gait."""
_PELVIS_LABELS = ("LASI", "RASI", "LPSI", "RPSI", "SACR")
"""Labels that follow the pelvis in Plug-in Gait."""


def _conventional(
    key: str, name: str, labels: tuple[str, ...], thigh: tuple[str, ...], shank: tuple[str, ...],
    leg: Mapping[str, tuple[str, ...]] = _LEG, foot: tuple[str, ...] = ("HEE", "TOE"),
) -> MarkerSet:  # fmt: skip
    """Return a set with the landmarks of Plug-in Gait."""
    legs = _on_bones({"thigh": thigh, "shank": shank, "foot": foot})
    return MarkerSet(
        key=key, name=name, labels=labels, landmarks={**_PELVIS, **_sided(leg)}, planes=_PLANES,
        segments={"pelvis": _PELVIS_LABELS, **legs},
    )  # fmt: skip


def _ior(key: str, name: str, thigh: tuple[str, ...], shank: tuple[str, ...]) -> MarkerSet:
    """Return a set with the landmarks of the Istituto Ortopedico Rizzoli, for given markers on thigh and shank."""
    foot = ("FCC", "FM1", "FM2", "FM5")
    pelvis = {"RASIS": "RIAS", "LASIS": "LIAS", "RPSIS": "RIPS", "LPSIS": "LIPS"}
    leg = {"LE": "FLE", "ME": "FME", "LM": "FAL", "MM": "TAM", "CA": "FCC", "M1": "FM1", "M5": "FM5"}
    segments = {"thigh": thigh, "shank": shank, "foot": foot}
    return MarkerSet(
        key=key, name=name, labels=_both("IAS", "IPS", *thigh, *shank, *foot), planes={},
        landmarks={
            **{name: ((label,),) for name, label in pelvis.items()},
            **_sided({name: (label,) for name, label in leg.items()}),
        },
        segments={"pelvis": tuple(pelvis.values()), **_on_bones(segments)},
    )  # fmt: skip


def _opencap() -> MarkerSet:
    """Return the markers that OpenCap's augmenter computes from key points: pelvis, legs, shoulders and C7."""
    leg = ("knee", "mknee", "ankle", "mankle", "calc", "toe", "5meta", *(f"thigh{k}" for k in (1, 2, 3)),
           *(f"sh{k}" for k in (1, 2, 3)))  # fmt: skip
    letters = (("left", "L"), ("right", "r"))
    pelvis = {"RASIS": "r.ASIS", "LASIS": "L.ASIS", "RPSIS": "r.PSIS", "LPSIS": "L.PSIS"}
    names = {"LE": "knee", "ME": "mknee", "LM": "ankle", "MM": "mankle", "CA": "calc", "TOE": "toe"}
    landmarks = {name: ((f"{label}_study",),) for name, label in pelvis.items()}
    landmarks |= {f"{s}_{name}": ((f"{a}_{label}_study",),) for s, a in letters for name, label in names.items()}
    landmarks |= {f"{side}_HJC": ((f"{letter}HJC_study",),) for side, letter in SIDE_LETTERS}
    parts = {
        "thigh": ("thigh1", "thigh2", "thigh3", "knee", "mknee"), "shank": ("sh1", "sh2", "sh3", "ankle", "mankle"),
        "foot": ("calc", "toe", "5meta"),
    }  # fmt: skip
    segments = {f"{s}_{bone}": tuple(f"{a}_{x}_study" for x in own) for s, a in letters for bone, own in parts.items()}
    return MarkerSet(
        key="opencap", name="OpenCap", planes={}, landmarks=landmarks,
        labels=(*(f"{label}_study" for label in pelvis.values()), "RHJC_study", "LHJC_study", "C7_study",
                *(f"{letter}_{name}_study" for _, letter in letters for name in (*leg, "shoulder"))),
        segments={"pelvis": tuple(f"{label}_study" for label in pelvis.values()), **segments},
    )  # fmt: skip


def _opensim() -> MarkerSet:
    """Return the markers of OpenSim's gait example: pelvis and legs, with clusters on thighs and shanks."""
    leg = {"LE": ".Knee.Lat", "ME": ".Knee.Med", "LM": ".Ankle.Lat", "MM": ".Ankle.Med", "CA": ".Heel",
           "TOE": ".Toe.Tip"}  # fmt: skip
    clusters = {
        "thigh": (".Thigh.Upper", ".Thigh.Front", ".Thigh.Rear"),
        "shank": (".Shank.Upper", ".Shank.Front", ".Shank.Rear"),
        "foot": (".Heel", ".Midfoot.Sup", ".Midfoot.Lat", ".Toe.Tip"),
    }
    pelvis = {"RASIS": "R.ASIS", "LASIS": "L.ASIS", "RPSIS": "V.Sacral", "LPSIS": "V.Sacral"}
    return MarkerSet(
        key="opensim", name="OpenSim's gait example", planes={},
        labels=("V.Sacral", *_both(".ASIS", *(label for own in clusters.values() for label in own))),
        landmarks={
            **{name: ((label,),) for name, label in pelvis.items()},
            **_sided({name: (label,) for name, label in leg.items()}),
        },
        segments={"pelvis": ("R.ASIS", "L.ASIS", "V.Sacral"), **_on_bones(clusters)},
    )  # fmt: skip


_WANDS, _CLUSTERS = (("THI", "KNE"), ("TIB", "ANK")), (("THI", "KNE", "THAP", "THAD"), ("TIB", "ANK", "TIAP", "TIAD"))
"""Markers on thigh and shank of one leg in Plug-in Gait and in CGM2.3."""

MARKER_SETS = (
    _conventional("pig-lower", "Plug-in Gait, lower body", _LOWER, *_WANDS),
    _conventional("pig-full", "Plug-in Gait, full body", (*_LOWER, *_UPPER), *_WANDS),
    _conventional("cgm2.3-lower", "CGM2.3, lower body", (*_LOWER, *_ADDED), *_CLUSTERS),
    _conventional("cgm2.3-full", "CGM2.3, full body", (*_LOWER, *_ADDED, *_UPPER), *_CLUSTERS),
    _conventional("cgm2.4-lower", "CGM2.4, lower body", (*_LOWER, *_ADDED, *_HEADS), *_CLUSTERS, _LEG_24, _FOOT_24),
    _conventional(
        "cgm2.4-full", "CGM2.4, full body", (*_LOWER, *_ADDED, *_HEADS, *_UPPER), *_CLUSTERS, _LEG_24, _FOOT_24
    ),
    _ior("ior", "IOR", ("FTC", "FLE"), ("FAX", "TTC", "FAL")),
    _ior("cast", "CAST", tuple(f"TH{k}" for k in range(1, 5)), tuple(f"SK{k}" for k in range(1, 5))),
    _opencap(),
    _opensim(),
)
"""The sets that are recognised. The labels of the first six are those in the settings of the program pyCGM2 for its
models CGM1, which reproduces Plug-in Gait, CGM2.3, and CGM2.4 without SMH, which its fit does not use. Markers of
Plug-in Gait that CGM1 does not list (RBAK, LUPA, LFRM) are left out. Those of IOR are on HAS-Motion's page "Gait
Collection" of its IORGait application (IAS, FTC, IPS, FLE) and in public code for recordings of Qualisys (`R_FME`,
`R_FAX`, `R_TTC`, `R_FAL`, `R_TAM`, `R_FCC`, `R_FM1`, ...). Those of CAST ([Cappozzo1995]) are in public code for
recordings of Qualisys (`R_TH1` to 4, `R_SK1` to 4, `R_IAS`, `R_FCC`, ...). Those of OpenCap are the outputs of its
marker augmenter (`getOpenPoseMarkers_lowerExtremity2` in opencap-core), and those of OpenSim's example are in the
trials that are distributed with its model Gait2354."""
