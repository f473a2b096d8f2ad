"""What a page of ``hood view`` costs: its size, and the milliseconds of its own program for a frame.

    python benchmarks/viewer.py outputs/dance                  # any folder of hood rollout, or its rollout.h5
    python benchmarks/viewer.py outputs/dance outputs/other    # side by side in one page

Opens the page in headless Chromium (on the PATH) and plays it for --seconds in every colour. Timed is what the page does in
one animation frame, from its start to its end: positions, normals, colours, chart, and the commands to the graphics card.
Drawing itself runs in another process, here in software, and does not count. Only animation frames in which the rollout
went on to its next frame are counted.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np

from hood.cli.main import main as hood
from tools.browser import Browser

#: Notes the milliseconds of every animation frame and the rollout's frame that it left.
_WATCH = """
window.spent = [];
const ask = window.requestAnimationFrame.bind(window);
window.requestAnimationFrame = (work) => ask((now) => {
  const before = performance.now();
  work(now);
  window.spent.push([performance.now() - before, Number(document.getElementById('time').value)]);
});
"""


def measure(browser: Browser, colour: str, seconds: float) -> np.ndarray:
    """Milliseconds of the animation frames that showed another frame than the one before."""
    browser.run(
        f"(() => {{ const choice = document.getElementById('colour'); choice.value = '{colour}'; choice.onchange();"
        "const play = document.getElementById('play'); if (play.textContent === 'play') play.click(); })()"
    )
    browser.run("new Promise((done) => setTimeout(done, 1000))")
    noted = browser.run(
        f"(window.spent.length = 0, new Promise((done) => setTimeout(() => done(window.spent), {1000 * seconds})))"
    )
    table = np.asarray(noted, dtype=np.float64)
    return table[1:, 0][np.diff(table[:, 1]) != 0]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rollouts", nargs="+", help="folders of hood rollout, or rollout.h5 files")
    parser.add_argument("--seconds", type=float, default=10.0, help="of playing, for every colour")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder) / "page.html"
        if hood(["view", *options.rollouts, f"output={page}"]):
            raise SystemExit(2)
        print(f"{page.stat().st_size / 1e6:.2f} MB")
        with Browser() as browser:
            browser.before(_WATCH)
            browser.open(page)
            colours = browser.run("[...document.getElementById('colour').options].map((option) => option.value)")
            print("colour   frames   median ms   95th percentile   most")
            for colour in colours:
                spent = measure(browser, colour, options.seconds)
                median, high, most = np.quantile(spent, (0.5, 0.95, 1.0))
                print(f"{colour:8s} {len(spent):6d}   {median:9.2f}   {high:15.2f}   {most:4.1f}")
            for line in browser.complaints:
                print(f"the page complains: {line}")


if __name__ == "__main__":
    main()
