"""From skin markers to the motion of bones."""
