"""Stated intervals of all capabilities beside their true errors."""
