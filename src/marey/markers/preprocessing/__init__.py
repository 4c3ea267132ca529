"""Preparation of raw trajectories: gaps, exchanged labels, landmarks, joint centres, gait events."""
