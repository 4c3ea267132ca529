"""The person as a function of parameters."""
