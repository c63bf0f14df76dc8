"""Stand-ins for the computing parts, so that the steps and the command line are tested on their own."""

import sys
from types import ModuleType, SimpleNamespace

import pandas as pd
from small_tables import small

from sealfit.errors import Fault
from sealfit.store.manifest import fingerprint
from sealfit.tables import AFTER, LOOP

FAULT = Fault(
    "not_a_number",
    "is not a number.",
    "a.csv",
    None,
    3,
    "force_N",
    "x",
    "warning",
    "row left out",
    "Fix the cell.",
)
ERRORS = {
    "rmse_N": 0.4,
    "rmse_runs_N": 0.3,
    "heldout_rmse_N": 0.5,
    "heldout_extrapolated_rmse_N": None,
    "max_abs_N": 1.5,
    "mean_abs_pct": 2.0,
    "lack_of_fit_p": None,
}
EFFECT = {
    "id": "ripple",
    "label": "lead-screw ripple",
    "reference": "mean over a wavelength",
    "form": "A sin(2 pi x / lambda + phi)",
    "acts_on": "force",
    "operation": "add",
    "channels": ["displacement_mm"],
    "level": "trace",
    "p_value": 0.001,
    "heldout_gain_N": 0.1,
    "heldout_rmse_N": 0.2,
    "alternatives": [],
    "named": True,
    "candidate": False,
    "parameters": [
        {"name": "A", "value": 0.25, "ci95": [0.2, 0.3], "unit": "N"},
        {"name": "n", "value": float("nan"), "ci95": [None, None], "unit": ""},
    ],
}
CLOSURE = {
    "schema": 1,
    "verdict": "closed",
    "units": {
        "force_N": "N",
        "displacement_mm": "mm",
        "speed_mm_s": "mm/s",
        "load_N": "N",
        "time_s": "s",
    },
    "noise_floor_N": 0.11,
    "fit_quality": {"state": "within_scatter", "ratio": 1.0, "p_value": 0.5},
    "sensitivity": [],
    "refused": [],
    "before": ERRORS,
    "after": {**ERRORS, "rmse_N": 0.2, "heldout_rmse_N": float("nan")},
    "heldout_unit": "run",
    "effects": [EFFECT],
    "scatter": [],
    "left": {"rmse_N": 0.2, "level": None, "channel": None, "p_value": None, "significant": False},
    "incomplete_channels": [],
    "outlier_files": [],
    "next_runs": [{"why": "a second load would separate them", "conditions": {"load_N": 98.0}}],
}
FITTED = {"theta": [], "terms": []}
MODEL = {
    "schema": 1,
    "config": {},
    "conditions": {"condition": ["a"], "series": ["a"], "rubber": ["rubber"], "aging_days": [0.0]},
    "has_load": True,
    "has_aging": True,
    "compliance": 0.0,
    "declared": {
        "parameters": [],
        "index": {name: [-1] for name in ("mu_0s", "a_s", "b_s", "mu_0c", "a_c", "b_c", "v_s", "sigma_2")},
        "stribeck": {"a": "full"},
        "law": {"a": False},
    },
    "before": FITTED,
    "after": FITTED,
    "covariance": [],
    "sandwiches": [],
    "jumps": [],
    "unconfirmed": [],
    "df": 3.0,
    "scatter": {"s0": 0.1, "g": 0.0, "of_specimens": False, "components": []},
    "ranges": {"load_N": [49.0, 49.0]},
    "speeds_mm_s": {"a": [1.0, 5.0]},
}


class Parts:
    """The stand-ins and what they were called with; set `faults` or `raises` to see a campaign at fault."""

    def __init__(self):
        self.calls, self.configs, self.faults, self.raises, self.workers = [], {}, [], {}, None
        self.closure = CLOSURE

    def _called(self, name, config=None):
        self.calls.append(name)
        self.configs[name] = config
        if name in self.raises:
            raise self.raises[name]

    Place = staticmethod(lambda folder, known, marks: folder)

    def ingest_campaign(self, campaign, config, *, workers=1, on_file=None, place=None):
        self._called("ingest", config)
        marks = {
            path.name: fingerprint(path) for path in sorted(campaign.glob("*.csv")) if path.name != "runs.csv"
        }
        on_file(len(marks), len(marks))
        tables = {name: small(name) for name in ("runs", "traces", "traces_mean", "steady", "bins")}
        tables["runs"] = tables["runs"].assign(started_at="2024-03-01T09:30:00")
        inputs = small("inputs", len(marks)).assign(
            file=list(marks),
            size=[m.size for m in marks.values()],
            mtime_ns=[m.mtime_ns for m in marks.values()],
            sha256=[m.sha256 for m in marks.values()],
            status="used",
        )
        good = Fault("read", "was read.", "a.csv", severity="info", action="kept")
        quality = pd.DataFrame([fault.as_dict() for fault in (good, *self.faults)])
        tables |= {"inputs": inputs, "quality": quality}
        return SimpleNamespace(tables=tables, faults=list(self.faults), marks=marks, stored={})

    def fit_conditions(self, steady, config):
        self._called("fit-steady", config)
        fit = small("steady_fit", 3).assign(
            condition=["a", "b", "c"], parameter="mu_s", value=[0.7, 0.8, 9.0], unit=""
        )
        fit = fit.assign(identified=[True, True, False], reason=["", "", "Too few speeds."])
        return {
            "steady_fit": fit,
            "steady_covariance": small("steady_covariance"),
            "steady_shift": small("steady_shift"),
        }

    def fit_series(self, steady_fit, config):
        self._called("fit-aging", config)
        fit = small("aging_fit", 1).assign(quantity="mu_s", parameter="a", value=0.04, unit="")
        return {"aging_fit": fit, "aging_covariance": small("aging_covariance")}

    def aging_curves(self, aging_fit):
        return small("aging_curves")

    def fit_dynamic(self, traces, steady, steady_fit, config, *, workers=1):
        self._called("fit-dynamic", config)
        fit = small("dynamic_fit", 2).assign(
            quantity="dynamic",
            parameter=["sigma_0", "sigma_1"],
            value=[100.0, 0.5],
            unit=["N/mm", "N s/mm"],
            reason="",
        )
        return {"dynamic_fit": fit, "dynamic_curves": small("dynamic_curves")}

    def joint_laws(self, steady, steady_fit, config):
        return small("aging_laws"), small("master_curve")

    def close_loop(self, bins, traces, config, *, workers=1, on_progress=None):
        self._called("close-loop", config)
        self.workers = workers
        on_progress("trying ripple along displacement_mm")
        tables = {schema.name: small(schema.name) for schema in LOOP}
        if not self.closure["effects"]:
            tables["shapes"] = tables["shapes"].iloc[:0]
        return SimpleNamespace(
            document=self.closure,
            model=MODEL,
            tables=tables,
            after=None,
        )

    def after_fits(self, after, steady, traces, config, *, left_out=False, workers=1):
        return {schema.name: small(schema.name) for schema in AFTER}

    def build_report(self, tables, closure, provenance, config):
        self._called("report", config)
        assert set(tables) >= {"steady", "steady_fit", "aging_curves", "curves"}
        return SimpleNamespace(
            html=f"<p>{closure['verdict']}</p>",
            figures={"one": {"png": b"PNG", "pdf": b"%PDF", "svg": "<svg/>"}},
        )

    def predict(self, model, points, own):
        self._called("predict", own)
        assert model["covariance"] == []
        answers = {name: 1.0 for name in ("force_before_N", "force_after_N", "force_after_lo95_N")}
        answers |= {name: 2.0 for name in ("force_after_hi95_N", "meas_lo95_N", "meas_hi95_N")}
        made = points.assign(**answers, extrapolated=False, note="")
        made.loc[made.index[-1], ["force_after_N", "note"]] = [None, "cannot be answered"]
        return made

    def simulate(self, spec, out):
        self._called("simulate")
        out.mkdir(parents=True, exist_ok=True)
        (out / "runs.csv").write_text("file\na.csv\n")
        (out / "a.csv").write_text(f"{spec}\n")


def put_in(monkeypatch):
    """Put the stand-ins in the place of the computing parts, in this process alone, and return them."""
    parts = Parts()
    places = {
        "sealfit.ingest.campaign": ["ingest_campaign", "Place"],
        "sealfit.fit.steady": ["fit_conditions"],
        "sealfit.fit.aging": ["fit_series", "aging_curves"],
        "sealfit.fit.aging.all_series": ["joint_laws"],
        "sealfit.fit.dynamic": ["fit_dynamic"],
        "sealfit.closure.after": ["after_fits"],
        "sealfit.closure.loop": ["close_loop"],
        "sealfit.closure.predict": ["predict"],
        "sealfit.report.page": ["build_report"],
        "sealfit.simulation": ["simulate"],
    }
    for place, names in places.items():
        module = ModuleType(place)
        for name in names:
            setattr(module, name, getattr(parts, name))
        monkeypatch.setitem(sys.modules, place, module)
    sys.modules["sealfit.simulation"].load_spec = lambda path: path.read_text()
    sys.modules["sealfit.simulation"].truth_path = lambda out: out.with_name(out.name + ".truth.json")
    return parts
