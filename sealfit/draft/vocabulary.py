"""What columns, parts of file names and header lines are called, and their units.

The words are English and German, and the usual French, Italian and Spanish ones.
"""

import re
import unicodedata
from collections.abc import Mapping

from sealfit.units import Unit, unit_of

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
    >>> name_and_unit("Weg [mm]")[0], name_and_unit("t/s")[1].name, name_and_unit("Speed_mm_s")[1].name
    ('Weg', 's', 'mm/s')
    >>> name_and_unit("Kraft in kN")[1].name, name_and_unit("Weeks")[1].name, name_and_unit("Reibkraft")
    ('kN', 'week', ('Reibkraft', None))
    """
    for pattern in _NAME_AND_UNIT:
        if match := pattern.match(text.strip()):
            unit = unit_of(match["unit"]) or unit_of(match["unit"].replace("_", "/"))
            name = match["name"].strip(" _,:")
            bare = match["unit"] in ("F", "K") and setting(name) != "temperature_C"  # Kraft F, Karte K
            if unit is not None and not bare:
                return name, unit
    return text.strip(), unit_of(text) if setting(text) == "aging_days" else None


STRONG, WEAK = 3, 1  # a word that says it, a single letter that may
_UMLAUTS = str.maketrans({"ä": "ae", "ö": "oe", "ü": "ue", "ß": "ss"})
# What a column holds, by its name: the first row that fits decides, so `Reibungszahl` is no force.
_COLUMN_WORDS = (
    ("coefficient", r"\bcof\b|\bmue?\b|coefficient|reibwert|reibungszahl|reibzahl"),
    ("none", r"\bindex\b|\bscan\b|\bsample\b|\bnr\b|\bno\b|count|segment|cycle|zyklus|comment|kommentar|alarm"
             r"|\bsoll|set ?point|command|target|demand|stress|strain|spannung|dehnung|volt|\braw\b"),
    ("temperature", r"temp(?!s\b|o\b)"),
    ("humidity", r"humid|feucht"),
    ("pressure", r"pressure|druck(?!kraft)"),
    ("time", r"time|zeit|x.?value|elapsed|sekunde|temps\b|tempo\b|tiempo|tijd"),
    ("load", r"normal|\bfz\b|\bfn\b|anpress|auflast|andruck|vertical"),
    ("speed", r"speed|velocity|geschwind|\bvel\b|drehzahl|vitesse|velocit|velocid"),
    ("torque", r"torque|moment"),
    ("force", r"force|kraft|friction|reib|tangential|load.?cell|effort|forza|fuerza|kracht"
              r"|kmd|\bfx\b|\bft\b|\bfr\b|\bfy\b|\bload\b"),
    ("displacement", r"displace|deplace|spostam|desplaz|verplaats|position|extension|crosshead|weg|verschieb"
                     r"|travel|traverse|\bhub\b|stroke|lvdt|verfahr|\bpos\b|path|distance|auslenk|slide|schlitten"
                     r"|angle|winkel|rotation|revolution|umdrehung"),
)  # fmt: skip
_LETTERS = {"t": "time", "f": "force", "v": "speed", **dict.fromkeys("xys", "displacement")}


def plain(text: str) -> str:
    """Return a name in small letters, umlauts spelled out, accents left out, words apart.

    Examples
    --------
    >>> plain("Prüfzeit_1"), plain("FileName"), plain("Déplacement")
    ('pruefzeit 1', 'file name', 'deplacement')
    """
    apart = re.sub(r"(?<=[a-zäöü])(?=[A-Z])", " ", text)
    letters = unicodedata.normalize("NFKD", apart.lower().translate(_UMLAUTS))
    return re.sub(r"[^a-z0-9%]+", " ", re.sub(r"[\u0300-\u036f]", "", letters)).strip()


def column_role(name: str) -> tuple[str, int]:
    """Return what a trace column of this name holds and how sure the name is: ("", 0) if it does not say.

    Examples
    --------
    >>> column_role("Traversenweg"), column_role("F"), column_role("COF"), column_role("MX440B_CH 1")
    (('displacement', 3), ('force', 1), ('coefficient', 3), ('', 0))
    """
    words = plain(name)
    for role, pattern in _COLUMN_WORDS:
        if re.search(pattern, words):
            return role, STRONG
    return (_LETTERS[words], WEAK) if words in _LETTERS else ("", 0)


# Columns of a table of runs, and keys of header lines.
_SETTING_WORDS = (
    ("file", r"\bfile|datei|archivo|fichier"),
    ("started_at", r"\bstart|date\b|datum|fecha|begin|timestamp|zeitstempel|uhrzeit"),
    ("temperature_C", r"^temp|^oven$|^ofen$|temp.*aging"
                      r"|(aging|ageing|alterungs?|(aus)?lager(ungs?)?|ofen|oven) ?temp"),
    ("aging_days", r"aging|ageing|\baged?\b|alter|auslager|lager"
                   r"|\b(days?|tage?|dias|jours|giorni|dagen|weeks?|wochen?|semaines|months?|monate?|years?|jahre?)\b"),
    ("compression_ratio_pct", r"compres|verpress|verform|stauch|height|hoehe"),
    ("speed_mm_s", r"speed|velocit|velocid|vitesse|snelheid|geschwind|vorschub|feed"),
    ("load_N", r"load\b|normal|auflast|\blast\b|anpress|carga|^(dead )?weights?$|^gewichte?$"),
    ("repeat", r"\brep|wiederhol|\bwdh|herhal"),
    ("specimen_id", r"specimen|probe\b|sample|pruefling|muster"),
    ("rubber", r"material|rubber|gummi|compound|werkstoff|mischung|elastomer"),
    ("run_id", r"\brun|versuch"),
)  # fmt: skip


def setting(name: str) -> str:
    """Return our name of a column of a table of runs, or of a header line; "" if its name does not say.

    Examples
    --------
    >>> setting("Alterungstage"), setting("Alterungstemperatur"), setting("FileName"), setting("Operator")
    ('aging_days', 'temperature_C', 'file', '')
    """
    words = plain(name)
    return next((ours for ours, pattern in _SETTING_WORDS if re.search(pattern, words)), "")


def _by_word(said: Mapping) -> dict:
    return {word: meaning for meaning, words in said.items() for word in words.split()}


# What stands before or after a number in a file name, by our column, or by it and the unit, "" for ours.
BEFORE = _by_word({
    "temperature_C": "T temp temperature temperatur",
    "compression_ratio_pct": "C K comp compr compression verpressung H height",
    "aging_days": "d D t day days tag tage age aged alter j",
    "speed_mm_s": "v V speed vel velocity geschw",
    "repeat": "r R rep repeat run w W wdh wiederholung test trial essai prova ensayo rip herhaling",
    "load_N": "F FN Fn L N load last",
    "specimen_id": "S s P sp spec specimen sample probe rawdata",
})  # fmt: skip
AFTER = _by_word({
    ("temperature_C", ""): "C degC °C grad deg gradi grados graden",
    ("temperature_C", "degF"): "F degF °F",
    ("compression_ratio_pct", ""): "pct % percent prozent",
    ("aging_days", ""): "d day days tag tage j jours giorni dias días dagen",
    ("aging_days", "h"): "h hr hrs hours std",
    ("aging_days", "week"): "w wk week weeks woche wochen",
    ("aging_days", "month"): "mo month months monat monate",
    ("aging_days", "year"): "y yr yrs year years jahr jahre",
    ("speed_mm_s", ""): "mms mmps mmpers",
    ("speed_mm_s", "mm/min"): "mmmin mmpmin mmpermin",
    ("speed_mm_s", "um/s"): "ums",
    ("speed_mm_s", "in/min"): "ipm inmin inpmin inpermin",
    ("speed_mm_s", "cm/s"): "cms",
    ("load_N", ""): "N",
    ("load_N", "kN"): "kN",
    ("load_N", "mN"): "mN",
    ("load_N", "kgf"): "kg kgf",
    ("load_N", "gf"): "g gf",
    ("load_N", "lbf"): "lbf lbs lb",
    ("pressure_bar", ""): "bar",
    ("speed_rpm", ""): "rpm",
    ("frequency_Hz", ""): "Hz",
})  # fmt: skip
RUBBERS = {
    "nbr", "hnbr", "xnbr", "fkm", "ffkm", "epdm", "vmq", "fvmq", "acm", "aem", "nr", "sbr", "cr", "pu", "tpu",
    "ptfe",
}  # fmt: skip
DIRECTIONS = _by_word({
    1.0: "fwd forward vor vorwaerts vorwärts hin pos up push cw",
    -1.0: "bwd rev back backward her neg down pull ccw zurueck zurück rueck rück rueckwaerts rückwärts",
})  # fmt: skip


def said_by(table: Mapping, letters: str):
    """Return what letters beside a number say by `BEFORE` or `AFTER`, or None; case counts for one letter."""
    return table.get(letters) or (table.get(letters.lower()) if len(letters) > 1 else None)
