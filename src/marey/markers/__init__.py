"""Skin markers: clusters, the bones beneath them, joints, and the chain of transforms."""
