"""Tables that people fill in: rows of separated text, and worksheets."""
