"""Bones and cartilage from MR, in correspondence with motion capture.

Lengths are the scanner's millimetres and positions LPS (x to the left, y to the back, z to the head), and their names
say so.
"""
