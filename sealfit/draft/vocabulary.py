"""What columns, parts of file names and header lines are called, in English and German, and their units."""

from __future__ import annotations

import re
from dataclasses import dataclass

# ---------------------------------------------------------------- units
# What a unit measures, and what a number in it is multiplied by to be in the unit that our names say.


@dataclass(frozen=True, slots=True)
class Unit:
    """A unit as files write it.

    `factor` turns a number into s, mm, N, mm/s, days or what `dimension` is counted in; `name` can be part of
    a column's name.
    """

    dimension: str
    factor: float
    name: str


_LBF = 4.4482216152605  # N, exact: 0.45359237 kg times 9.80665 m/s2
_KGF = 9.80665  # N
_LENGTHS = {"mm": 1.0, "m": 1e3, "cm": 10.0, "um": 1e-3, "µm": 1e-3, "μm": 1e-3, "in": 25.4, "inch": 25.4}
_TIMES = {"s": 1.0, "sec": 1.0, "min": 60.0, "h": 3600.0}


def _ascii(unit: str) -> str:
    return unit.replace("µ", "u").replace("μ", "u")


UNITS = {
    **{
        spelled: Unit("time", 1.0, "s")
        for spelled in ("s", "sec", "secs", "second", "seconds", "sek", "sekunden")
    },
    **{spelled: Unit("time", 1e-3, "ms") for spelled in ("ms", "msec", "millisec", "milliseconds")},
    **{spelled: Unit("time", 1e-6, "us") for spelled in ("us", "µs", "μs")},
    **{spelled: Unit("time", 60.0, "min") for spelled in ("min", "minutes", "minuten")},
    **{spelled: Unit("time", 3600.0, "h") for spelled in ("h", "hr", "hours", "std", "stunden")},
    **{spelled: Unit("time", 86400.0, "d") for spelled in ("d", "days", "day", "tage", "tag")},
    **{spelled: Unit("length", factor, _ascii(spelled)) for spelled, factor in _LENGTHS.items()},
    "ft": Unit("length", 304.8, "ft"),
    "N": Unit("force", 1.0, "N"),
    "kN": Unit("force", 1e3, "kN"),
    "mN": Unit("force", 1e-3, "mN"),
    **{spelled: Unit("force", 1e-6, "uN") for spelled in ("uN", "µN", "μN")},
    **{spelled: Unit("force", _LBF, "lbf") for spelled in ("lbf", "lb", "lbs")},
    **{spelled: Unit("force", _KGF, "kgf") for spelled in ("kgf", "kp", "kg")},
    **{spelled: Unit("force", _KGF / 1e3, "gf") for spelled in ("gf", "g")},
    **{
        f"{way}/{time}": Unit("speed", length / seconds, _ascii(f"{way}_{time}"))
        for way, length in _LENGTHS.items()
        for time, seconds in _TIMES.items()
    },
    **{spelled: Unit("rotation", 1.0, "rpm") for spelled in ("rpm", "1/min", "U/min", "min-1")},
    **{
        spelled: Unit("torque", 1.0, spelled.replace(" ", ""))
        for spelled in ("Nm", "mNm", "N m", "mN m", "Ncm")
    },
    **{spelled: Unit("angle", 1.0, "deg") for spelled in ("deg", "°", "rad", "turn")},
    **{spelled: Unit("temperature", 1.0, "C") for spelled in ("°C", "C", "degC", "deg C", "Grad C", "ºC")},
    **{spelled: Unit("share", 1.0, "pct") for spelled in ("%", "pct", "percent", "prozent", "Prozent")},
    "bar": Unit("pressure", 1.0, "bar"),
    "mbar": Unit("pressure", 1e-3, "mbar"),
    "kPa": Unit("pressure", 1e-2, "kPa"),
    "MPa": Unit("stress", 1.0, "MPa"),
    **{spelled: Unit("none", 1.0, spelled) for spelled in ("V", "mV", "A", "Hz", "mV/V", "mm/mm")},
    **{spelled: Unit("none", 1.0, "1") for spelled in ("-", "1", "segments", "counts", "cycles")},
}
_BY_LOWER = {spelled.lower(): unit for spelled, unit in reversed(UNITS.items())}


def unit_of(text: str) -> Unit | None:
    """Return the unit that a text is, brackets around it or not; None if it is none that is known.

    Examples
    --------
    >>> unit_of("[kN]").factor, unit_of("Sec").name, unit_of("(µm)").name, unit_of("Weg")
    (1000.0, 's', 'um', None)
    """
    bare = text.strip().strip("[]()<>{}").strip()
    return UNITS.get(bare) or _BY_LOWER.get(bare.lower())


_NAME_AND_UNIT = (
    re.compile(r"^(?P<name>.+?)\s*[\[(<](?P<unit>[^\])>]*)[\])>]\s*$"),
    re.compile(r"^(?P<name>.+?)\s*/\s*(?P<unit>\S+)$"),
    re.compile(r"^(?P<name>.+?)\s+in\s+(?P<unit>\S+)$"),
    re.compile(r"^(?P<name>.+?)[_,]\s*(?P<unit>[^_,\s]+(?:_(?:s|min))?)$"),
    re.compile(r"^(?P<name>.+?)\s+(?P<unit>\S+)$"),
)


def name_and_unit(text: str) -> tuple[str, Unit | None]:
    """Return a column's name without its unit, and the unit, None if it has none.

    Examples
    --------
    >>> name_and_unit("Weg [mm]")[0], name_and_unit("t/s")[1].name, name_and_unit("Kraft in kN")[1].name
    ('Weg', 's', 'kN')
    >>> name_and_unit("Speed_mm_s")[1].name, name_and_unit("Reibkraft")
    ('mm_s', ('Reibkraft', None))
    """
    for pattern in _NAME_AND_UNIT:
        if match := pattern.match(text.strip()):
            unit = unit_of(match["unit"]) or unit_of(match["unit"].replace("_", "/"))
            if unit is None and match["name"].endswith("_mm") and match["unit"] in ("s", "min"):
                unit = unit_of(f"mm/{match['unit']}")
            if unit is not None:
                return match["name"].strip(" _,:"), unit
    return text.strip(), None


# ---------------------------------------------------------------- words
# What a column holds, by its name: the first row that fits decides, so `Reibungszahl` is no force.

STRONG, WEAK = 3, 1  # a word that says it, a single letter that may

_UMLAUTS = str.maketrans({"ä": "ae", "ö": "oe", "ü": "ue", "ß": "ss"})
_COLUMN_WORDS = (
    ("none", r"\bcof\b|\bmue?\b|coefficient|reibwert|reibungszahl|reibzahl|\bindex\b|\bscan\b|\bsample\b"
             r"|\bnr\b|\bno\b|count|segment|cycle|zyklus|comment|kommentar|alarm"
             r"|\bsoll|set ?point|command|target|demand|stress|strain|spannung|dehnung|volt|\braw\b"),
    ("temperature", r"temp"),
    ("humidity", r"humid|feucht"),
    ("pressure", r"pressure|druck(?!kraft)"),
    ("time", r"time|zeit|x.?value|elapsed|sekunde"),
    ("load", r"normal|\bfz\b|\bfn\b|anpress|auflast|andruck|vertical"),
    ("speed", r"speed|velocity|geschwind|\bvel\b"),
    ("torque", r"torque|moment"),
    ("force", r"force|kraft|friction|reib|tangential|load.?cell|kmd|\bfx\b|\bft\b|\bfr\b|\bfy\b|\bload\b"),
    ("displacement", r"displace|position|extension|crosshead|weg|verschieb|travel|traverse|\bhub\b|stroke"
                     r"|lvdt|verfahr|\bpos\b|path|distance|auslenk|slide|schlitten"),
)  # fmt: skip
_LETTERS = {
    "t": "time",
    "x": "displacement",
    "y": "displacement",
    "s": "displacement",
    "f": "force",
    "v": "speed",
}


def plain(text: str) -> str:
    """Return a name in small letters, umlauts spelled out, words apart.

    Examples
    --------
    >>> plain("Prüfzeit_1"), plain("FileName")
    ('pruefzeit 1', 'file name')
    """
    apart = re.sub(r"(?<=[a-zäöü])(?=[A-Z])", " ", text)
    return re.sub(r"[^a-z0-9%]+", " ", apart.lower().translate(_UMLAUTS)).strip()


def column_role(name: str) -> tuple[str, int]:
    """Return what a trace column of this name holds and how sure the name is: ("", 0) if it does not say.

    Examples
    --------
    >>> column_role("Traversenweg"), column_role("F"), column_role("COF"), column_role("MX440B_CH 1")
    (('displacement', 3), ('force', 1), ('none', 3), ('', 0))
    """
    words = plain(name)
    for role, pattern in _COLUMN_WORDS:
        if re.search(pattern, words):
            return role, STRONG
    return (_LETTERS[words], WEAK) if words in _LETTERS else ("", 0)


# Columns of a table of runs, and keys of header lines.
_SETTING_WORDS = (
    ("file", r"\bfile|datei"),
    ("started_at", r"\bstart|date\b|datum|begin|timestamp|zeitstempel|uhrzeit"),
    ("temperature_C", r"^temp|(aging|ageing|alterungs?|auslagerungs?|lager|ofen|oven) ?temp|temp.*aging"),
    ("aging_days", r"aging|ageing|\bage\b|alter|auslager|lager|\bdays?\b|\btage?\b"),
    ("compression_ratio_pct", r"compress|verpress|stauch|height|hoehe"),
    ("speed_mm_s", r"speed|velocity|geschwind|vorschub|feed"),
    ("load_N", r"load\b|normal|auflast|\blast\b|anpress"),
    ("repeat", r"\brep|wiederhol|\bwdh"),
    ("specimen_id", r"specimen|probe\b|sample|pruefling|muster"),
    ("rubber", r"material|rubber|gummi|compound|werkstoff|mischung|elastomer"),
    ("run_id", r"\brun|versuch"),
)


def setting(name: str) -> str:
    """Return our name of a column of a table of runs, or of a header line; "" if its name does not say.

    Examples
    --------
    >>> setting("Alterungstage"), setting("Alterungstemperatur"), setting("FileName"), setting("Operator")
    ('aging_days', 'temperature_C', 'file', '')
    """
    words = plain(name)
    return next((ours for ours, pattern in _SETTING_WORDS if re.search(pattern, words)), "")


# ---------------------------------------------------------------- parts of file names
# What stands before or after a number in a file name. The case of single letters matters: T80 is a
# temperature.

BEFORE = {
    **dict.fromkeys(("T", "temp", "temperature", "temperatur"), "temperature_C"),
    **dict.fromkeys(
        ("C", "K", "comp", "compr", "compression", "verpressung", "H", "height"), "compression_ratio_pct"
    ),
    **dict.fromkeys(("d", "D", "t", "day", "days", "tag", "tage", "age", "aged", "alter"), "aging_days"),
    **dict.fromkeys(("v", "V", "speed", "vel", "velocity", "geschw"), "speed_mm_s"),
    **dict.fromkeys(
        ("r", "R", "rep", "repeat", "run", "w", "W", "wdh", "wiederholung", "test", "trial"), "repeat"
    ),
    **dict.fromkeys(("F", "FN", "Fn", "L", "N", "load", "last"), "load_N"),
    **dict.fromkeys(("S", "s", "P", "sp", "spec", "specimen", "sample", "probe", "rawdata"), "specimen_id"),
}
AFTER = {
    **dict.fromkeys(("C", "degC", "°C", "grad", "deg"), ("temperature_C", 1.0)),
    **dict.fromkeys(("pct", "%", "percent", "prozent"), ("compression_ratio_pct", 1.0)),
    **dict.fromkeys(("d", "day", "days", "tag", "tage"), ("aging_days", 1.0)),
    **dict.fromkeys(("h", "hours", "std"), ("aging_days", 1.0 / 24)),
    **dict.fromkeys(("w", "wk", "weeks", "wochen"), ("aging_days", 7.0)),
    **dict.fromkeys(("mms", "mm s", "mmps", "mm/s", "mmpers"), ("speed_mm_s", 1.0)),
    **dict.fromkeys(("mmmin", "mm min", "mmpmin", "mmpermin"), ("speed_mm_s", 1.0 / 60)),
    **dict.fromkeys(("ums", "um s"), ("speed_mm_s", 1e-3)),
    **dict.fromkeys(("ipm", "inmin", "in min"), ("speed_mm_s", 25.4 / 60)),
    **dict.fromkeys(("cms",), ("speed_mm_s", 10.0)),
    **dict.fromkeys(("N",), ("load_N", 1.0)),
    **dict.fromkeys(("kg", "kgf"), ("load_N", _KGF)),
    **dict.fromkeys(("lbf", "lbs"), ("load_N", _LBF)),
    **dict.fromkeys(("bar",), ("pressure_bar", 1.0)),
    **dict.fromkeys(("rpm",), ("speed_rpm", 1.0)),
    **dict.fromkeys(("Hz",), ("frequency_Hz", 1.0)),
}
UNAGED = {
    "unaged",
    "fresh",
    "new",
    "virgin",
    "neu",
    "ungealtert",
    "frisch",
    "ref",
    "reference",
    "rt",
    "initial",
}
RUBBERS = {
    "nbr",
    "hnbr",
    "xnbr",
    "fkm",
    "ffkm",
    "epdm",
    "vmq",
    "fvmq",
    "acm",
    "aem",
    "nr",
    "sbr",
    "cr",
    "pu",
    "tpu",
    "ptfe",
}
DIRECTIONS = {
    **dict.fromkeys(("fwd", "forward", "vor", "hin", "pos", "up", "push", "cw"), 1),
    **dict.fromkeys(("bwd", "rev", "back", "backward", "rueck", "her", "neg", "down", "pull", "ccw"), -1),
}


def before_number(letters: str) -> str:
    """Return what a number after these letters is; "" if they do not say. Case counts for single letters."""
    return BEFORE.get(letters) or (BEFORE.get(letters.lower(), "") if len(letters) > 1 else "")


def after_number(letters: str) -> tuple[str, float] | None:
    """Return what a number followed by this unit is, and the factor to our unit; None if it does not say."""
    return AFTER.get(letters) or (AFTER.get(letters.lower()) if len(letters) > 1 else None)
