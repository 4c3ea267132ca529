"""Skin markers: clusters, the bone beneath them, joints, and the chain of transforms."""
