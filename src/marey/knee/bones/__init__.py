"""Bones segmented in MR volumes."""
