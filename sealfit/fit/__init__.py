"""Fits: the solvers, the per-condition and per-series fits, and the joint model."""
