"""The site of ``make docs`` is read on a phone: nothing but tables and code scrolls sideways, and every name has its entry.

Needs Chromium on the PATH.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from pages import PAGES, ROOT, text_of

from tools.browser import Browser

pytestmark = pytest.mark.slow
NAMES = sorted(page.with_suffix(".html").name for page in PAGES if page.parent == ROOT / "docs")
#: What is seen of the page and stands out of the window to the right, but for the inside of boxes that scroll.
_OUTSIDE = """(() => {
  const wide = (element) => element.getBoundingClientRect().right > document.documentElement.clientWidth + 1;
  const inBox = (element) => {
    for (let box = element.parentElement; box && box !== document.body; box = box.parentElement)
      if (['auto', 'scroll'].includes(getComputedStyle(box).overflowX) && !wide(box)) return true;
    return false;
  };
  const all = [...document.querySelectorAll('.md-content *')].filter((e) => e.getBoundingClientRect().width);
  return all.filter((e) => wide(e) && !inBox(e)).map((e) => e.outerHTML.slice(0, 100));
})()"""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("mkdocs", reason="make docs installs it: pip install '.[docs]'")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="module", params=[360, 390])
def phone(request: pytest.FixtureRequest, site: Path) -> Iterator[Browser]:
    with Browser(request.param, 740) as browser:
        size = {"width": request.param, "height": 740}
        browser.call("Emulation.setDeviceMetricsOverride", **size, deviceScaleFactor=2, mobile=True)
        yield browser


@pytest.mark.parametrize("name", NAMES)
def test_a_page_fits_a_phone(name: str, phone: Browser, site: Path) -> None:
    phone.call("Page.navigate", url=(site / name).as_uri())
    phone.run(
        f"new Promise((done) => {{ const look = () => location.href.endsWith({name!r}) && document.readyState === 'complete' "
        "? done() : setTimeout(look, 20); look(); })"
    )
    assert phone.run("document.scrollingElement.scrollWidth <= document.documentElement.clientWidth")
    assert phone.run(_OUTSIDE) == []
    assert phone.run("[...document.images].filter((image) => !image.naturalWidth).map((image) => image.src)") == []


def test_every_entry_of_the_reference_is_on_its_page(site: Path) -> None:
    entries = re.findall(r"^::: (\S+)$", text_of(ROOT / "docs" / "api.md"), re.MULTILINE)
    page = text_of(site / "api.html")
    assert [path for path in entries if f'id="{path}"' not in page] == []
    assert ":class:`" not in page
    assert "type: ignore" not in page
