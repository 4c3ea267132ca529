"""People found and tracked by the colours of their parts, where neither background nor joints are known."""
