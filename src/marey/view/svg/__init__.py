"""Drawings that are part of a page, as SVG."""
