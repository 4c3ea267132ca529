"""From the images of a trial to its visible surface."""
