"""Campaigns with known truth.

`load_spec` reads a SPEC, `simulate` writes the campaign, `true_force` knows the answer. The parts are in
`sealfit.simulation`; this is the door for the command line and for notebooks.
"""

from sealfit.simulation.campaign import load_truth, simulate, true_force, truth_path
from sealfit.simulation.spec import Spec, load_spec

__all__ = ["Spec", "load_spec", "load_truth", "simulate", "true_force", "truth_path"]
