"""Geometry of space: rotations, rigid transforms and twists."""
