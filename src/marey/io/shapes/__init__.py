"""Reading and writing of measured surfaces, tracks, trajectories and recovered shapes."""
