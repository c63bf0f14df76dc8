"""Excel, TDMS, MATLAB and Parquet files written by tests, with the libraries made for them."""

import h5py
import numpy as np
import openpyxl
import pandas as pd
from nptdms import ChannelObject, GroupObject, RootObject, TdmsWriter
from scipy.io import savemat

from sealfit.simulation import load_spec, simulate


def book(path, rows, title="Data", more=(), change=None):
    made = openpyxl.Workbook()
    made.active.title = title
    for row in rows:
        made.active.append(list(row))
    for name, cells in more:
        sheet = made.create_sheet(name)
        for row in cells:
            sheet.append(row)
    if change is not None:
        change(made.active)
    made.save(path)


def as_xlsx(path, table, header=()):
    book(path, [*header, list(table), *table.itertuples(index=False)])


def as_tdms(path, table, group="Measured", root=(), own=(), channels=()):
    objects = [RootObject(dict(root)), GroupObject(group, dict(own))]
    with TdmsWriter(path) as writer:
        objects += [ChannelObject(group, name, table[name].to_numpy(), dict(channels)) for name in table]
        writer.write_segment(objects)


def as_mat(path, table, **scalars):
    savemat(path, {"run": {name: table[name].to_numpy() for name in table}, **scalars})


def as_mat73(path, table, **scalars):
    """Write what MATLAB's save -v7.3 writes: a block of text, then HDF5 with every array transposed."""
    with h5py.File(path, "w", userblock_size=512) as file:
        group = file.create_group("run")
        group.attrs["MATLAB_class"] = np.bytes_("struct")
        for name in table:
            group[name] = table[name].to_numpy()[None, :]
        for name, value in scalars.items():
            text = isinstance(value, str)
            file[name] = (
                np.array([[ord(c)] for c in value], np.uint16) if text else np.array([[value]], float)
            )
            file[name].attrs["MATLAB_class"] = np.bytes_("char" if text else "double")
        file.create_group("#refs#")["a"] = np.zeros((1, 5))
    with open(path, "r+b") as raw:
        raw.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")


def as_parquet(path, table):
    table.to_parquet(path, index=False)


WRITERS = {"xlsx": as_xlsx, "tdms": as_tdms, "mat": as_mat, "v73.mat": as_mat73, "parquet": as_parquet}
ENDINGS = list(WRITERS)


def table(rows=60, seed=3, digits=17, **more):
    """A stroke whose numbers need all their digits."""
    time = np.arange(1, rows + 1) / 7
    force = 30 + np.random.default_rng(seed).normal(0, 0.1, rows)
    made = pd.DataFrame({"time_s": time, "displacement_mm": 5 * time + 1 / 3, "force_N": force})
    return made.map(lambda x: float(f"{x:.{digits}g}")).assign(**more)


def rewritten(simulated, folder, ending, runs="csv"):
    """The campaign with its traces as files of another kind, and its runs in another table."""
    listed = pd.read_csv(simulated / "runs.csv")
    for file in listed["file"]:
        to = folder / file.replace(".csv", f".{ending}")
        to.parent.mkdir(parents=True, exist_ok=True)
        WRITERS[ending](to, pd.read_csv(simulated / file))
    listed["file"] = listed["file"].str.replace(".csv", f".{ending}")
    if runs == "csv":
        listed.to_csv(folder / "runs.csv", index=False)
    else:
        WRITERS[runs](folder / f"runs.{runs}", listed)
    return folder


SPEC = """
name = "formats"
seed = 5
[design]
days = [4]
speeds_mm_s = [5, 20]
repeats = 2
max_rows = 150
[[noise]]
kind = "white"
sd_N = 0.2
"""


def simulated_campaign(folder):
    """Write a small campaign as CSV into `folder` and return its folder."""
    (folder / "spec.toml").write_text(SPEC)
    simulate(load_spec(folder / "spec.toml"), folder / "csv")
    return folder / "csv"
