"""Reading and writing the results of captures, shapes and comparisons."""
