"""The fits. Each returns the tables in which it is stored, by name, and takes those of the fits before it."""
