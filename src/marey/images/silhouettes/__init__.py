"""Where a person is in a picture: background models, densities, level sets, outlines."""
