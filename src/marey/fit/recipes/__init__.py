"""Following a person through a take: start, tracking, and the refinement of all frames together."""
