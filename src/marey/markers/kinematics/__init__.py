"""Joint angles, inverse kinematics, and chains of named transforms."""
