"""The page of `marey view`: videos, bodies and curves of results at one time."""
