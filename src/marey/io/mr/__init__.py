"""Reading and writing of MR volumes, meshes and the files of a knee."""
