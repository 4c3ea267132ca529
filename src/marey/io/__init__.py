"""The only code that opens files: one module a format."""
