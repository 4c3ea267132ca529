"""The knee in motion: joint angles and the proximity of its cartilages."""
