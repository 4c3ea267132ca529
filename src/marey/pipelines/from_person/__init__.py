"""`marey calibrate --from-person`: cameras refined by the person of a trial."""
