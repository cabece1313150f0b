"""Names of objects made better by a language model that is shown them."""
