"""Bodies of metaballs: the implicit surface, its skin, and measurements of segments."""
