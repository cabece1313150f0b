"""A paper's experiments as recipes: what they need, their runs, measured beside reported, the bundle."""
