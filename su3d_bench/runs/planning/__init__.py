"""What was asked for becomes what will be done: scenes named, everything resolved and checked, its time estimated."""
