"""Cameras that show a wand at other instants: whole and partial delays, from the paths of its points in the images."""
