"""Results in the forms in which laboratories and archives exchange them."""
