"""Skeleton, skin and pose: the articulated body and its kinematics."""
