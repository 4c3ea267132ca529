"""Shape and motion of what deforms, without a model of it: low-rank factorisation of tracks and of points in space."""
