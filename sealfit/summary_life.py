"""What `lifetime` ends with, in lines."""

from __future__ import annotations

from collections.abc import Mapping

from sealfit.summary_lines import line


def lifetime_lines(part: Mapping) -> list[str]:
    """Return the lines of a lifetime, the rivals' answers below it."""
    found = [line("model", text) for text in _model(part)]
    found.append(line("law", f"{part['quantity']} = {part['form']}, {_change(part)}"))
    found.append(line("life" if "days" in part else "use", _life(part)))
    if part.get("ci95_resampled"):
        found.append(line("", f"95 % interval by resampling: {_days_between(part['ci95_resampled'])}"))
    if part.get("ci95_over_laws") and part["rivals"] and part["days"]:
        found.append(line("", f"95 % interval over all laws by their weight: {_days_between(part['ci95_over_laws'])}"))
    if part.get("before"):
        found.append(line("before", f"{_life(part['before'])}, without the effects"))
    for rival in part["rivals"]:
        found.append(line("rival", f"{rival['form']}, {_change(rival)}: {_life(rival)}"))
    return found


def _model(part: Mapping) -> list[str]:
    """Return which model answers, and the state in which each of its effects is zero."""
    if part["model"] == "before":
        return ["before: declared model, without the effects of the loop"]
    if not part["effects"]:
        return ["after: no effect was added, so it is the declared model"]
    return [f"after, {effect['reference']}: {effect['label']}" for effect in part["effects"]]


def _change(part: Mapping) -> str:
    names = [name for name in ("E", "kappa") if name in part["parameters"]]
    if not names:
        return "one temperature and compression"
    driven = f"temperature and compression change the {part['way']}"
    energy = f", E = {part['parameters']['E']:.3g} kJ/mol" if "E" in names else ""
    return driven + energy


def _life(part: Mapping) -> str:
    if "days" not in part:
        years, span = f"{part['years']:g} years", "from {:g} to {:g} degC".format(*part["sought_C"])
        if part["always"] == "longer":
            return f"it lasts longer than {years} at every temperature {span}"
        if part["always"] == "shorter":
            return f"at no temperature {span} does it last {years}"
        low, high = part["tested_C"]
        beyond = f" (extrapolated: tested from {low:g} to {high:g} degC)" if part["extrapolated"] else ""
        return f"it lasts {years} at {part['temperature_C']:.1f} degC{_degrees(part['temperature_ci95'])}{beyond}"
    if part["days"] is None:
        return f"{part['threshold']:.4g} is not reached, not in 1e9 d"
    if part["days"] == 0:
        return f"unaged rubber is beyond {part['threshold']:.4g} already"
    text = f"{part['days']:.3g} d to {part['threshold']:.4g}, 95 % {_days_between(part['ci95'])}"
    if part["beyond_tests"] is not None and part["beyond_tests"] > 1:
        text += f" (extrapolated: {part['beyond_tests']:.2g} times the longest test)"
    if part["outside"]:
        text += f" (extrapolated: {' and '.join(part['outside'])} outside what was tested)"
    return text


def _degrees(ends: list) -> str:
    low, high = ends
    if low is None and high is None:
        return ", these tests set no limits to it"
    if low is None or high is None:
        return f", 95 % below {high:.1f} degC" if low is None else f", 95 % above {low:.1f} degC"
    return f", 95 % {low:.1f} to {high:.1f} degC"


def _days_between(ends: list) -> str:
    low, high = ends
    if low is None:
        return "not in 1e9 d"
    return f"{low:.3g} d or more" if high is None else f"{low:.3g} to {high:.3g} d"
