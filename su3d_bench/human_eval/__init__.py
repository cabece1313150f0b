"""Annotation sheets: items for annotators, reading their answers, and scores."""
