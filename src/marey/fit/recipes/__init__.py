"""Motion capture of a person: start, tracking, and the joint refinement of all frames."""
