"""Shape and motion of deforming surfaces without a model of the body: low-rank factorisation of tracks and points."""
