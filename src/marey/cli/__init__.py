"""The only code that reads settings and talks to a person."""
