"""Pages in headless Chromium: nothing runs over the page's edge, no figure is empty, no words lie on each other."""

from __future__ import annotations

import html
import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest
from report_data import campaign

from warehouse.render import render
from warehouse.report import REPORTS, build

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
PROBE = """
<script>
const wide = document.documentElement.scrollWidth - document.documentElement.clientWidth;
const figures = [...document.querySelectorAll('figure')];
const empty = figures.filter(f => !f.querySelector('svg path') || f.querySelector('svg').getBoundingClientRect().height < 40);
function meet(a, b) { return Math.min(a.right, b.right) - Math.max(a.left, b.left) > 2
  && Math.min(a.bottom, b.bottom) - Math.max(a.top, b.top) > 2; }
let overlaps = 0;
for (const figure of figures) {
  const boxes = [...figure.querySelectorAll('svg text')].map(t => t.getBoundingClientRect()).filter(b => b.width > 0);
  for (let i = 0; i < boxes.length; i++) for (let j = i + 1; j < boxes.length; j++) overlaps += meet(boxes[i], boxes[j]);
}
const blocks = [...document.querySelectorAll('h1,h2,h3,h4,p,table,figcaption')].map(e => e.getBoundingClientRect());
let stacked = 0;
for (let i = 1; i < blocks.length; i++) stacked += meet(blocks[i - 1], blocks[i]);
const pre = document.createElement('pre'); pre.id = 'probe';
pre.textContent = JSON.stringify({wide, figures: figures.length, empty: empty.length, overlaps, stacked});
document.body.appendChild(pre);
</script>
"""


def probed(page: str, folder: Path, width: int) -> dict[str, int]:
    """What the browser measures of a page at some width; a window has a least one, of 500."""
    file = folder / "page.html"
    file.write_text(page.replace("</body>", f"{PROBE}</body>"), encoding="utf-8")
    found = subprocess.run(
        [
            str(CHROMIUM), "--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking", "--hide-scrollbars",
            f"--user-data-dir={folder / 'profile'}", f"--window-size={width},900", "--dump-dom", file.as_uri(),
        ],
        capture_output=True, text=True, timeout=120, check=True,
    )  # fmt: skip
    told = re.search(r'<pre id="probe">(.*?)</pre>', found.stdout)
    assert told, found.stderr[-500:]
    return dict(json.loads(html.unescape(told.group(1))))


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine")
@pytest.mark.parametrize("width", [1200, 500])
@pytest.mark.parametrize("name", list(REPORTS))
def test_the_page_lays_out_without_faults(name: str, width: int, tmp_path: Path) -> None:
    report = build(campaign(), name, {})
    found = probed(str(render(report, "html")), tmp_path, width)
    assert found["wide"] <= 1
    assert found["empty"] == 0
    assert found["overlaps"] == 0
    assert found["stacked"] == 0
    if report.spec.figures and name != "wheelset":
        assert found["figures"] > 0


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine")
def test_the_probe_sees_faults(tmp_path: Path) -> None:
    page = (
        "<!DOCTYPE html><html><body><p style='width: 3000px'>x</p><figure><svg viewBox='0 0 9 9'></svg></figure>"
        "<figure><svg viewBox='0 0 90 90' width='90' height='90'><path d='M0 0H9'/><text y='20'>one</text>"
        "<text y='22'>two</text></svg></figure></body></html>"
    )
    found = probed(page, tmp_path, 800)
    assert found["wide"] > 1000
    assert found["empty"] == 1
    assert found["overlaps"] == 1
