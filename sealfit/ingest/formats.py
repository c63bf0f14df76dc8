"""Trace files of arrays, not of text: TDMS, MATLAB and Parquet, each read by the library made for it.

Every reader gives header lines `name<tab>text`, names of the columns, and a column each. The libraries are
optional (`pip install 'sealfit[formats]'`) and loaded where a file needs them.
"""

import importlib
import io
import re
import struct
import warnings
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import date, datetime, time, timedelta
from pathlib import PurePosixPath
from types import ModuleType

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from sealfit.config import TraceFormat
from sealfit.errors import NOTED, CampaignError, Fault, SealfitError
from sealfit.ingest.columns import suggestion
from sealfit.ingest.files import bad_file

# .xls is refused, and said how to save it.
ENDINGS = {f".{kind}": kind for kind in ("xlsx", "tdms", "mat", "parquet")}
ENDINGS |= {".xlsm": "xlsx", ".xls": "xlsx", ".pq": "parquet"}
CALLED = {"xlsx": "an Excel workbook", "tdms": "a TDMS file", "mat": "a MAT-file"}
CALLED |= {"parquet": "a Parquet file"}
OF_ARRAYS = ("tdms", "mat", "parquet")
_CONTROL = re.compile(r"[\x00-\x1f\x7f]+")


def kind_of(file: str, settings: TraceFormat | None = None) -> str:
    """Return how a file is written: by the config's `format`, else by its ending; "csv" for other endings.

    Examples
    --------
    >>> kind_of("raw/Run 1.TDMS"), kind_of("run.asc"), kind_of("run.dat", TraceFormat(format="mat"))
    ('tdms', 'csv', 'mat')
    """
    if settings is not None and settings.format is not None:
        return settings.format
    return ENDINGS.get(PurePosixPath(file).suffix.lower(), "csv")


def library(name: str, kind: str) -> ModuleType:
    """Return a library that reads files of a kind; CampaignError if it is not installed."""
    try:
        return importlib.import_module(name)
    except ImportError:
        reason = f"{CALLED[kind]} is read by {name}, which is not installed."
        fix = "Install it: pip install 'sealfit[formats]'"
        raise CampaignError([Fault("missing_library", reason, fix=fix)]) from None


@contextmanager
def damage_named(kind: str) -> Iterator[None]:
    """Turn whatever a library raises into a fault of the file; damage causes any kind of exception."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # on styles and the like, which are of no concern here
            yield
    except (SealfitError, MemoryError):
        raise
    except Exception as error:
        said = (str(error).strip().splitlines() or [type(error).__name__])[0][:120]
        fix = "It is damaged or of another format: export it again, or set trace.format in the rig config."
        raise bad_file("damaged_file", f"cannot be read as {CALLED[kind]} ({said}).", fix) from error


@dataclass(frozen=True, slots=True, eq=False)
class Arrays:
    """A file's header lines, the names of its columns (empty where they go by position) and the columns.

    A column, shape (n,), holds float64, datetime64, or text as objects (None where empty); `faults` name what
    is no column.
    """

    header: tuple[str, ...]
    names: tuple[str, ...] = ()
    columns: tuple[np.ndarray, ...] = ()
    faults: tuple[Fault, ...] = ()


def read_arrays(raw: bytes, kind: str, settings: TraceFormat, *, head: bool = False) -> Arrays:
    """Return what a file of a kind, one of `OF_ARRAYS`, holds; with `head` its header lines at least.

    BadFile if it is damaged, or holds not one table; CampaignError if the library is not installed.
    """
    with damage_named(kind):
        found = _READERS[kind](raw, settings, head)
    if not head and not max((len(column) for column in found.columns), default=0):
        raise bad_file("no_rows", "holds no column of data.", "Export it again.")
    return found


def _header_line(name: str, value: object) -> str:
    return f"{name}\t{value_text(value)}"


def value_text(value: object) -> str:
    """Return one value as text that gives it back without loss: dates in ISO 8601, durations in seconds.

    Examples
    --------
    >>> value_text(80.0), value_text(0.1), value_text(True), value_text(None)
    ('80', '0.1', 'TRUE', '')
    >>> value_text(datetime(2024, 3, 1, 9, 30))
    '2024-03-01T09:30:00'
    """
    if value is None:
        return ""
    if isinstance(value, bool | np.bool_):
        return str(bool(value)).upper()
    if isinstance(value, timedelta):
        value = value.total_seconds()
    if isinstance(value, int | float | np.number):
        whole = isinstance(value, int | np.integer) or (float(value).is_integer() and abs(value) < 2**53)
        return str(int(value)) if whole else repr(float(value))
    text = value.isoformat() if isinstance(value, datetime | date | time) else str(value)
    return _CONTROL.sub(" ", text)


def _column(values: np.ndarray) -> np.ndarray | None:
    """Return the values as a column of `Arrays`; None where they are none."""
    if values.dtype.kind in "fiub":
        return values.astype(float)
    if values.dtype.kind == "M":
        return values
    if values.dtype.kind == "m":
        return values / np.timedelta64(1, "s")
    words = values.dtype.kind in "UO" and all(isinstance(cell, str | None) for cell in values.tolist())
    return values.astype(object) if words else None


def _arrays(header: list[str], found: Mapping[str, np.ndarray], settings: TraceFormat) -> Arrays:
    """Return named columns, without those of another length or kind; BadFile if the config names one."""
    kept, faults, by_place = {}, [], dict(enumerate(found, start=1))
    needed = {by_place.get(own, own) for own in settings.their_columns.values()}
    lengths = {len(values) for name, values in found.items() if name in needed}
    rows = lengths.pop() if len(lengths) == 1 else max(map(len, found.values()), default=0)
    for name, values in found.items():
        column = _column(values)
        if column is not None and len(column) == rows:
            kept[name] = column
            continue
        reason = f"has {len(values)} values where others have {rows}"
        fix = "Export all channels at one rate."
        if column is None:
            reason, fix = "holds neither numbers nor text", "Export it as numbers."
        if name in needed:
            raise bad_file("column_shape", f"{reason}.", fix, column=name)
        faults.append(Fault("channel_left_out", f"{reason}; the column is not used.", column=name, **NOTED))
        kept[name] = np.full(rows, np.nan)  # columns may go by position
    return Arrays(tuple(header), tuple(kept), tuple(kept.values()), tuple(faults))


def _chosen(
    options: Mapping[str, Collection[str]], key: str, settings: TraceFormat, derived: str | int | None = None
) -> str:
    """Return the one of several tables in a file that the config names, or the only one that fits it.

    `options` are the tables, and the names of their columns; `key` is "group" or "variable", as in the
    config. The column `derived` need not be in the file.
    """
    wanted = getattr(settings, key)
    if not options:
        raise bad_file("no_rows", "holds no column of data.", "Export it again.")
    if wanted in options:
        return wanted
    if wanted is not None:
        fix = suggestion(wanted, list(options)).replace("columns are", f"{key}s are")
        raise bad_file("missing_table", f"holds no {key} '{wanted}' (trace.{key}) with data.", fix)
    needed = {theirs for ours, theirs in settings.their_columns.items() if ours not in settings.optional}
    names = {name for name in needed - {derived} if isinstance(name, str)}
    fitting = [option for option, columns in options.items() if names <= set(columns)]
    if len(options) == 1 or len(fitting) == 1:
        return [*fitting, *options][0]
    named = ", ".join(repr(option) for option in options)
    fix = f'Choose one in the rig config: {key} = "..." under [trace].'
    raise bad_file("several_tables", f"holds several {key}s with data: {named}.", fix)


# ---------------------------------------------------------------- TDMS


def _tdms(raw: bytes, settings: TraceFormat, head: bool) -> Arrays:
    nptdms = library("nptdms", "tdms")
    nptdms.log.log_manager.set_level("ERROR")  # what it warns of is a fault below
    read = nptdms.TdmsFile.read_metadata if head else nptdms.TdmsFile.read
    tdms = read(io.BytesIO(raw))
    if tdms.file_status.incomplete_final_segment:
        reason = "is cut off: its last segment is not complete."
        raise bad_file("damaged_file", reason, "Copy it again from the rig.")
    groups = {group.name: group for group in tdms.groups() if any(map(len, group.channels()))}
    time_name = settings.their_columns.get("time_s")
    names = {name: [channel.name for channel in group.channels()] for name, group in groups.items()}
    group = groups[_chosen(names, "group", settings, derived=time_name)]
    header = [_header_line(name, value) for name, value in tdms.properties.items()]
    header += [_header_line(f"{group.name}/{name}", value) for name, value in group.properties.items()]
    for channel in group.channels():
        place = f"{group.name}/{channel.name}"
        header += [_header_line(f"{place}/{name}", value) for name, value in channel.properties.items()]
    if head:
        return Arrays(tuple(header))
    made = _arrays(header, {channel.name: np.asarray(channel[:]) for channel in group.channels()}, settings)
    each = [channel.properties for channel in group.channels()]
    clocks = {(p.get("wf_start_offset", 0.0), p["wf_increment"]) for p in each if p.get("wf_increment")}
    if not isinstance(time_name, str) or time_name in names[group.name] or len(clocks) != 1:
        return made  # a column of time that is not there is missed where it is looked for
    ((start, step),) = clocks  # that the waveforms of all channels share
    times = float(start) + float(step) * np.arange(len(made.columns[0]))
    return replace(made, names=(*made.names, time_name), columns=(*made.columns, times))


# ---------------------------------------------------------------- MATLAB

VECTORS = "(vectors)"  # what `variable` calls the vectors that stand in the file by themselves
_HDF5 = b"\x89HDF\r\n\x1a\n"


def _mat(raw: bytes, settings: TraceFormat, head: bool) -> Arrays:
    if raw.startswith(_HDF5) or raw[512:520] == _HDF5:  # version 7.3
        with library("h5py", "mat").File(io.BytesIO(raw), "r") as opened:
            variables = dict(_variables(opened))
    else:
        from scipy.io import loadmat

        if raw[124:128] in _BYTE_ORDER:
            _refuse_damage(raw, 128, len(raw), _BYTE_ORDER[raw[124:128]])
        variables = dict(_variables(loadmat(io.BytesIO(raw), simplify_cells=True)))
    single = str | bool | int | float | np.number
    header = [_header_line(path, value) for path, value in variables.items() if isinstance(value, single)]
    if head:
        return Arrays(tuple(header))
    tables = _tables(variables)
    if not tables:
        fix = "Save the columns as vectors, as a matrix or as a struct: "
        fix += "s = table2struct(T, 'ToScalar', true)."
        raise bad_file("no_rows", "holds no vectors, matrix or struct of numbers.", fix)
    options = {name: table if isinstance(table, dict) else () for name, table in tables.items()}
    name = _chosen(options, "variable", settings)
    table = tables[name]
    if isinstance(table, dict):
        return _arrays(header, table, settings)
    rows, columns = table.shape
    if rows < columns:
        reason = f"variable '{name}' has {rows} rows and {columns} columns; samples are rows."
        raise bad_file("column_shape", reason, "Save its transpose.")
    return Arrays(tuple(header), (), tuple(table.T.astype(float)))


# Version 5 has no checksum, and a wrong tag in it makes `loadmat` crash: the tags are checked before.
_BYTE_ORDER = {b"\x00\x01IM": "<", b"\x01\x00MI": ">"}
_TAGS = {1, 2, 3, 4, 5, 6, 7, 9, 12, 13, 14, 15, 16, 17, 18}
_MATRIX, _COMPRESSED = 14, 15
# Elements of an array by class: flags, sizes, name, what follows; one more for an imaginary part.
_PARTS = {**dict.fromkeys(range(4, 16), 4), 5: 6}
_SPARSE, _OPAQUE = 5, 16  # _OPAQUE: the first class without sizes


def _refuse_damage(raw: bytes, at: int, end: int, order: str) -> list[tuple[int, int]]:
    """Return begin and size of the data elements from `at` to `end`; ValueError if they are not whole."""
    found = []
    while at < end:
        tag, size = struct.unpack_from(f"{order}II", raw, at)
        begin = at + 8
        at = begin + (size if tag == _COMPRESSED else size + -size % 8)
        if small := tag >> 16:  # up to four bytes stand in the tag itself
            tag, size, begin, at = tag & 0xFFFF, small, begin - 4, begin
        if tag not in _TAGS or small > 4 or begin + size > end:
            raise ValueError("its tags are damaged")
        found.append((begin, size))
        if tag == _MATRIX and size:
            parts = _refuse_damage(raw, begin, begin + size, order)
            (flags,) = struct.unpack_from(f"{order}I", raw, parts[0][0])
            kind, imaginary = flags & 0xFF, flags >> 11 & 1
            if kind < _OPAQUE:
                shape = np.frombuffer(raw, f"{order}u4", parts[1][1] // 4, parts[1][0])
                fits = kind == _SPARSE or np.prod(shape, dtype=float) <= size
                if len(shape) < 2 or not fits or len(parts) - imaginary != _PARTS.get(kind, len(parts)):
                    raise ValueError("an array is damaged")
    return found


def _variables(folder: Mapping, inside: str = "") -> Iterator[tuple[str, object]]:
    """Yield path and value of every variable, those in structs as `struct.field`, of both versions alike."""
    for name, value in folder.items():
        if name.startswith(("#", "__")):  # where cells and objects are kept; what `loadmat` says of the file
            continue
        if hasattr(value, "items"):
            yield from _variables(value, f"{inside}{name}.")
        else:
            yield f"{inside}{name}", _hdf5_value(value) if hasattr(value, "attrs") else value


def _tables(variables: Mapping[str, object]) -> dict[str, dict[str, np.ndarray] | np.ndarray]:
    """Return every matrix, and the vectors of every struct and of the file itself, by their names."""
    vectors: dict[str, dict[str, np.ndarray]] = defaultdict(dict)
    matrices = {}
    for path, value in variables.items():
        struct, _, name = path.rpartition(".")
        if isinstance(value, np.ndarray) and value.ndim == 1 and value.size > 1:
            vectors[struct or VECTORS][name] = value
        elif isinstance(value, np.ndarray) and value.ndim == 2 and value.size and value.dtype.kind in "fiub":
            matrices[path] = value
    filled = [name for name, own in vectors.items() if any(_column(v) is not None for v in own.values())]
    return {name: vectors[name] for name in filled} | matrices


def _hdf5_value(item) -> np.ndarray | float | str | None:
    """Return an array, which MATLAB transposes, without dimensions of length 1; a number or text as such."""
    if "MATLAB_empty" in item.attrs or item.dtype.kind not in "fiub":
        return None
    values = np.squeeze(item[()].T)
    if item.attrs.get("MATLAB_class", b"") in (b"char", "char"):
        return "".join(map(chr, np.atleast_1d(values).tolist())) if values.ndim < 2 else None
    return values.item() if values.ndim == 0 else values


# ---------------------------------------------------------------- Parquet

_OF_WRITERS = (b"pandas", b"ARROW:schema")  # what writers keep for themselves
# Largest number of cells of a Parquet file: 1.6 GB as numbers. Equal rows take no room in the file.
MOST_CELLS = 2 * 10**8


def _parquet(raw: bytes, settings: TraceFormat, head: bool) -> Arrays:
    about = pq.read_schema(pa.BufferReader(raw)).metadata or {}
    said = ((key.decode(), about[key].decode("utf-8", "replace")) for key in about if key not in _OF_WRITERS)
    header = [_header_line(*one) for one in said]
    if head:
        return Arrays(tuple(header))
    columns = parquet_columns(raw)
    return _arrays(header, {name: _from_arrow(column) for name, column in columns.items()}, settings)


def parquet_columns(raw: bytes) -> dict[str, pa.ChunkedArray]:
    """Return the columns of a Parquet file, but for an index of pandas's.

    BadFile if it has more than `MOST_CELLS` cells, or two columns of one name.
    """
    opened = pq.ParquetFile(pa.BufferReader(raw), page_checksum_verification=True)
    rows, columns = opened.metadata.num_rows, opened.metadata.num_columns
    if rows * columns > MOST_CELLS:
        reason = f"has {rows} rows of {columns} columns; at most {MOST_CELLS:,} cells are read from one file."
        raise bad_file("too_large", reason, "Divide it into a file for each run.")
    table = opened.read(use_threads=False)
    names = [name for name in table.column_names if not name.startswith("__index_level_")]
    if len(set(names)) < len(names):
        raise bad_file("duplicate_column", "has two columns of one name.", "Rename one.")
    return {name: table.column(name) for name in names}


def _from_arrow(column: pa.ChunkedArray) -> np.ndarray:
    kind = column.type
    if pa.types.is_dictionary(kind):
        column, kind = column.cast(kind.value_type), kind.value_type
    numeric = (pa.types.is_decimal, pa.types.is_null, pa.types.is_boolean, pa.types.is_integer)
    if any(holds(kind) for holds in numeric):
        column = column.cast(pa.float64(), safe=False)
    if pa.types.is_date(kind):
        column = column.cast(pa.timestamp("s"))
    return column.to_numpy()


_READERS = {"tdms": _tdms, "mat": _mat, "parquet": _parquet}
