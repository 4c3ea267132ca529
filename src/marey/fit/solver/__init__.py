"""Weighted least squares over poses and shapes: equations, steps, robust weights."""
