"""The page in a browser: nothing is wider than the window, every image shows, and its script works."""

import csv
import html
import json
import re
import shutil
import subprocess
from functools import cache
from pathlib import Path

import pytest
from report.made_campaigns import HIGHER, after_campaign, aging_campaign, torque_campaign

from sealfit.report import page as report_page
from sealfit.report.page import build_report

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
BROWSER = next(filter(None, map(shutil.which, BROWSERS)), None)
# A window has a least width of 500 px, a frame in it has none; the page's own rules hold in the frame too.
FRAME = """<!doctype html><title>not measured</title><body><script>
const widths = WIDTHS, found = {};
for (const width of widths) {
  const frame = document.createElement("iframe");
  frame.style.width = width + "px";
  frame.style.height = "2000px";
  frame.style.border = "0";
  frame.onload = () => {
    const page = frame.contentDocument, root = page.documentElement;
    const inside = e => (e.closest(".box") && !e.closest(".explained")) || e.closest("pre, .drawing")
      || e.parentElement.closest("svg");
    const boxes = [...page.querySelectorAll("body *")].filter(e => !inside(e));
    const right = Math.ceil(Math.max(...boxes.map(e => e.getBoundingClientRect().right)));
    const drawings = [...page.querySelectorAll("figure svg")], all = drawings.length;
    const least = d => width > 500 ? 100 : 0.99 * d.width.baseVal.value; // as it was drawn on a small screen
    const shown = drawings.filter(d => d.getBoundingClientRect().width > least(d)).length;
    const tables = [...page.querySelectorAll(".params")];
    const cut = tables.filter(t => t.offsetWidth > t.parentElement.clientWidth);
    found[width] = [root.clientWidth, root.scrollWidth, right, shown, all, cut.length];
    if (Object.keys(found).length === widths.length) document.title = "measured " + JSON.stringify(found);
  };
  frame.srcdoc = PAGE;
  document.body.append(frame);
}
</script>"""

# Says the colours of the page, and how those of a plot are changed.
COLOURS = """<!doctype html><title>not measured</title><body><script>
const frame = document.createElement("iframe");
frame.onload = () => {
  const page = frame.contentDocument, style = e => frame.contentWindow.getComputedStyle(e);
  const body = style(page.body), plot = style(page.querySelector("figure svg"));
  document.title = "measured " + JSON.stringify([body.backgroundColor, body.color, plot.filter]);
};
frame.srcdoc = PAGE;
document.body.append(frame);
</script>"""

# Drives the page, whose own rules hold, from the page around it.
DRIVE = """<!doctype html><title>not measured</title><body><script>
const frame = document.createElement("iframe");
frame.style.width = "1200px";
frame.style.height = "2000px";
frame.onload = async () => {
  const page = frame.contentDocument, found = {};
  const text = point => point.querySelector("title").textContent;
  const click = point => {
    point.scrollIntoView({ block: "center", behavior: "instant" });
    const box = point.getBoundingClientRect();
    const at = { clientX: box.x + box.width / 2, clientY: box.y + box.height / 2, bubbles: true };
    const top = page.elementFromPoint(at.clientX, at.clientY);
    top.dispatchEvent(new frame.contentWindow.MouseEvent("click", at));
  };
  const dialog = page.querySelector("dialog"), titled = id => page.querySelectorAll(id + " use:has(title)");
  const mean = titled("#force-speed")[3];
  found.mean = text(mean);
  found.wide = mean.getBoundingClientRect().width;
  click(mean);
  found.run = dialog.querySelector("h2").textContent;
  const lines = [...dialog.querySelectorAll("path.measured")];
  found.points = lines.map(line => line.getAttribute("d").split("L").length);
  dialog.close();
  found.opened = [...titled("#force-speed")].map(point => {
    click(point);
    const head = dialog.querySelector("h2").textContent;
    dialog.close();
    return [text(point).split("\\n")[2], head];
  });
  const residual = titled("#residual")[0];
  found.residual = text(residual);
  click(residual);
  found.farthest = dialog.querySelector("h2").textContent;
  dialog.close();
  page.querySelector("#force-speed .tools button").click();
  const large = dialog.querySelector("svg"), whole = large.getBoundingClientRect();
  const wheel = { deltaY: -500, clientX: whole.x + whole.width / 2, clientY: whole.y + 20, bubbles: true };
  large.dispatchEvent(new frame.contentWindow.WheelEvent("wheel", { ...wheel, cancelable: true }));
  found.zoom = large.getBoundingClientRect().width / whole.width;
  found.scrolled = large.parentElement.scrollLeft;
  dialog.close();
  const head = page.querySelector("#parameters th.n.sorts"), table = head.closest("table");
  const column = () => [...table.tBodies[0].rows].map(row => row.cells[head.cellIndex].textContent.trim());
  head.click();
  found.rising = column();
  head.dispatchEvent(new frame.contentWindow.KeyboardEvent("keydown", { key: "Enter" }));
  found.falling = column();
  found.sort = head.getAttribute("aria-sort");
  frame.contentWindow.Blob = function (parts) { found.csv = parts.join(""); };
  frame.contentWindow.URL.createObjectURL = () => "blob:none";
  frame.contentWindow.HTMLAnchorElement.prototype.click = function () { found.name = this.download; };
  const save = id => page.querySelector(id + " .tools button + button").click();
  save("#parameters");
  found.parameters = found.csv;
  save("#errors");
  const clipboard = { writeText: async text => { found.copy = text; } };
  Object.defineProperty(frame.contentWindow.navigator, "clipboard", { get: () => clipboard });
  const copies = [...page.querySelectorAll(".tools:has(+ .box) button:first-child")].slice(0, 2);
  copies[0].click();
  clipboard.writeText = () => Promise.reject();
  copies[1].click();
  await new Promise(done => setTimeout(done));
  found.copied = copies.map(copy => copy.textContent);
  const ids = [...page.querySelectorAll("[id]")].map(e => e.id);
  found.single = new Set(ids).size === ids.length;
  document.title = "driven " + JSON.stringify(found);
};
frame.srcdoc = PAGE;
document.body.append(frame);
</script>"""

pytestmark = [
    pytest.mark.skipif(BROWSER is None, reason="no chromium on PATH"),
    pytest.mark.usefixtures("only_drawings"),
]


@pytest.mark.parametrize(
    "make", [pytest.param(aging_campaign, marks=pytest.mark.long), after_campaign, torque_campaign]
)
def test_nothing_overflows_and_every_image_is_large_enough_to_be_read(make, tmp_path):
    found = measured(html_of(make), [1400, 800, 400], tmp_path)
    for width, (client, scroll, right, shown, images, cut) in found.items():
        assert client == width
        assert scroll <= width
        assert right <= width
        assert shown == images > 0
        assert cut == 0 or width < 1400


@cache
def html_of(make):
    return build_report(*make().arguments).html


def test_points_speak_runs_open_figures_zoom_and_tables_sort_and_are_saved(tmp_path):
    shown = loaded(DRIVE, html_of(after_campaign), tmp_path)
    found = json.loads(html.unescape(re.search(r"<title>driven (.*?)</title>", shown, re.S)[1]))
    assert found["mean"].splitlines()[2] in found["run"]
    assert found["wide"] > 10  # pixels at which the text is shown
    assert len(found["opened"]) > 3
    assert all(head.endswith(f"run {run}") for run, head in found["opened"])  # also where places overlap
    assert found["points"] == 3 * [20]  # repeats and bins of made_campaigns
    assert re.match(r"(before|after): .* N\n", found["residual"])
    assert found["residual"].splitlines()[3] in found["farthest"]
    assert 1.5 < found["zoom"] < 3
    assert found["scrolled"] > 0
    rising, falling = (found[way] for way in ("rising", "falling"))
    numbers = [float(text) for text in rising if text[0].isdigit()]  # words come last, either way
    assert 1 < len(numbers) < len(rising)
    assert [float(text) for text in rising[: len(numbers)]] == sorted(numbers)
    assert [float(text) for text in falling[: len(numbers)]] == sorted(numbers, reverse=True)
    assert found["sort"] == "descending"
    assert found["name"] == "Errors_before_and_after.csv"
    lines = found["csv"].removeprefix("\ufeff").splitlines()
    assert len({line.count(",") for line in lines if '"' not in line}) == 1
    assert found["copy"].splitlines() == lines
    assert found["copied"] == ["Copied", "Refused by the browser"]
    parameters = list(csv.reader(found["parameters"].removeprefix("\ufeff").splitlines()))
    assert parameters[0] == ["condition", "parameter", "value", "95 %", "usys", "before", "unit", "note"]
    assert len(parameters[1]) == len(parameters[0])
    mu_s = next(row for row in parameters if row[1] == "μs")
    assert float(mu_s[2]) == pytest.approx(HIGHER * float(mu_s[5]), abs=2e-3)
    assert found["single"]


def test_without_scripts_the_page_is_whole(tmp_path):
    inert = html_of(aging_campaign).replace("<script>", '<script type="text/plain">')
    ((client, scroll, _, shown, images, _),) = measured(inert, [1200], tmp_path).values()
    assert client == scroll == 1200
    assert shown == images == html_of(aging_campaign).count("<figure")


@pytest.mark.parametrize("dark", [False, True])
def test_page_and_plots_follow_the_colour_scheme(dark, tmp_path):
    scheme = f"--blink-settings=preferredColorScheme={0 if dark else 1}"
    shown = loaded(COLOURS, html_of(aging_campaign), tmp_path, scheme)
    ground, text, turned = json.loads(html.unescape(re.search(r"<title>measured (.*?)</title>", shown)[1]))
    light = [sum(map(int, re.findall(r"\d+", colour)[:3])) / 765 for colour in (ground, text)]
    assert (light[0] < 0.2) == (light[1] > 0.7) == ("invert" in turned) == dark


def test_the_page_prints_on_a4(tmp_path):
    page, printed = tmp_path / "page.html", tmp_path / "page.pdf"
    page.write_text(html_of(aging_campaign), "utf-8")
    browsed(page, tmp_path, f"--print-to-pdf={printed}")
    document = printed.read_bytes()
    assert document.startswith(b"%PDF")
    sheets = set(re.findall(rb"/MediaBox ?\[0 0 (\d+)\S* (\d+)", document))
    assert sheets == {(b"594", b"841")}  # points


def test_a_table_of_one_row_stays_on_its_sheet(tmp_path):
    """Nor is a figure cut, which needs a sheet of its own."""
    sections = """<div style="height: 200mm"></div>
    <section><h3>Table</h3><div class="box">
    <table><thead><tr><th>a</th></tr></thead><tbody><tr><td>1</td></tr></tbody></table></div></section>
    <section><h2>Figure</h2><figure>
    <svg width="500" height="1000" viewBox="0 0 500 1000"><rect width="500" height="1000"/></svg>
    </figure></section>"""
    assert sheets(sections, tmp_path) == 2


def test_a_long_name_of_a_file_does_not_scale_the_sheets_down(tmp_path):
    cells = (60 * "folder/", 30 * "stroke 1, ", "c", "d", 90 * "1,")
    row = "".join(f'<td class="line">{cell}</td>' for cell in cells)
    sections = f"""<div class="box tall"><table class="findings"><tbody><tr>{row}</tr></tbody></table></div>
    <div style="height: 255mm"></div>"""
    assert sheets(sections, tmp_path) == 2


def test_the_residual_by_level_stands_above_its_table(tmp_path):
    part = '<div style="height: 150mm"></div>'
    sections = f'<section id="residual"><div class="split">{part}{part}</div></section>'
    assert sheets(sections, tmp_path) == 2


def sheets(sections, folder):
    """Return how many sheets of A4 sections of the page are printed on."""
    style = Path(report_page.__file__).with_name("style.css").read_text("utf-8")
    path, printed = folder / "page.html", folder / "page.pdf"
    path.write_text(f"<style>{style}</style><div class='page'><main>{sections}</main></div>", "utf-8")
    browsed(path, folder, f"--print-to-pdf={printed}", "--no-pdf-header-footer")
    return len(re.findall(rb"/Type ?/Page\b", printed.read_bytes()))


def measured(page, widths, folder):
    """Return by width what a browser measures of a page: see `FRAME`."""
    shown = loaded(FRAME.replace("WIDTHS", json.dumps(widths)), page, folder)
    found = json.loads(html.unescape(re.search(r"<title>measured (.*?)</title>", shown)[1]))
    return {int(width): sizes for width, sizes in found.items()}


def loaded(around, page, folder, *options):
    """Return what a browser made of a page in another one, where it stands for PAGE."""
    path = folder / "frame.html"
    path.write_text(around.replace("PAGE", json.dumps(page).replace("</", "<\\/")), "utf-8")
    return browsed(path, folder, *options)


def browsed(page, folder, *options):
    """Return the page after its scripts, which may print nothing to the console."""
    command = [
        BROWSER, "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
        "--hide-scrollbars",
        "--disable-background-networking", "--disable-component-update", "--disable-sync",
        f"--user-data-dir={folder / 'profile'}", "--window-size=1600,2000", "--enable-logging=stderr",
        *options, "--dump-dom", page.as_uri(),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert "CONSOLE" not in done.stderr, done.stderr[-2000:]
    return done.stdout
