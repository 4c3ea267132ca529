"""Finding a posture from silhouettes when nothing is known of it."""
