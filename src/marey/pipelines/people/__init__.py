"""People in a trial: who is present, who is followed, and where the others are in the images."""
