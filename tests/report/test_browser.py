"""The page in a browser: nothing is wider than the window, and every image shows."""

import json
import re
import shutil
import subprocess
from functools import cache

import pytest
from report.made_campaigns import aging_campaign, not_run, torque_campaign

from sealfit.report.page import build_report

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
BROWSER = next(filter(None, map(shutil.which, BROWSERS)), None)
# A window has a least width of 500 px, a frame in it has none; the page's own rules hold in the frame too.
FRAME = """<!doctype html><title>not measured</title><body><script>
const frame = document.createElement("iframe");
frame.style.width = "WIDTHpx";
frame.style.height = "2000px";
frame.style.border = "0";
frame.onload = () => {
  const page = frame.contentDocument, images = [...page.images], root = page.documentElement;
  const boxes = [...page.querySelectorAll("body *")].filter(e => !e.closest(".box") && !e.closest("pre"));
  const right = Math.ceil(Math.max(...boxes.map(e => e.getBoundingClientRect().right)));
  const shown = images.filter(i => i.complete && i.naturalWidth > 0).length;
  document.title = ["measured", root.clientWidth, root.scrollWidth, right, shown, images.length].join(" ");
};
frame.srcdoc = PAGE;
document.body.append(frame);
</script>"""

pytestmark = pytest.mark.skipif(BROWSER is None, reason="no chromium on PATH")


@pytest.mark.parametrize("width", [1400, 400])
@pytest.mark.parametrize("make", [aging_campaign, torque_campaign, not_run])
def test_nothing_overflows_and_every_image_shows(make, width, tmp_path):
    html = html_of(make)
    page = tmp_path / "frame.html"
    text = json.dumps(html).replace("</", "<\\/")
    page.write_text(FRAME.replace("WIDTH", str(width)).replace("PAGE", text), "utf-8")
    client, scroll, right, shown, images = measured(page, tmp_path)
    assert client == width
    assert scroll <= width
    assert right <= width
    assert shown == images > 0


@cache
def html_of(make):
    return build_report(*make().arguments).html


def measured(page, folder):
    command = [
        BROWSER, "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
        "--hide-scrollbars",
        "--disable-background-networking", "--disable-component-update", "--disable-sync",
        f"--user-data-dir={folder / 'profile'}", "--window-size=1600,2000", "--dump-dom", page.as_uri(),
    ]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    found = re.search(r"<title>measured (\d+) (\d+) (\d+) (\d+) (\d+)</title>", done.stdout)
    assert found, done.stderr[-2000:]
    return [int(group) for group in found.groups()]
