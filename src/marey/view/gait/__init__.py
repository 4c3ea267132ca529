"""Tables and curves over the gait cycle, for the pages of captures, markers and walks."""
