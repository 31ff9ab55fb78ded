"""Writers of the record of a run."""
