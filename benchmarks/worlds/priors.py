"""Priors of a world: every number that is drawn, from what, and why."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np


@dataclass(frozen=True)
class Prior:
    """One drawn number: its distribution, the distribution's numbers, and the reason for them."""

    law: Literal["log", "uniform", "integer", "log_integer", "choice", "chance"]
    values: tuple
    reason: str

    def draw(self, rng: np.random.Generator):
        """Return one draw as a plain Python value."""
        if self.law == "chance":
            return bool(rng.random() < self.values[0])
        if self.law == "choice":
            return self.values[int(rng.integers(len(self.values)))]
        low, high = self.values
        if self.law == "integer":
            return int(rng.integers(low, high + 1))
        if self.law == "uniform":
            return float(rng.uniform(low, high))
        value = float(np.exp(rng.uniform(np.log(low), np.log(high))))
        return round(value) if self.law == "log_integer" else value


PRIORS: dict[str, Prior] = {
    # ---------------------------------------------------------------- the rig
    "stroke_mm": Prior("log", (2.0, 100.0), "from microtribometers to lead-screw rigs"),
    "stroke_bristles": Prior(
        "log", (3.0, 300.0), "stroke over bristle length F_c / sigma_0; short ones never settle"
    ),
    "rate_Hz": Prior("log", (20.0, 1e4), "handheld loggers to DAQ cards"),
    "ramp_share": Prior("log", (0.002, 0.1), "share of the stroke on which the fastest test accelerates"),
    "dwell_share": Prior("uniform", (0.0, 0.05), "recording starts a little before the motion"),
    "start": Prior("choice", ("rest", "reversed"), "a piece is put on anew, or was just moved back"),
    "start_scatter": Prior(
        "log", (1e-4, 0.2), "of the start position, share of the stroke: position is not distance"
    ),
    "position_noise": Prior("log", (1e-6, 2e-3), "encoder or potentiometer, share of the stroke"),
    "position_step": Prior("log", (1e-6, 1e-3), "resolution of the position, share of the stroke"),
    "speed_error": Prior("log", (1e-5, 5e-3), "relative difference of a file's true speed from the set one"),
    "clock_error": Prior("log", (1e-6, 1e-3), "relative error of a drifting logger clock, one draw per file"),
    "samples_per_file": Prior(
        "log_integer", (120, 2000), "most of a stroke: slow tests are logged more slowly"
    ),
    # ---------------------------------------------------------------- the campaign
    "files_small": Prior("log_integer", (8, 150), "small enough for a world to take seconds"),
    "files_any": Prior("log_integer", (8, 2000), "what laboratories have"),
    "speeds": Prior("integer", (3, 12), "three is the least that shows a curve"),
    "decades": Prior("uniform", (1.0, 3.0), "between the slowest and the fastest"),
    "speed_place": Prior(
        "uniform", (0.2, 0.8), "where v_s lies among the tested speeds, share of the decades"
    ),
    "repeats": Prior("integer", (1, 5), "one is common, three is the paper's"),
    "series": Prior("log_integer", (1, 12), "temperature x compression"),
    "days": Prior("integer", (0, 8), "aged days tested; 0: a rig that ages nothing"),
    "unaged": Prior("chance", (0.8,), "most aging tests start with unaged rubber"),
    "loads": Prior("choice", (1, 1, 1, 1, 2, 3, 4), "mostly a dead weight"),
    "load_column": Prior("chance", (0.85,), "of one load: some logs do not write it down"),
    "directions": Prior(
        "choice", ("one", "one", "separate", "together"), "files one way, each way, or both in one"
    ),
    "strokes": Prior("integer", (1, 5), "strokes of a file that holds both ways: at least two"),
    "specimens": Prior("choice", (1, 1, 1, 2, 3), "pieces per condition: mostly one"),
    "specimen_column": Prior("chance", (0.6,), "of one piece per condition: often not written down"),
    "holes": Prior("chance", (0.4,), "tests that failed or were never done"),
    "holes_share": Prior("uniform", (0.02, 0.25), "share of runs and of repeats that are missing"),
    "calendar": Prior("chance", (0.75,), "a log with starting times"),
    "order": Prior(
        "choice", ("blocked", "shuffled", "by_speed", "follows_rubber"), "how tests follow each other"
    ),
    "passes": Prior("chance", (0.4,), "all runs once before any is repeated"),
    "mounted_anew": Prior("chance", (0.2,), "each repeat is a set-up that all runs of a specimen share"),
    "minutes_per_file": Prior("log", (2.0, 40.0), "time from one test to the next"),
    "nights": Prior("chance", (0.5,), "tests by day only"),
    # ---------------------------------------------------------------- friction
    "load_N": Prior("log", (5.0, 500.0), "from a light seal to a heavy one"),
    "mu_c": Prior("log", (0.1, 0.9), "greased to dry rubber"),
    "mu_s_over_mu_c": Prior("uniform", (1.05, 1.8), "static above Coulomb friction"),
    "v_s_mm_s": Prior("log", (1.0, 50.0), "Stribeck speeds of rubber in the literature"),
    "viscous_share": Prior("log", (0.005, 0.5), "sigma_2 v at the fastest speed, share of Coulomb friction"),
    "sigma_1_over_sigma_0_s": Prior(
        "log", (1e-5, 5e-3), "damping time; 3e-3 s in Canudas de Wit et al. 1995"
    ),
    "aging_loss": Prior("uniform", (0.05, 0.4), "share of mu lost at the last day"),
    "aging_b_days": Prior("log", (0.05, 5.0), "b of Eq. 15 around the paper's 0.08 to 0.13 d, and slower"),
    "series_spread": Prior(
        "uniform", (0.0, 0.3), "relative differences of a, b, v_s and sigma_2 between series"
    ),
    # ---------------------------------------------------------------- noise of the force
    "noise_rel": Prior("log", (2e-4, 2e-2), "standard deviation of a sample, share of the mean friction"),
    "noise_kind": Prior("choice", ("white", "white", "coloured", "heavy"), "amplifiers, motors, contacts"),
    "noise_samples": Prior("log", (1.5, 60.0), "correlation length of coloured noise, samples"),
    "noise_t_df": Prior("uniform", (2.5, 6.0), "Student's degrees of freedom of heavy tails"),
    "noise_growth": Prior(
        "choice", ("none", "none", "force", "speed"), "noise that grows with force or speed"
    ),
    "force_step": Prior(
        "log", (1e-5, 2e-2), "resolution, share of the mean friction: from 24 bits to a display"
    ),
    "outliers": Prior("chance", (0.15,), "spikes, and a file now and then that went wrong"),
    "outlier_share": Prior("log", (1e-5, 2e-3), "of samples"),
    # ---------------------------------------------------------------- scatter of repeats, runs and specimens
    "scatter_gain": Prior("log", (3e-4, 3e-2), "relative standard deviation of the friction"),
    "scatter_level": Prior("log", (1e-4, 1e-2), "offset, share of the mean friction"),
    "scatter_slope": Prior("log", (5e-4, 3e-2), "change along the stroke, share of the friction, end to end"),
    "scatter_v_s": Prior("log", (1e-3, 5e-2), "relative standard deviation of v_s"),
    "scatter_sigma_2": Prior("log", (1e-3, 1e-1), "relative standard deviation of sigma_2"),
    "scatter_gain_here": Prior("chance", (0.75,), "at each level by itself"),
    "scatter_other_here": Prior("chance", (0.25,), "each of the other kinds at each level"),
    # ---------------------------------------------------------------- columns
    "idle_columns": Prior("choice", (0, 0, 1, 2, 4), "what a log holds beside what matters"),
    "missing": Prior("chance", (0.2,), "a column has empty cells"),
    "missing_share": Prior("log", (0.005, 0.1), "of its cells"),
    "clock_drifts": Prior("chance", (0.2,), "a logger of its own"),
    # ---------------------------------------------------------------- effects
    "null": Prior("chance", (0.5,), "half of the worlds hide nothing"),
    "effects": Prior("choice", (1, 1, 2, 3), "of the others"),
    "smooth_random": Prior("chance", (0.3,), "an effect that no catalogue holds"),
    "strength_pct": Prior("log", (0.02, 20.0), "RMS share of the friction: from invisible to large"),
}  # fmt: skip


def draw(name: str, rng: np.random.Generator):
    """Return one draw of a prior."""
    return PRIORS[name].draw(rng)
