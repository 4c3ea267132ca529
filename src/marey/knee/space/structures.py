"""Names and label numbers of the structures of a knee, and which cartilage lies on which bone."""

LABELS = {
    "femur": 1,
    "femoral_cartilage": 2,
    "tibia": 3,
    "tibial_cartilage": 4,
    "patella": 5,
    "patellar_cartilage": 6,
}
"""Number of each structure in our `labels.nii.gz`."""
BONES = ("femur", "tibia", "patella")
"""Names of the bones, in the order in which they are processed."""
CARTILAGE_OF_BONE = {"femur": "femoral_cartilage", "tibia": "tibial_cartilage", "patella": "patellar_cartilage"}
"""Bone to the cartilage that lies on it."""
BONE_OF_CARTILAGE = {cartilage: bone for bone, cartilage in CARTILAGE_OF_BONE.items()}
"""Cartilage to the bone on which it lies."""


def structure_named(text: str) -> str | None:
    """Return the structure that a name in a label table means; None if it is none of ours.

    Args:
        text: Such as "lateral tibial cartilage" or "femoral cartilage (trusted slices only)"; medial and lateral parts
            of a cartilage are one.
    """
    words = text.lower().split("(")[0].replace("_", " ").replace("-", " ").split()
    name = "_".join(word for word in words if word not in ("left", "right", "medial", "lateral"))
    return name if name in LABELS else None
