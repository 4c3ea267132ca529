"""Search for a posture in silhouettes without a prediction."""
