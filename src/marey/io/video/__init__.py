"""Reading and writing of videos, stills and takes."""
