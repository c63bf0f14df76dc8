"""Campaigns written in the manner of other people's exports: one small generator per acquisition program.

Each generator writes trace files into a folder and returns, by file, the record that the file holds. The form
of the files (encoding, separators, header, units, names) follows what the programs write; the numbers are
simulated.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from itertools import product
from pathlib import Path

import numpy as np

START = datetime(2024, 3, 14, 9, 12, 33)


@dataclass(frozen=True)
class Record:
    """What the rig did, in s, mm and N, and how it was set."""

    time_s: np.ndarray
    displacement_mm: np.ndarray
    force_N: np.ndarray
    temperature: int
    compression: int
    days: int
    speed: float
    repeat: int
    number: int
    started: datetime
    further: dict[str, np.ndarray] = field(default_factory=dict)


Written = dict[str, Record]


def motion(
    speed: float, strokes: int = 1, rows: int = 260, travel: float = 30.0
) -> tuple[np.ndarray, np.ndarray]:
    """Return time and speed of strokes to and fro with rests, ramps and a plateau, shape (rows,)."""
    duration = travel / speed / 0.85  # the plateau and its ramps take 85 % of the time of a stroke
    step = float(f"{strokes * duration / rows:.2g}")
    time_s = step * np.arange(rows)
    stroke, phase = np.divmod(time_s / duration, 1.0)
    shape = np.interp(phase, [0.0, 0.06, 0.09, 0.91, 0.94, 1.0], [0.0, 0.0, 1.0, 1.0, 0.0, 0.0])
    return time_s, np.where(stroke >= strokes, 0.0, speed * shape * (1 - 2 * (stroke % 2)))


def record(settings: dict, number: int, strokes: int, start_mm: float) -> Record:
    """Return a record with friction that follows the motion after a pre-sliding rise of half a millimetre."""
    rng = np.random.default_rng(number)
    time_s, speed = motion(settings["speed"], strokes)
    step = time_s[1]
    displacement = start_mm + np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * step)])
    bristle, level = np.zeros(len(speed)), 0.0
    for i, v in enumerate(speed):
        level = np.sign(v) + (level - np.sign(v)) * np.exp(-abs(v) * step / 0.5) if v else level
        bristle[i] = level
    mu = 0.8 - 0.02 * np.log1p(settings["days"]) - 0.01 * np.log(settings["speed"])
    force = 50.0 * mu * bristle + rng.normal(0.0, 0.15, len(speed))
    noise = rng.normal(size=(2, len(speed)))
    further = {"temperature": 23.0 + 0.1 * noise[0], "load": 50.0 + 0.2 * noise[1]}
    started = START + timedelta(minutes=7 * number)
    return Record(time_s, displacement, force, **settings, number=number, started=started, further=further)


def records(
    temperatures=(80,), days=(1, 4, 16), speeds=(1.0, 5.0), repeats=(1, 2), strokes=1, start_mm=0.0
) -> Iterator[Record]:
    """Yield the records of a campaign, in order."""
    design = product(temperatures, days, speeds, repeats)
    for number, (temperature, day, speed, repeat) in enumerate(design, start=1):
        settings = {
            "temperature": temperature,
            "compression": 80,
            "days": day,
            "speed": speed,
            "repeat": repeat,
        }
        yield record(settings, number, strokes, start_mm)


def table(
    columns: list[np.ndarray], delimiter: str, decimals: int, comma: bool = False, quote: bool = False
) -> str:
    """Return lines of numbers."""
    mark = '"' if quote else ""
    lines = [
        delimiter.join(f"{mark}{value:.{decimals}f}{mark}" for value in row)
        for row in zip(*columns, strict=True)
    ]
    text = "\n".join(lines) + "\n"
    return text.replace(".", ",") if comma else text


def write(folder: Path, file: str, text: str, encoding: str = "utf-8", newline: str = "\n") -> None:
    """Write a file, and its folders."""
    path = folder / file
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(text.replace("\n", newline).encode(encoding))


def slots(one: Record) -> list[np.ndarray]:
    return [one.time_s, one.displacement_mm, one.force_N]


# ---------------------------------------------------------------- the three conventions of the issue


def german_daq(folder: Path, dates: str = "header") -> Written:
    """84 files, Latin-1, decimal comma, header of six lines; dates in the header, or in the names."""
    written = {}
    for one in records(days=(0, 1, 2, 4, 8, 16, 32), speeds=(0.5, 1.0, 5.0, 10.0), repeats=(1, 2, 3)):
        day = f"{one.started:%Y%m%d_%H%M%S}_" if dates == "names" else ""
        speed = f"{one.speed:g}".replace(".", ",")
        file = f"{day}NBR_{one.temperature}C_{one.compression}pct_{one.days}d_{speed}mms_{one.repeat}.txt"
        date = (
            f"Datum:;{one.started:%d.%m.%Y}\nUhrzeit:;{one.started:%H:%M:%S}\n"
            if dates == "header"
            else "\n\n"
        )
        head = f"Messprotokoll Reibprüfstand\n{date}Prüfer:;Müller\nNormalkraft:;50,0;N\n\n"
        names = "Zeit;Weg;Reibkraft;Temperatur\ns;mm;N;°C\n"
        body = table([*slots(one), one.further["temperature"]], ";", 4, comma=True)
        write(folder, file, head + names + body, "latin-1", "\r\n")
        written[file] = one
    return written


def nested(folder: Path) -> Written:
    """Folders of temperature and compression; `T80_C20_d4_v5_r2.txt`: compressed by 20 %."""
    written = {}
    for one in records(temperatures=(60, 80)):
        file = f"T{one.temperature}/C20/T{one.temperature}_C20_d{one.days}_v{one.speed:g}_r{one.repeat}.txt"
        write(folder, file, "t/s\tx/mm\tF/N\n" + table(slots(one), "\t", 4))
        written[file] = one
    return written


# ---------------------------------------------------------------- programs


def labview(folder: Path) -> Written:
    """LabVIEW measurement file: two headers, units in a line of the second one."""
    written = {}
    for one in records():
        file = f"T{one.temperature}_{one.compression}pct_{one.days}d_v{one.speed:g}_{one.repeat:03d}.lvm"
        day, hour = f"{one.started:%Y/%m/%d}", f"{one.started:%H:%M:%S}.9389457702636719"
        head = (
            "LabVIEW Measurement\t\nWriter_Version\t2\nReader_Version\t2\n"
            "Separator\tTab\nDecimal_Separator\t.\n"
            "Multi_Headings\tNo\nX_Columns\tOne\nTime_Pref\tRelative\nOperator\tlab\n"
            f"Date\t{day}\nTime\t{hour}\n***End_of_Header***\t\n\t\n"
            f"Channels\t2\t\nSamples\t260\t260\t\nDate\t{day}\t{day}\nTime\t{hour}\t{hour}\n"
            "Y_Unit_Label\tmm\tN\n"
            "X_Dimension\tTime\tTime\nX0\t0.0000000000000000E+0\t0.0000000000000000E+0\n"
            "Delta_X\t0.010000\t0.010000\n"
            "***End_of_Header***\t\t\nX_Value\tPosition\tFriction\tComment\n"
        )
        write(folder, file, head + table(slots(one), "\t", 6), newline="\r\n")
        written[file] = one
    return written


def catman(folder: Path) -> Written:
    """Catman ASCII: five lines for each channel above the data, names first."""
    written = {}
    for one in records():
        file = (
            f"Reibversuch_T{one.temperature}_H{one.compression}_Tag{one.days}_"
            f"{one.speed:g}mms_W{one.repeat}.ASC"
        )
        head = (
            f"HBM catmanEasy\nDatei: {file}\nStart: {one.started:%d.%m.%Y %H:%M:%S}\n"
            "Zeit  1 - Standardmessrate\tWegaufnehmer\tKraftaufnehmer\ns\tmm\tN\n"
            "\tMX440B_CH 1\tMX440B_CH 2\n50 Hz\t50 Hz\t50 Hz\n\tSkalierung 4,02\tSkalierung 10,11\n"
        )
        write(folder, file, head + table(slots(one), "\t", 5, comma=True), "cp1252", "\r\n")
        written[file] = one
    return written


def dasylab(folder: Path) -> Written:
    """DASYLab: data lines and the names end in a separator; strokes to and fro, force of the other sign."""
    written = {}
    for one in records(strokes=4):
        file = f"Alterung {one.days} Tage/{one.temperature} Grad/v={one.speed:g} mm_s Wdh {one.repeat}.asc"
        head = (
            f"DASYLab - V 13.00.00\nSchaltbild: reibung.dsb\nAufzeichnung vom {one.started:%d.%m.%Y} "
            f"{one.started:%H:%M:%S}\nBlockgröße: 64\nAbtastintervall: 0,02 s\n"
            "Messzeit [s];Position [mm];Querkraft [N];\n"
        )
        body = table([one.time_s, one.displacement_mm, -one.force_N], ";", 4, comma=True).replace("\n", ";\n")
        write(folder, file, head + body, "cp1252", "\r\n")
        written[file] = one
    return written


def hbm(folder: Path) -> Written:
    """HBM amplifier: UTF-16, tabs, force in kN and way in µm, time in ms."""
    written = {}
    for one in records():
        file = f"{one.days}d_{one.temperature}C_{one.compression}pct_{one.speed:g}mms_rep{one.repeat}.txt"
        head = "Time (ms)\tDisplacement (µm)\tForce (kN)\n"
        body = table([one.time_s * 1e3, one.displacement_mm * 1e3, one.force_N / 1e3], "\t", 6)
        write(folder, file, head + body, "utf-16", "\r\n")
        written[file] = one
    return written


def instron(folder: Path) -> Written:
    """Instron Bluehill: a table of results above the raw data, every cell in quotes, a folder per sample."""
    written = {}
    for one in records():
        sample = (
            f"{one.temperature}C_{one.compression}pct_{one.days}d_{one.speed * 60:g}mmmin.is_tens_RawData"
        )
        file = f"{sample}/Specimen_RawData_{one.repeat}.csv"
        head = (
            f'"Results Table 1"\n"","Maximum Load","Extension at Maximum Load"\n"","(N)","(mm)"\n'
            f'"{one.repeat}","{one.force_N.max():.5f}","{one.displacement_mm[one.force_N.argmax()]:.5f}"\n\n'
            '"Time","Extension","Load"\n"(s)","(mm)","(N)"\n'
        )
        write(folder, file, head + table(slots(one), ",", 5, quote=True), newline="\r\n")
        written[file] = one
    return written


def zwick(folder: Path) -> Written:
    """Zwick testXpert: names and units in quotes, force before way."""
    written = {}
    for one in records():
        file = (
            f"NBR70/{one.temperature}C/{one.compression}%/"
            f"Probe{one.repeat}_{one.days}Tage_{one.speed * 60:g}mmmin.TRA"
        )
        head = '"Prüfzeit";"Standardkraft";"Traversenweg"\n"s";"N";"mm"\n'
        body = table([one.time_s, one.force_N, one.displacement_mm], ";", 4, comma=True)
        write(folder, file, head + body, "latin-1", "\r\n")
        written[file] = one
    return written


def mts(folder: Path) -> Written:
    """MTS: a line of codes, lines about the acquisition of a length that differs, times as AM and PM."""
    written = {}
    for one in records():
        file = f"aged_{one.days}d_{one.temperature}C/speed_{one.speed:g}/test{one.repeat}/specimen.dat"
        note = "Operator Note: repeated\n" if one.repeat == 2 else ""
        head = (
            "MTS793|MPT|ENU|1|2|.|/|:|1|0|0|A\n\n"
            f"Data Header:\tTime:\t12.52\tSec\t{one.started:%m/%d/%Y %I:%M:%S %p}\n{note}"
            "Data Acquisition:\tTimed\nStation Name:\tfriction.cfg\n"
            "Running Time\tAxial Displacement\tAxial Force\tAxial Count\nSec\tmm\tN\tsegments\n"
        )
        count = np.full(len(one.time_s), 2.0)
        write(folder, file, head + table([*slots(one), count], "\t", 5))
        written[file] = one
    return written


def tribometer(folder: Path) -> Written:
    """UMT: to and fro, friction Fx, normal force Fz counted downwards, their ratio."""
    written = {}
    for one in records(strokes=4):
        file = f"EPDM_{one.temperature}C_{one.compression}pct_{one.days}d_{one.speed:g}mms_{one.repeat}.csv"
        head = "Time,Fx,Fz,COF,Y-Position\nsec,N,N,,mm\n"
        load = one.further["load"]
        columns = [one.time_s, one.force_N, -load, np.abs(one.force_N) / load, one.displacement_mm]
        write(folder, file, head + table(columns, ",", 5))
        written[file] = one
    return written


def benchvue(folder: Path) -> Written:
    """Keysight BenchVue: what was connected, then a number and a time of day beside the elapsed time."""
    written = {}
    for one in records():
        file = (
            f"DAQ970A_{one.temperature}C_{one.compression}pct_{one.days}days_"
            f"{one.speed:g}mmps_run{one.repeat}.csv"
        )
        head = (
            f"Instrument,DAQ970A\nSerial Number,MY58001234\nStart Time,{one.started:%m/%d/%Y %H:%M:%S}\n"
            "Sweep Interval,0.02\n\nScan,Timestamp,Elapsed Time (s),Position (mm),Friction Force (N)\n"
        )
        lines = []
        for number, row in enumerate(zip(*slots(one), strict=True), start=1):
            clock = one.started + timedelta(seconds=float(row[0]))
            lines.append(
                f"{number},{clock:%m/%d/%Y %H:%M:%S.%f}," + ",".join(f"{value:.5f}" for value in row)
            )
        write(folder, file, head + "\n".join(lines) + "\n", newline="\r\n")
        written[file] = one
    return written


def matlab(folder: Path) -> Written:
    """MATLAB writetable, numbered files, and a table of the runs under a name of its own."""
    written, rows = {}, []
    for one in records():
        file = f"run_{one.number:03d}.csv"
        body = "\n".join(",".join(f"{value:.15g}" for value in row) for row in zip(*slots(one), strict=True))
        write(folder, file, f"Time_s,Pos_mm,Force_N\n{body}\n")
        rows.append(
            f"{file},{one.temperature},{one.compression},{one.days},{one.speed:g},{one.repeat},{one.started}"
        )
        written[file] = one
    head = "FileName,Temp_C,Height_pct,AgingTime_d,Speed_mm_s,Rep,StartTime"
    write(folder, "testplan.csv", "\n".join([head, *rows]) + "\n")
    return written


def excel_german(folder: Path) -> Written:
    """Excel in German: byte-order mark, semicolons, empty columns and lines, runs.csv with German names."""
    written, rows = {}, []
    for one in records():
        file = f"Messung {one.number}.csv"
        head = "Reibversuch;;;;\n;;;;\nZeit in s;Verfahrweg in mm;Reibkraft in N;;\n"
        body = table(slots(one), ";", 3, comma=True).replace("\n", ";;\n")
        write(folder, file, head + body + ";;;;\n", "utf-8-sig", "\r\n")
        start = f"{one.started:%Y-%m-%d %H:%M:%S}"
        rows.append(
            f"{file};{one.temperature};{one.compression};{one.days};{one.speed:g};{one.repeat};50,0;{start}"
        )
        written[file] = one
    head = (
        "Datei;Temperatur;Verpressung auf %;Alterungstage;Geschwindigkeit;Wiederholung;Normalkraft;Startzeit"
    )
    write(
        folder,
        "runs.csv",
        "\n".join([head, *rows]).replace(".", ",").replace(",csv", ".csv"),
        "utf-8-sig",
        "\r\n",
    )
    return written


def excel_us(folder: Path) -> Written:
    """Excel in the US: inches, pounds, inches per minute in the name, a mean below the data."""
    written = {}
    for one in records():
        speed = f"{one.speed * 60 / 25.4:.4f}"
        file = f"{one.days} days/{one.temperature}degC {one.compression}pct {speed}ipm rep {one.repeat}.csv"
        columns = [one.time_s, one.displacement_mm / 25.4, one.force_N / 4.4482216152605]
        head = "Elapsed Time [sec],Crosshead [in],Load Cell [lbf]\n"
        mean = f"Average,,{columns[2].mean():.6f}\n"
        write(folder, file, head + table(columns, ",", 6) + "\n" + mean, newline="\r\n")
        written[file] = one
    return written


def tdms(folder: Path) -> Written:
    """LabVIEW's TDMS: channels with units and the increment of a waveform, settings as properties."""
    written = {}
    for one in records():
        settings = {
            "aging_days": float(one.days),
            "oven_C": float(one.temperature),
            "height_pct": float(one.compression),
            "speed_mm_s": one.speed,
            "repeat": one.repeat,
        }
        file = f"log_{one.number:03d}.tdms"
        write_tdms(folder / file, one, settings)
        written[file] = one
    return written


def tdms_and_log(folder: Path) -> Written:
    """LabVIEW's TDMS in a folder, and a log in Excel that names the tests without folder and suffix."""
    import openpyxl

    log, written = openpyxl.Workbook(), {}
    log.active.append(
        ("Messung", "Ofentemperatur [°C]", "Höhe [%]", "Alterung [h]", "Geschwindigkeit", "Wdh")
    )
    for one in records():
        name = f"Messung_{one.number:03d}"
        file = f"Rohdaten/{name}.tdms"
        (folder / "Rohdaten").mkdir(exist_ok=True)
        write_tdms(folder / file, one, {"operator": "A"})
        (folder / f"{file}_index").write_bytes(b"TDSh")
        log.active.append((name, one.temperature, one.compression, 24 * one.days, one.speed, one.repeat))
        written[file] = one
    log.save(folder / "Protokoll.xlsx")
    return written


def write_tdms(path: Path, one: Record, properties: dict) -> None:
    """Write a record as a TDMS file with these properties."""
    from nptdms import ChannelObject, RootObject, TdmsWriter

    wave = {"wf_increment": float(one.time_s[1]), "wf_start_offset": 0.0}
    channels = [
        ChannelObject("Messung", name, values, {**wave, "unit_string": unit})
        for name, unit, values in (("Weg", "mm", one.displacement_mm), ("Kraft", "N", one.force_N))
    ]
    with TdmsWriter(str(path)) as writer:
        writer.write_segment([RootObject(properties), *channels])


def matlab_structs(folder: Path) -> Written:
    """MATLAB's save of a struct in each file, and a log kept in Excel, aging in hours."""
    import openpyxl
    from scipy.io import savemat

    book, written = openpyxl.Workbook(), {}
    book.active.append(
        ("Trace file", "Date", "Oven temp (°C)", "Height (%)", "Aged (h)", "Speed (mm/s)", "Rep")
    )
    for one in records():
        file = f"test{one.number:03d}.mat"
        data = dict(zip(("Time_s", "Pos_mm", "Fx_N"), slots(one), strict=True))
        savemat(folder / file, {"data": data, "operator": "MK"})
        settings = (one.temperature, one.compression, 24 * one.days, one.speed, one.repeat)
        book.active.append((file, one.started, *settings))
        written[file] = one
    book.save(folder / "Testlog.xlsx")
    return written


def parquet(folder: Path) -> Written:
    """Parquet tables of a script, with the settings in the names of the files."""
    import pandas as pd

    written = {}
    for one in records():
        file = f"T{one.temperature}_C{one.compression}_d{one.days}_v{one.speed:g}_r{one.repeat}.parquet"
        columns = zip(("time [s]", "position [mm]", "friction force [N]"), slots(one), strict=True)
        pd.DataFrame(dict(columns)).to_parquet(folder / file)
        written[file] = one
    return written


def workbooks(folder: Path) -> Written:
    """Excel workbooks, one a test, with a title and units above the data, and a log beside them."""
    import openpyxl

    written, log = {}, openpyxl.Workbook()
    log.active.append(("File", "Temperature [degF]", "Height [%]", "Aging [h]", "Speed [mm/s]", "Repeat"))
    for one in records():
        file, book = f"traces/test{one.number:02d}.xlsx", openpyxl.Workbook()
        for row in (("Friction test",), (), ("Time", "Position", "Friction force"), ("s", "mm", "N")):
            book.active.append(row)
        for row in zip(*slots(one), strict=True):
            book.active.append([float(value) for value in row])
        (folder / "traces").mkdir(exist_ok=True)
        book.save(folder / file)
        settings = (1.8 * one.temperature + 32, one.compression, 24 * one.days, one.speed, one.repeat)
        log.active.append((file, *settings))
        written[file] = one
    log.save(folder / "log.xlsx")
    return written


EXPORTS: dict[str, Callable[[Path], Written]] = {
    made.__name__: made
    for made in (
        german_daq, nested, labview, catman, dasylab, hbm, instron, zwick, mts, tribometer, benchvue, matlab,
        excel_german, excel_us, tdms, tdms_and_log, matlab_structs, parquet, workbooks,
    )
}  # fmt: skip
