"""External predictions: readers of the result formats of other programs."""
