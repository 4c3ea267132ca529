"""The catalogue of bad inputs: what is typed, what is damaged before, and what the message must contain."""
