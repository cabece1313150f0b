"""Online evaluation: sessions and the clock of real-time runs."""
