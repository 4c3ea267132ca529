"""Which point of one camera is which point of another."""
