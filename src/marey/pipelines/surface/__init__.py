"""From the pictures of a trial to its visible surface."""
