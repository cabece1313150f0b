"""Published weights and data brought to this machine: what is asked for, from where it was said to come, checked."""
