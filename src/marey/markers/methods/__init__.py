"""The methods that estimate bones from skin markers."""
