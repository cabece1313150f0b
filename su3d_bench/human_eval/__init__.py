"""Annotation sheets: what people judge, how their answers come back, and what they add up to."""
