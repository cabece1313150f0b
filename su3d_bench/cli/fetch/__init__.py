"""Published weights and data brought here, once their terms are accepted."""
