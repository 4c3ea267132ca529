"""From raw trajectories to a problem that can be solved: gaps, exchanges, landmarks, events."""
