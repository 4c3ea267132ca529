"""The files of a study: its settings, its trials, the records of its steps, and its tables."""
