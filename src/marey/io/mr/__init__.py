"""MR volumes, meshes, and the files of a knee."""
