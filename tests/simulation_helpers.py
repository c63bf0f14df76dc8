"""What the tests of simulated campaigns share."""

ONE_CONDITION = {"days": (), "unaged": True, "speeds_mm_s": (2.0, 5.0, 20.0), "repeats": 1, "max_rows": 300}
POINT = {"temperature_C": 60.0, "compression_ratio_pct": 80.0}


def steady(trace):
    """Rows in the middle of a stroke of 40 mm: past the ramp and 20 lengths of the pre-sliding rise."""
    position = trace["displacement_mm"]
    return trace[(position > 6) & (position < 34)]


def mean_forces(runs, traces):
    """Mean force of the steady middle of every run, by speed."""
    return {row.speed_mm_s: steady(traces[row.file])["force_N"].mean() for row in runs.itertuples()}


def tree(folder):
    return {
        p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()
    }


def effect(formula, acts_on="force", operation="add", **more):
    return {"id": "expression", "formula": formula, "acts_on": acts_on, "operation": operation, **more}
