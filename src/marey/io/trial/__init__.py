"""The trial folder: settings, masks, seeds, and start joints."""
