"""Other people's data sets, one file each, to a `Sequence`."""
