"""What the silhouettes of a take are found with: empty rooms, reduced images, drawn bodies, and their storage."""
