"""Sessions: a method fed frame by frame by the caller, with maps at any time, saved and continued."""
