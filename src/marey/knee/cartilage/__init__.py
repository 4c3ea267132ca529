"""Cartilage on the bones, its thickness and its regions."""
