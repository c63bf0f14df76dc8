"""A rig config drafted from a folder of files: every guess with its evidence, every doubt with what to do."""
