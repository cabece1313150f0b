"""Files of others, read as plain data: nothing in them runs, no size in them is believed."""
