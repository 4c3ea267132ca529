"""Joint angles, inverse kinematics, and the chain of named transforms."""
