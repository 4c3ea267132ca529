"""Space: rotations, rigid motions and twists, knowing nothing of cameras or people."""
