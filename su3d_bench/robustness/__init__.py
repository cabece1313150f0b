"""How much methods lose under corruptions of their inputs, and how large an error each tolerates."""
