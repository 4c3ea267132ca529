"""Outlines drawn by hand with the live wire."""
