"""What a calibration determines, what is wrong in a session, and what to film next."""
