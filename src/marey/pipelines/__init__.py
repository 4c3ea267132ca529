"""From a user's files to results: one pipeline per task."""
