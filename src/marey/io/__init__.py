"""Reading and writing of files, with one module per format; no other package opens files."""
