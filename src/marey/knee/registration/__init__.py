"""Registration of one bone's surface to another's, rigid and elastic."""
