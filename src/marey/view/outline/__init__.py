"""The page on which structures are outlined by hand."""
