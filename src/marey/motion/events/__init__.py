"""Gait: events of the feet from their motion, cycles between them, and spatio-temporal parameters."""
