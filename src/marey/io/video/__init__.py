"""Videos, stills and takes."""
