"""Simulated campaigns: what a rig would write if the truth were known. The public door is `sealfit.simulate`."""
