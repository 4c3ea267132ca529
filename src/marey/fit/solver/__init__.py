"""Weighted least squares over poses and shapes: equations, steps and robust weights."""
