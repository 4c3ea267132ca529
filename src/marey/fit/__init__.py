"""Parameters from observations: one least squares for all of them."""
