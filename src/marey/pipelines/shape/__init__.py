"""From a measured surface to a person's own body."""
