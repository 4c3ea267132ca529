"""Several people in one trial: their list, and the capture of all of them."""
