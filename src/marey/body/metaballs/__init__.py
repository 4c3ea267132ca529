"""Bodies of metaballs: the implicit surface, its skin, and what follows from it."""
