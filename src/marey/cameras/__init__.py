"""From the world to pixels and back."""
