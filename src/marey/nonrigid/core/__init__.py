"""Building blocks that all factorisations share."""
