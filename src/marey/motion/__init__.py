"""Motions over time: anatomical angles, filtering, gait cycles, comparison and retargeting."""
