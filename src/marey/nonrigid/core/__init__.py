"""Building blocks shared by all factorisations."""
