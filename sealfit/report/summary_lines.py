"""The summary that a command prints: the figures of `summary` in words."""

from collections.abc import Mapping, Sequence

from sealfit.errors import EXAMPLES

NOT_TRACES = {  # why a file in the campaign's folder is none of its traces, by the check that says so
    "not_listed": "not in the table of runs",
    "not_matched": "not matched by the file-name pattern",
    "excluded": "excluded by files.exclude",
    "file_name": "with names that are not UTF-8",
}
# Family-wise error rate of the search, by default. A larger p-value is not significant.
SEARCHED = 0.005
# A larger p-value is weak evidence, as `WEAK_P` in the criteria of the loop.
WEAK = 1e-6
# An interval of a lifetime that excludes nothing.
OPEN = [0.0, None]
NO_ENDS = ", without a finite 95 % interval"
# Level of the test for lack of fit.
LACKING = 0.05
# Largest activation energy of aging that is plausible, in kJ/mol; rubbers have 20 to 150.
MOST_E = 300.0


def lines(summary: Mapping) -> list[str]:
    """Return the summary of steps as lines, the verdict first; fits after the loop precede those before."""
    writers = {
        "close_loop": closure_lines,
        "ingest": ingest_lines,
        "fit_steady": lambda part: _fit_lines("steady fit", part),
        "fit_aging": lambda part: _fit_lines("aging", part) + property_lines(part.get("properties", ())),
        "fit_dynamic": dynamic_lines,
        "report": lambda part: [line("report", part["file"])],
    }
    after, found = summary.get("close_loop", {}).get("fits") or {}, []
    for name, write in writers.items():
        found += write(after[name]) if name in after else []
        own = write(summary[name]) if name in summary else []
        if name in after:
            own = [line("  before", text[len(line("", "")) :]) for text in own if text not in found]
        found += own
    return found


def ingest_lines(part: Mapping) -> list[str]:
    """Return the lines of an ingest."""
    files, faults = part["files"], part["faults"]
    found = [line("files", f"{files['used']} used, {files['left_out']} left out")]
    for check, names in part["not_traces"].items():
        more = ", ..." if len(names) > EXAMPLES else ""
        found.append(line("", f"{len(names)} {NOT_TRACES[check]}: {', '.join(names[:EXAMPLES])}{more}"))
    numbers = {what: part[f"{what}s_left_out"] for what in ("stroke", "row")}
    left_out = [_count(number, what) for what, number in numbers.items() if number]
    if sum(faults.values()):
        text = f"{_count(faults['error'], 'error')}, {_count(faults['warning'], 'warning')}"
        more = f"; left out: {', '.join(left_out)}" if left_out else ""
        found.append(line("faults", f"{text}{more} (table quality)"))
    found += [line("column", f"{one['column']}: {one['reason']}") for one in part["incomplete_columns"]]
    repeated = "it follows the force in all strokes (table quality)"
    found += [line("column", f"{name}: {repeated}") for name in part["repeats_of_force"]]
    found.append(line("conditions", f"{part['conditions']} in {_count(part['runs'], 'run')}"))
    return found


def _fit_lines(title: str, part: Mapping) -> list[str]:
    ranges = part["parameters"]
    if not ranges:
        return [line(title, "nothing to fit")]
    quantities = list(dict.fromkeys(entry["quantity"] for entry in ranges))
    found = []
    for quantity in quantities:
        texts = [_range(entry) for entry in ranges if entry["quantity"] == quantity]
        name = "" if len(quantities) == 1 else f"{quantity}: "
        found.append(line(title if not found else "", name + ", ".join(texts)))
    texts, reasons = [], []
    for entry in ranges:
        lacking = entry["of"] - entry["identified"]
        if lacking:
            name = f"{entry['quantity']} " if len(quantities) > 1 else ""
            places = f" in {lacking} of {entry['of']}" if entry["of"] > 1 else ""
            texts.append(f"{name}{entry['parameter']}{places}")
            reasons += filter(None, [entry["reason"]])
    if texts:
        found.append(line("", " ".join([f"not identified: {', '.join(texts)}.", *reasons[:1]])))
    remarks = [f"{entry['parameter']}: {entry['remark']}" for entry in ranges if entry["remark"]]
    found += [line("", text) for text in dict.fromkeys(remarks)]
    if said := specimens_clause(part.get("specimens")):
        found.append(line("", f"specimens: {said}"))
    return found


def specimens_clause(specimens: Mapping | None) -> str:
    """Return the scatter of specimens and whether intervals contain it, in words; "" if nothing is known."""
    if specimens is None or specimens["sd_pct"] is None:
        return specimens["remark"] if specimens else ""
    return f"{specimens['sd_pct']:.2g} % {specimens['remark']}"


def property_lines(properties: Sequence[Mapping]) -> list[str]:
    """Return the lines of properties: their values, their scatter, and how the laws fit them."""
    found, several = [], len({one["rubber"] for one in properties}) > 1
    for one in properties:
        of = f"rubber {one['rubber']}: " if several else ""
        found.append(line(one["quantity"], of + values_clause(one)))
        if one["far_off"]:
            found.append(line("", far_off_clause(one["far_off"])))
        if clause := lack_of_fit_clause(one["lack_of_fit_p"]):
            found.append(line("", f"law per series: it {clause}"))
        if one["law"]:
            found.append(line("law", _property_law(one["law"])))
    return found


def values_clause(one: Mapping) -> str:
    """Return the number of a property's values and their scatter, in words."""
    unit = f" {one['unit']}" if one["unit"] else ""
    scatter = "no replicates, so nothing shows whether a law fits"
    if one["replicate_sd"] is not None:
        scatter = f"standard deviation of replicates {one['replicate_sd']:.3g}{unit}"
    if one["batch_sd"] is not None:
        scatter += f", of batches {one['batch_sd']:.3g}{unit}"
    return f"{_count(one['values'], 'value')} in {_count(one['conditions'], 'condition')}; {scatter}"


def far_off_clause(values: Sequence[Mapping]) -> str:
    """Return which values of a property its other values contradict, and what to do."""
    named = [f"line {v['line']} ({v['value']:.4g} beside {v['others']:.4g})" for v in values[:EXAMPLES]]
    more = f" and {len(values) - EXAMPLES} more" if len(values) > EXAMPLES else ""
    said = f"far off the other specimens of the condition: {', '.join(named)}{more}"
    return f"{said}; correct the cell, or empty it to leave the value out"


PER_SERIES = "mu_0 - a ln(1 + t/b)"  # the aging law of a series


def property_sentences(one: Mapping) -> str:
    """Return in sentences whether the law per series fits a property, and the law for all series."""
    clause = lack_of_fit_clause(one["lack_of_fit_p"]) or "has no replicates to be judged by"
    law = f" One law for all series: {_property_law(one['law'])}." if one["law"] else ""
    far = f" Values {far_off_clause(one['far_off'])}." if one["far_off"] else ""
    return f"{one['quantity']}: the law {PER_SERIES}, series by series, {clause}.{law}{far}"


def _property_law(law: Mapping) -> str:
    text = f"{law['form']}, {drivers_clause(law['drivers'], law['way'])}"
    if law["E"]:
        value, low, high = law["E"]
        text += f", E = {value:.3g} kJ/mol [{low:.3g}, {high:.3g}]"
        if high < 0 or low > MOST_E:
            text += f" (implausible for rubber, 0 to {MOST_E:g}: look for wrong values)"
    elif "E" in law["drivers"]:
        text += ", E not identified"
    clause = lack_of_fit_clause(law["lack_of_fit_p"])
    return f"{text}; it {clause}" if clause else text


def drivers_clause(drivers: Sequence[str], way: str) -> str:
    """Return in words what temperature (E) and compression (kappa) change in a law."""
    names = [name for name, of in (("temperature", "E"), ("compression", "kappa")) if of in drivers]
    if not names:
        return "a single temperature and compression"
    return f"{' and '.join(names)} {'changes' if len(names) == 1 else 'change'} the {way}"


def lack_of_fit_clause(p: float | None) -> str:
    """Return in words whether a law fits the values within the scatter of replicates; "" if not known."""
    if p is None or p != p:
        return ""
    if p < LACKING:
        shown = f"p = {p:.2g}" if p >= 0.001 else "p < 0.001"
        return f"does not fit (lack of fit, {shown}): do not rely on it between or beyond the tests"
    return f"fits within the scatter of replicates (lack of fit, p = {p:.2g})"


def dynamic_lines(part: Mapping) -> list[str]:
    """Return the lines of the dynamic fit."""
    found = _fit_lines("pre-sliding", part)
    if part["above_sliding"]:
        more = f"{part['largest_ratio'] - 1:.1%} at most, {part['largest_at']}"
        text = f"above the sliding force in {part['above_sliding']} of {part['break_aways']} cases "
        text += f"of condition, speed and direction ({more})"
        found.append(line("break-away", text))
    return found


def _range(entry: Mapping) -> str:
    if entry["min"] is None:
        return f"{entry['parameter']} not identified"
    top = f" to {entry['max']:.4g}" if entry["max"] != entry["min"] else ""
    return f"{entry['parameter']} {entry['min']:.4g}{top} {entry['unit']}".rstrip()


def closure_lines(part: Mapping) -> list[str]:
    """Return the lines of a closed loop."""
    unit, before, after = part["units"]["force_N"], part["before"], part["after"]
    found = [line("verdict", f"{part['verdict']}: {part['sentence']}")]
    for effect in part["effects"]:
        status = "candidate, not applied: " if effect["candidate"] else "+ "
        known = [p for p in effect["parameters"] if p["value"] is not None or p["name"] != "phi"]
        values = ", ".join(_value(p) for p in known) if effect["named"] else "no closed form fits as well"
        found.append(line("", f"{status}{effect['label']}: {values}"))
        if not effect["candidate"]:
            found.append(line("", f"  reference state of the coefficients: {effect['reference']}"))
    held_out = ("held out", "heldout_rmse_N")
    if before["heldout_rmse_N"] is None and before["heldout_extrapolated_rmse_N"] is not None:
        held_out = ("held out, all extrapolated", "heldout_extrapolated_rmse_N")
    rows = (("rmse", "rmse_N"), held_out, ("run means", "rmse_runs_N"), ("largest", "max_abs_N"))
    texts = [f"{name} {_number(before[key])} -> {_number(after[key])}" for name, key in rows]
    found.append(line(f"error ({unit})", "; ".join(texts)))
    if part["noise_floor_N"] is not None:
        found.append(line("noise floor", f"{_number(part['noise_floor_N'])} {unit}"))
    if part["left"]["channel"] is not None:
        found.append(line("residual", _left(part["left"], unit)))
    for run in part["next_runs"][:3]:
        settings = ", ".join(_setting(*own, part["units"]) for own in run["conditions"].items())
        found.append(line("next runs", f"{run['why']}: {settings}" if settings else run["why"]))
    return found


def _setting(name: str, value: object, units: Mapping[str, str]) -> str:
    """Return a setting of a run, e.g. "speed_mm_s 20 rpm"; the unit where the name does not say it."""
    text = value if isinstance(value, str) else f"{value:.4g}"
    unit = units.get(name, "")
    named = name.endswith(f"_{unit.replace('/', '_')}")
    return f"{name} {text}" if named else f"{name} {text} {unit}".rstrip()


def has_weak_evidence(left: Mapping) -> bool:
    """Return whether the search found the remaining residual significant, but its evidence is weak."""
    return left["p_value"] is not None and left["p_value"] <= SEARCHED and not left["significant"]


def weakness(left: Mapping) -> str:
    """Return why such a residual is not significant: what its evidence lacks, as the end of a clause."""
    return "is weak" if left["p_value"] > WEAK else "rests on too few specimens or runs"


def _left(left: Mapping, unit: str) -> str:
    """Return the remaining residual: its size above the floor, the variable, and the p-value."""
    above = f"rms {_number(left['rmse_N'])} {unit} above the noise floor, " if left["rmse_N"] else ""
    weak = f", its evidence {weakness(left)}" if has_weak_evidence(left) else ", not significant"
    significant = "" if left["significant"] else weak
    return f"{above}along {left['channel']} (p = {left['p_value']:.2g}{significant})"


def _value(parameter: Mapping) -> str:
    """Return a parameter with its 95 % interval, e.g. "A 0.4 [0.38, 0.42] N"."""
    ends = ""
    if None not in parameter["ci95"]:
        low, high = map(_number, parameter["ci95"])
        ends = f" [{low}, {high}]"
    return f"{parameter['name']} {_number(parameter['value'])}{ends} {parameter['unit'] or ''}".rstrip()


def _acts(way: Mapping) -> str:
    how = {"add": "added to", "multiply": "a factor on"}[way["operation"]]
    return f"{how} {'the force' if way['target'] == 'force' else way['target']}"


def effects_lines(listed: Mapping) -> list[str]:
    """Return the catalogue of effects as lines."""
    found = []
    for effect in listed["effects"]:
        mark = "  [in the model of this OUT]" if effect["id"] in (listed.get("added") or ()) else ""
        found.append(f"{effect['id']}: {effect['label']}{mark}")
        found += [f"    {effect['form']}", f"    {', '.join(map(_acts, effect['acts_on']))}"]
        for p in effect["parameters"]:
            found.append(f"    {p['name']}{' [' + p['unit'] + ']' if p['unit'] else ''}: {p['meaning']}")
    if listed.get("added", ()) is None:
        text = "The loop of this OUT has not been run or is out of date, so its effects are not listed."
        found.append(text)
    if listed.get("note"):
        found.append(f"note: {listed['note']}")
    return found


def predict_lines(part: Mapping) -> list[str]:
    """Return the lines of a prediction."""
    text = f"{part['answered']} of {_count(part['rows'], 'row')} predicted"
    text += f", {part['extrapolated']} extrapolated"
    if refused := part["rows"] - part["answered"]:
        text += f"; {_count(refused, 'row')} not predicted (reason in column note)"
    found = [line("points", text), line("output", part["output"])]
    if part["includes"]:
        effects = "; ".join(part["includes"])
        found.append(line("includes", f"{effects}: force_after_N is what the sensor would read"))
    return found


def line(title: str, text: str) -> str:
    """Return a line of a summary under its title."""
    return f"{title:<11} {text}"


def _count(number: int, what: str) -> str:
    return f"{number} {what}{'' if number == 1 else 's'}"


def _number(value: float | None) -> str:
    return "unknown" if value is None else f"{value:.3g}"


def lifetime_lines(part: Mapping) -> list[str]:
    """Return the lines of a lifetime, followed by those of the alternative laws."""
    found = [line("model", text) for text in _model(part)]
    clause = lack_of_fit_clause(part["lack_of_fit_p"])
    law = f"{part['quantity']} = {part['form']}, {_change(part)}"
    found.append(line("law", f"{law}; it {clause}" if clause else law))
    found += [line("note", f"{part['quantity']} is {note}") for note in part["notes"]]
    if part.get("ci95_over_laws") and part["rivals"] and part["days"] != 0 and part["ci95"] != OPEN:
        found.append(line("life", _life({**part, "ci95": part["ci95_over_laws"]})))
        found.append(line("", "the interval is over all laws, weighted by their BIC"))
        found.append(line("", f"95 % interval if this law is true: {_days_between(part['ci95'])}"))
    else:
        found.append(line("life" if "days" in part else "use", _life(part)))
    if part.get("ci95_resampled"):
        found.append(line("", f"95 % interval by resampling: {_days_between(part['ci95_resampled'])}"))
    if part.get("before"):
        found.append(line("before", f"{_life(part['before'])}, without the effects"))
    for rival in part["rivals"]:
        found.append(line("alternative", f"{rival['form']}, {_change(rival)}: {_life(rival)}"))
    return found


def _model(part: Mapping) -> list[str]:
    """Return the model used, and the reference state of each of its effects."""
    if part["model"] is None:
        return []
    if part["model"] == "before":
        return ["before: declared model, without the effects of the loop"]
    if not part["effects"]:
        return ["after: no effect was added"]
    return [f"after, {effect['reference']}: {effect['label']}" for effect in part["effects"]]


def _change(part: Mapping) -> str:
    energy = f", E = {part['parameters']['E']:.3g} kJ/mol" if "E" in part["parameters"] else ""
    return drivers_clause(tuple(part["parameters"]), part["way"]) + energy


def _life(part: Mapping) -> str:
    if "days" not in part:
        years, span = f"{part['years']:g} years", "from {:g} to {:g} degC".format(*part["sought_C"])
        if part["always"]:
            more = {"longer": "longer", "shorter": "less"}[part["always"]]
            return f"it lasts {more} than {years} at every temperature {span}"
        low, high = part["tested_C"]
        beyond = f" (extrapolated: tested from {low:g} to {high:g} degC)" if part["extrapolated"] else ""
        ends = _degrees(part["temperature_ci95"])
        return f"it lasts {years} at {part['temperature_C']:.1f} degC{ends}{beyond}"
    no_ends = part["ci95"] in ([None, None], [0, 0])
    ends = "" if no_ends else f", 95 % {_days_between(part['ci95'])}"
    if part["ci95"] == OPEN:
        ends = NO_ENDS
    if part["days"] is None:
        return f"{part['threshold']:.4g} is not reached within 1e9 d{ends}"
    if part["days"] == 0:
        return f"unaged rubber is already beyond {part['threshold']:.4g}{ends}"
    text = f"{part['days']:.3g} d to {part['threshold']:.4g}{ends}"
    if part["beyond_tests"] is not None and part["beyond_tests"] > 1:
        text += f" (extrapolated: {part['beyond_tests']:.2g} times the longest test)"
    if part["outside"]:
        text += f" (extrapolated: {' and '.join(part['outside'])} outside the tested range)"
    return text


def _degrees(ends: list) -> str:
    low, high = ("" if end is None else f"{end:.1f}" for end in ends)
    if not (low or high):
        return NO_ENDS
    between = f"{low} to {high}" if low and high else f"above {low}" if low else f"below {high}"
    return f", 95 % {between} degC"


def _days_between(ends: list) -> str:
    low, high = ends
    if low is None:
        return "more than 1e9 d"
    return f"{low:.3g} d or more" if high is None else f"{low:.3g} to {high:.3g} d"
