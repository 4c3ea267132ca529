"""The only code that draws for a person."""
