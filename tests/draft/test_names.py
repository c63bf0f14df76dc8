"""What names of files and folders say."""

import pytest

from sealfit.draft.file_names import read_names
from sealfit.draft.run_keys import values_by_file


def told(files, which=0):
    return values_by_file(read_names(files), files)[files[which]]


def made(template, **values):
    """Return names for two values of each part."""
    names = [template]
    for key, (one, other) in values.items():
        names = [name.replace("{" + key + "}", str(value)) for name in names for value in (one, other)]
    return names


AGED = {"temperature_C": 60.0, "aging_days": 4.0, "speed_mm_s": 5.0, "repeat": 1.0}


@pytest.mark.parametrize(
    ("template", "expected"),
    [
        ("T{T}_d{d}_v{v}_r{r}.txt", AGED),
        ("T{T}d{d}v{v}r{r}.csv", AGED),
        ("{T}C_{d}d_{v}mms_rep{r}.csv", AGED),
        ("{T}C {d}d {v}mm_s ({r}).csv", AGED),
        ("{d}d/{T}C/v{v}/run{r}.dat", AGED),
        ("Temp{T}-Tag{d}-V{v}-Wdh{r}.asc", AGED),
        ("{T} Grad/{d} Tage/v={v} mm_s Wdh {r}.txt", AGED),
        ("temp_{T}_days_{d}_speed_{v}_rep_{r}.csv", AGED),
        ("{T}degC/{d}days/{v}mmps_{r}.csv", AGED),
        ("T{T}/{d}d/T{T}_{d}d_{v}mms_{r}.csv", AGED),
        ("T{T}_j{d}_V{v}_essai{r}.csv", AGED),
        ("{T}gradi_{d}giorni_{v}mm-s_rip{r}.csv", AGED),
        ("{T}grados_{d}días_{v}mmps_ensayo{r}.csv", AGED),
        ("{T}graden/{d}dagen/snelheid{v}mms_herhaling{r}.txt", AGED),
    ],
)
def test_a_way_of_naming_files_is_read(template, expected):
    files = made(template, T=(60, 80), d=(4, 16), v=(5, 10), r=(1, 2))
    assert told(files) == expected


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        (made("{h}h_v{v}.csv", h=(96, 24), v=(1, 2)), {"aging_days": 4.0, "speed_mm_s": 1.0}),
        (
            made("{h}hr_{T}F_{v}inpermin.csv", h=(96, 24), T=(140, 176), v=(60, 120)),
            {"aging_days": 4.0, "temperature_C": 60.0, "speed_mm_s": 25.4},
        ),
        (made("essai_{j}j_{N}kN.asc", j=(4, 8), N=(0.1, 0.2)), {"aging_days": 4.0, "load_N": 100.0}),
        (made("{w}weeks_v{v}.csv", w=(2, 4), v=(1, 2)), {"aging_days": 14.0, "speed_mm_s": 1.0}),
        (["RT_0d_v1.csv", "70C_7d_v1.csv", "70C_14d_v1.csv"], {"aging_days": 0.0, "speed_mm_s": 1.0}),
        (["4 weeks 5mms.csv", "1 week 1mms.csv"], {"aging_days": 28.0, "speed_mm_s": 5.0}),
        (made("{v}mmmin_d{d}.csv", v=(300, 60), d=(1, 2)), {"speed_mm_s": 5.0, "aging_days": 1.0}),
        (made("{N}N_d{d}.csv", N=(50, 100), d=(1, 2)), {"load_N": 50.0, "aging_days": 1.0}),
        (made("{N}kg_d{d}.csv", N=(5, 10), d=(1, 2)), {"load_N": 49.03325, "aging_days": 1.0}),
        (made("load{N}lb_d{d}.csv", N=(10, 20), d=(1, 2)), {"load_N": 44.4822, "aging_days": 1.0}),
        (made("aged{m}months_v{v}.csv", m=(1, 4), v=(1, 2)), {"aging_days": 30.4375, "speed_mm_s": 1.0}),
        (made("d{d}_v{v}.csv", d=(1, 2), v=("0,5", "5")), {"speed_mm_s": 0.5, "aging_days": 1.0}),
        (made("d{d}_v{v}.csv", d=(1, 2), v=("0p5", "5")), {"speed_mm_s": 0.5, "aging_days": 1.0}),
        (made("d{d}_v{v}.csv", d=(1, 2), v=("0.5", "5")), {"speed_mm_s": 0.5, "aging_days": 1.0}),
        (made("{T}C_d{d}.csv", T=("-20", "60"), d=(1, 2)), {"temperature_C": -20.0, "aging_days": 1.0}),
        (made("C{C}_d{d}.csv", C=(20, 25), d=(1, 2)), {"compression_ratio_pct": 80.0, "aging_days": 1.0}),
        (made("C{C}_d{d}.csv", C=(80, 75), d=(1, 2)), {"compression_ratio_pct": 80.0, "aging_days": 1.0}),
        (made("{m}_d{d}.csv", m=("NBR", "FKM"), d=(1, 2)), {"rubber": "NBR", "aging_days": 1.0}),
        (
            made("d{d}_v{v}_{w}.csv", d=(1, 2), v=(5, 10), w=("fwd", "rev")),
            {"speed_mm_s": 5.0, "aging_days": 1.0},
        ),
    ],
)
def test_units_and_signs_in_names(files, expected):
    assert told(files) == pytest.approx(expected)


def test_letters_behind_a_number_that_are_no_unit_are_a_doubt():
    (days,) = [
        part
        for part in read_names(made("aged{d}fn_v{v}.csv", d=(1, 4), v=(1, 2))).parts
        if part.ours == "aging_days"
    ]
    assert days.doubt == "'fn' behind it is no unit that is known here; d is assumed"


@pytest.mark.parametrize("words", [("fwd", "rev"), ("vor", "zurueck"), ("Hin", "Rück")])
def test_a_word_for_the_other_direction_makes_the_speed_negative(words):
    files = made("d{d}_v{v}_{w}.csv", d=(1, 2), v=(5, 10), w=words)
    assert told(files, 1)["speed_mm_s"] == -5.0


def test_a_speed_with_a_direction_and_a_unit_is_converted_once():
    files = made("d{d}_v{v}mmmin_{w}.csv", d=(1, 2), v=(300, 600), w=("fwd", "rev"))
    assert told(files, 1)["speed_mm_s"] == -5.0


def test_a_letter_before_some_numbers_is_the_other_direction():
    plain = made("{v}_d{d}.csv", v=(5, 10), d=(1, 2))
    names = read_names([*plain, *("n" + file for file in plain)])
    assert names.settings.values["_direction"] == {"": 1.0, "n": -1.0}
    assert names.unmatched == ()


@pytest.mark.parametrize(
    ("date", "iso"),
    [
        ("20240314_101233", "2024-03-14T10:12:33"),
        ("2024-03-14_10-12-33", "2024-03-14T10:12:33"),
        ("2024-03-14T10h12", "2024-03-14T10:12:00"),
        ("2024_03_14", "2024-03-14"),
        ("14.03.2024", "2024-03-14"),
    ],
)
def test_dates_in_names(date, iso):
    files = [f"{date}_d{d}_v{v}.csv" for d in (1, 2) for v in (5, 10)]
    assert told(files) == {"started_at": iso, "aging_days": 1.0, "speed_mm_s": 5.0}


def test_a_date_of_a_folder_stands_behind_that_of_the_file():
    files = [f"2024-03-1{d}/2024-03-1{d}_10-12-33_v{v}.csv" for d in (1, 2) for v in (5, 10)]
    assert told(files) == {"started_at": "2024-03-11T10:12:33", "speed_mm_s": 5.0}


@pytest.mark.parametrize("word", ["unaged", "neuf"])
def test_one_word_stands_for_rubber_that_was_not_aged(word):
    aged = made("{d}d_{T}C_{c}pct_{v}mms_r{r}.csv", d=(1, 4), T=(60, 80), c=(80, 60), v=(1, 5), r=(1, 2))
    unaged = made(word + "_{v}mms_r{r}.csv", v=(1, 5), r=(1, 2))
    names = read_names([*aged, *unaged])
    assert names.unmatched == ()
    assert told([*unaged, *aged]) == {"aging_days": 0.0, "speed_mm_s": 1.0, "repeat": 1.0}


def test_unaged_rubber_at_room_temperature_is_no_other_way_of_naming():
    unaged = made("D_23C_unaged_P{p}_v{v}.csv", p=(1, 2), v=(2, 8))
    aged = made("D_40C_2d_P{p}_v{v}.csv", p=(1, 2), v=(2, 8))
    assert read_names([*unaged, *aged]).unmatched == ()
    assert told([*unaged, *aged])["aging_days"] == 0.0


def test_a_number_that_counts_files_is_no_repeat():
    files = [f"Messung_{number:03d}_d{number % 3}.csv" for number in range(1, 10)]
    assert told(files) == {"aging_days": 1.0}


def test_names_without_an_ending_may_end_in_a_decimal():
    assert told(made("d{d}/v{v}", d=(1, 2), v=("0.5", "1.5"))) == {"aging_days": 1.0, "speed_mm_s": 0.5}


def test_names_that_only_count_say_nothing():
    assert read_names([f"run_{number:03d}.csv" for number in range(1, 10)]).settings.name_pattern is None


@pytest.mark.parametrize("letter", ["T", "C", "N"])
def test_letters_before_numbers_that_count_are_no_settings(letter):
    files = made("d{d}_v{v}_" + letter + "{r}.csv", d=(4, 16), v=(5, 10), r=(1, 2))
    assert told(files) == {"aging_days": 4.0, "speed_mm_s": 5.0, "repeat": 1.0}


def test_a_file_named_otherwise_is_listed():
    files = [*made("d{d}_v{v}_r{r}.csv", d=(1, 2), v=(5, 10), r=(1, 2)), "calibration.csv"]
    assert read_names(files).unmatched == ("calibration.csv",)


def test_a_number_without_a_meaning_is_a_doubt():
    names = read_names(made("X{x}_d{d}.csv", x=(3, 7), d=(1, 2)))
    (part,) = [part for part in names.parts if part.doubt]
    assert part.ours.startswith("part_")
    assert part.texts == ("3", "7")


def test_marks_of_patterns_in_names_are_taken_as_they_are():
    files = made("a+b [x] {d}d ({v}mms).csv", d=(1, 2), v=(5, 10))
    assert told(files) == {"aging_days": 1.0, "speed_mm_s": 5.0}
