"""From the videos of a trial to the motion of the person in it."""
