"""Joint adjustment of cameras, lenses and board poses by least squares."""
