"""Check of a take's cameras against each other during a run, and the repairs that follow from it."""
