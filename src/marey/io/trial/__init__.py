"""Reading of the trial folder: settings, masks, seeds and start joints."""
