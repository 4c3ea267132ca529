"""The structures of a knee: their names, the numbers of their labels, and which cartilage lies on which bone."""

LABELS = {
    "femur": 1,
    "femoral_cartilage": 2,
    "tibia": 3,
    "tibial_cartilage": 4,
    "patella": 5,
    "patellar_cartilage": 6,
}
"""The number of each structure in a `labels.nii.gz` of ours."""
BONES = ("femur", "tibia", "patella")
CARTILAGE_OF_BONE = {"femur": "femoral_cartilage", "tibia": "tibial_cartilage", "patella": "patellar_cartilage"}
BONE_OF_CARTILAGE = {cartilage: bone for bone, cartilage in CARTILAGE_OF_BONE.items()}


def structure_named(text: str) -> str | None:
    """Find which structure is meant by a name in somebody's label table; None if none of ours.

    Args:
        text: Such as "lateral tibial cartilage" or "femoral cartilage (trusted slices only)"; medial and lateral parts
            of a cartilage are one.
    """
    words = text.lower().split("(")[0].replace("_", " ").replace("-", " ").split()
    name = "_".join(word for word in words if word not in ("left", "right", "medial", "lateral"))
    return name if name in LABELS else None
