"""Drawing: images, overlay videos and report pages. No other package draws."""
