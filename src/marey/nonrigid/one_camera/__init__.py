"""Factorisation of the tracks of one camera, orthographic and in perspective."""
