"""Factorisation of the tracks of several uncalibrated cameras."""
