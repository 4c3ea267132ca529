"""`marey view`: results and their trial, read and opened for the page."""
