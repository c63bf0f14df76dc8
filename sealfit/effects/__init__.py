"""Physical effects, one file each, and the list of them."""
