"""Worlds in lines and tables: the figures that must be reached, by drawn feature and by family of effect."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable

import numpy as np
from counts import bounds

NEAR_STATED = (0.8, 1.25)  # of the size that `sensitivity` states: an effect of about that size
BY_SPECIMENS = 4.0  # z counted by specimens above which an effect passes some 80 tests at 0.005 together
WORSE = 1.05  # error after over error before above which prediction was made worse


def failed(record: dict) -> str | None:
    """Return how a world failed to be answered at all, or None."""
    if record.get("exit", 0) is None:
        return "time limit"
    if record.get("traceback") or record.get("predict_traceback"):
        return f"traceback: {record.get('traceback') or record.get('predict_traceback')}"
    if record.get("exit", 0) != 0:
        return f"exit {record['exit']}: {(record['said'].strip().splitlines() or [''])[-1][:160]}"
    if record.get("predict_exit", 0) != 0:
        said = record.get("predict_said", "").strip().splitlines() or [""]
        return f"predict exit {record['predict_exit']}: {said[-1][:160]}"
    if (record.get("lifetime") or {}).get("traceback"):
        return f"lifetime traceback: {record['lifetime']['traceback']}"
    return None


def answered(records: Iterable[dict]) -> list[dict]:
    """Return the worlds in which sealfit came to a verdict."""
    return [r for r in records if "verdict" in r]


def is_null(record: dict) -> bool:
    """Return whether a world hides nothing."""
    return not record["effects"]


def alarmed(record: dict) -> bool:
    """Return whether something was claimed, or structure said to be left."""
    return bool(record["extra"]) or record["verdict"] in ("unexplained", "closed")


def clear_effects(records: Iterable[dict]) -> list[dict]:
    """Return the effects that the true form sees at z of 8 or more."""
    return [e for r in records for e in r["effects"] if e["clear"]]


def ratios(records: Iterable[dict], over: str) -> np.ndarray:
    """Return the error after over another error (`before` or `true_form`), for every world with points."""
    pairs = [
        (r["errors"]["after"], r["errors"][over]) for r in records if (r.get("errors") or {}).get("after")
    ]
    return np.array([a / b for a, b in pairs if b])


def share(count: int, of: int) -> str:
    """Return a count as a share with its 95 % Clopper-Pearson interval."""
    if not of:
        return "-"
    low, high = bounds(count, of)
    return f"{count}/{of} = {100 * count / of:.1f} % [{100 * low:.1f}, {100 * high:.1f}]"


def line(record: dict) -> str:
    """Return a world's result in a line."""
    head = f"{record['size']} {record['index']:4d} {record.get('files', 0):4d} files"
    if "error" in record:
        return f"{head} BENCHMARK FAILED: {record['error'].strip().splitlines()[-1]}"
    hidden = " ".join(
        f"{e['family']}({e['acts_on']}) {e['strength_pct']:.2g}% z={e['z']:.1f}"
        + (f" {('missed', 'alias', 'right')[e['grade']]}/{e['claimed_id'] or '-'}" if "grade" in e else "")
        for e in record["effects"]
    )
    if (why := failed(record)) and "verdict" not in record:
        return f"{head} FAILED {why} | {hidden or 'null'}"
    claims = "; ".join(
        f"{c['id']}({','.join(c['channels'])})->{c['acts_on']}/{c['operation']}" for c in record["claims"]
    )
    errors = " ".join(f"{k} {v:.3g}" for k, v in (record.get("errors") or {}).items() if v is not None)
    inside = f"{record.get('inside', 0)}/{record.get('with_interval', 0)}"
    return (
        f"{head} {record['verdict']:15s} {hidden or 'null'} | {claims or '-'} | "
        f"extra {record['extra']} | {errors} | "
        f"inside {inside} | {record['seconds']:.0f} s {record['peak_MB']:.0f} MB{' | ' + why if why else ''}"
    )


def summarise(records: list[dict]) -> str:
    """Return the Markdown summary of results."""
    fine = answered(records)
    parts = [figures(records, fine), by_feature(fine), by_family(fine), failures(records), worst(fine)]
    return "\n\n".join(parts)


def figures(records: list[dict], fine: list[dict]) -> str:
    """Return the table of figures over all worlds."""
    nulls, clear = [r for r in fine if is_null(r)], clear_effects(fine)
    by_specimens = [e for e in clear if abs(e.get("z_specimens", 0.0)) >= BY_SPECIMENS]
    told = [e for e in clear if e.get("told")]
    before, true_form = ratios(fine, "before"), ratios(fine, "true_form")
    pooled = sum(r.get("inside", 0) for r in fine), sum(r.get("with_interval", 0) for r in fine)
    noted = [r["of_tested_specimens"] for r in fine if r.get("of_tested_specimens")]
    own = sum(n["inside"] for n in noted), sum(n["points"] for n in noted)
    stated = [
        (e["own_rms_N"] / e["smallest_N"], e["grade"] > 0)
        for r in fine
        for e in r["effects"]
        if e["smallest_N"]
    ]
    near = [found for ratio, found in stated if NEAR_STATED[0] <= ratio <= NEAR_STATED[1]]
    spent = np.array([r["cpu_s"] for r in fine if "cpu_s" in r] or [0.0])
    seconds, memory = (
        np.array([r["seconds"] for r in fine] or [0.0]),
        np.array([r["peak_MB"] for r in fine] or [0.0]),
    )
    rows = [
        ("worlds", f"{len(records)} ({len(fine)} answered, {len(nulls)} of them hide nothing)"),
        ("seeds", ", ".join(sorted({r["seed_text"][:12] for r in records}))),
        (
            "worlds not answered, or predictions not given",
            share(sum(failed(r) is not None for r in records), len(records)),
        ),
        ("nothing hidden: claimed or unexplained", share(sum(map(alarmed, nulls)), len(nulls))),
        ("worlds with an effect beyond the true ones", share(sum(r["extra"] > 0 for r in fine), len(fine))),
        (
            "... on a variable of a true effect",
            share(sum(r["extra_on_true_variable"] > 0 for r in fine), len(fine)),
        ),
        ("clear effects found", share(sum(e["grade"] > 0 for e in clear), len(clear))),
        (
            f"... of those with z by specimens >= {BY_SPECIMENS:g}",
            share(sum(e["grade"] > 0 for e in by_specimens), len(by_specimens)),
        ),
        (
            "clear effects that a test of the true form by units tells among all candidates",
            share(len(told), sum("told" in e for e in clear)),
        ),
        ("... of these found", share(sum(e["grade"] > 0 for e in told), len(told))),
        (
            "clear effects named or honestly unnamed",
            share(sum(e["named_rightly"] for e in clear), len(clear)),
        ),
        (
            "predict: error after above before by more than 5 %",
            share(int((before > WORSE).sum()), before.size),
        ),
        ("predict: after over the true form, median, 95th percentile", _quantiles(true_form)),
        ("points inside the 95 % interval of the mean", share(*pooled)),
        ("... that says it is the tested specimens' only", share(*own)),
        ("... and the other points", share(pooled[0] - own[0], pooled[1] - own[1])),
        *(
            (f"intervals of {name} of Eq. 15, nothing hidden", share(*_laws(fine, name)))
            for name in ("mu_0", "a", "b")
        ),
        ("intervals of lifetimes, nothing hidden", share(*_lifetimes(fine))),
        ("effects of about the size that `sensitivity` states: found", share(sum(near), len(near))),
        ("seconds of `run`: median, 95th percentile, most", _quantiles(seconds, last=True)),
        ("processor seconds of `run`, the same", _quantiles(spent, last=True)),
        ("peak resident MB: median, 95th percentile, most", _quantiles(memory, last=True)),
        ("verdicts", ", ".join(f"{k} {n}" for k, n in Counter(r["verdict"] for r in fine).most_common())),
        ("fit quality", ", ".join(f"{k} {n}" for k, n in _states(fine).most_common()) or "not stated"),
        ("worlds with refused effects", str(sum(bool(r["refused"]) for r in fine))),
    ]
    return _table(("figure", "value"), rows)


def _laws(fine: list[dict], name: str) -> tuple[int, int]:
    counts = [r["laws"][name] for r in fine if r.get("laws")]
    return sum(c[0] for c in counts), sum(c[1] for c in counts)


def _lifetimes(fine: list[dict]) -> tuple[int, int]:
    told = [
        r["lifetime"]["inside"] for r in fine if r.get("lifetime") and r["lifetime"].get("inside") is not None
    ]
    return sum(told), len(told)


def _states(fine: list[dict]) -> Counter:
    return Counter(r["fit_quality"]["state"] for r in fine if r["fit_quality"])


def _quantiles(values: np.ndarray, *, last: bool = False) -> str:
    if not values.size:
        return "-"
    numbers = [*np.quantile(values, [0.5, 0.95]), *([values.max()] if last else [])]
    return ", ".join(f"{x:.3g}" for x in numbers)


def by_feature(fine: list[dict]) -> str:
    """Return the figures of the worlds with each drawn feature."""
    rows = []
    for name in sorted({f for r in fine for f in r["features"]}):
        here = [r for r in fine if name in r["features"]]
        nulls, clear = [r for r in here if is_null(r)], clear_effects(here)
        rows.append(
            (
                name,
                str(len(here)),
                share(sum(map(alarmed, nulls)), len(nulls)),
                _count(here, lambda r: r["extra"] > 0),
                f"{sum(e['grade'] > 0 for e in clear)}/{len(clear)}",
                f"{int((ratios(here, 'before') > WORSE).sum())}/{ratios(here, 'before').size}",
                _percent(sum(r.get("inside", 0) for r in here), sum(r.get("with_interval", 0) for r in here)),
            )
        )
    head = ("feature", "worlds", "null: alarmed", "extra", "clear found", "made worse", "inside 95 %")
    return _table(head, rows)


def _count(records: list[dict], test: Callable[[dict], bool]) -> str:
    return f"{sum(map(test, records))}/{len(records)}"


def _percent(count: int, of: int) -> str:
    return f"{100 * count / of:.1f} %" if of else "-"


def by_family(fine: list[dict]) -> str:
    """Return how effects of each family were found, and how the worlds fared that hide them."""
    families = sorted({family_of(e) for r in fine for e in r["effects"]})
    rows = []
    for name in families:
        own = [e for r in fine for e in r["effects"] if family_of(e) == name]
        clear = [e for e in own if e["clear"]]
        said = Counter(e["claimed_id"] for e in clear if e["claimed_id"])
        rows.append(
            (
                name,
                f"{sum(e['grade'] > 0 for e in own)}/{len(own)}",
                share(sum(e["grade"] > 0 for e in clear), len(clear)),
                f"{sum(e['named_rightly'] for e in clear)}/{len(clear)}",
                ", ".join(f"{k} {n}" for k, n in said.most_common(4)),
            )
        )
    return _table(
        ("family", "found of all", "clear (z >= 8) found", "rightly named or unnamed", "claimed as"), rows
    )


def family_of(effect: dict) -> str:
    """Return the family under which an effect is counted."""
    return "local" if effect["family"].startswith("local") else effect["family"]


def failures(records: list[dict]) -> str:
    """Return the worlds that were not answered, or whose points were not."""
    rows = [(name(r), str(r["files"]), why) for r in records if (why := failed(r))]
    return (
        _table(("world", "files", "what happened"), rows) if rows else "No world was left without an answer."
    )


def worst(fine: list[dict], most: int = 15) -> str:
    """Return the worlds with false alarms, those made worse most, and the clearest effects missed."""
    rows = [(name(r), "alarm, nothing hidden", line(r)) for r in fine if is_null(r) and alarmed(r)]
    made = [
        (r["errors"]["after"] / r["errors"]["before"], r)
        for r in fine
        if (r.get("errors") or {}).get("before")
    ]
    made = sorted((x for x in made if x[0] > WORSE), key=lambda x: -x[0])[:most]
    rows += [(name(r), f"error {ratio:.2f} times before", line(r)) for ratio, r in made]
    missed = [(e["z"], r, e) for r in fine for e in r["effects"] if e["clear"] and not e["grade"]]
    missed = sorted(missed, key=lambda x: -x[0])[:most]
    rows += [(name(r), f"missed {e['family']}, z {z:.0f}", line(r)) for z, r, e in missed]
    return (
        _table(("world", "what", "in a line"), rows)
        if rows
        else "No alarm, nothing made worse, nothing clear missed."
    )


def name(record: dict) -> str:
    """Return the arguments that draw a world again."""
    return f"--show {record['index']} --size {record['size']} --seed-text {record['seed_text']}"


def _table(head: tuple, rows: list[tuple]) -> str:
    clean = [[str(cell).replace("|", "/") for cell in row] for row in (head, *rows)]
    lines = ["| " + " | ".join(row) + " |" for row in clean]
    return "\n".join([lines[0], "|" + " --- |" * len(head), *lines[1:]])
