"""Charts of time against accuracy: what has no place on a logarithmic axis is said, files are whole and repeat."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree
from pathlib import Path

from measured_points import reached, solver

from hood.media.bars import write_png
from hood.studies.tradeoff.charts import FLOOR, below_floor, cost_chart, front_chart, inline_svg, series_colours

ITEMS = [
    *(reached("net", k, 100.0 + 10 * k, 0.5 / (k + 1)) for k in (0, 1, 2, 5)),
    *(reached("net", k, 60.0 + 10 * k, 0.6 / (k + 1), precision="bf16") for k in (0, 5)),
    *solver({k: (20.0 + 10 * k, 2.0 / k**3) for k in (1, 2, 5, 10)}),
]
COLOURS = series_colours(ITEMS)


def texts(figure: object) -> str:
    from matplotlib.text import Text

    return "\n".join(item.get_text() for item in figure.findobj(Text))  # type: ignore[attr-defined]


def test_points_below_the_floor_stand_at_the_edge_and_are_not_moved() -> None:
    assert [item.label for item in below_floor(ITEMS)] == ["solver alone, converged"]
    negative = reached("net", 20, 300.0, -1e-3)
    assert below_floor([negative]) == [negative]
    figure = front_chart([*ITEMS, negative], [], COLOURS, "title")
    edge = [line for line in figure.axes[0].lines if line.get_marker() == "v"]
    assert sorted(float(line.get_xdata()[0]) for line in edge) == sorted([negative.ms.value, below_floor(ITEMS)[0].ms.value])
    assert "converged" in texts(figure)
    for axes in figure.axes:
        assert axes.get_ylim()[0] == FLOOR
        assert axes.get_xscale() == axes.get_yscale() == "log"
        values = [y for line in axes.lines if line.get_transform() == axes.transData for y in line.get_ydata()]
        assert min(values) > FLOOR


def test_hollow_markers_are_the_rejected_settings() -> None:
    rejected = ITEMS[1]
    figure = front_chart(ITEMS, {rejected.point}, COLOURS, "title")
    faces = {
        line.get_xdata()[0]: line.get_markerfacecolor()
        for line in figure.axes[0].lines
        if len(line.get_xdata()) == 1 and line.get_transform() == figure.axes[0].transData
    }
    assert faces[rejected.ms.value] == "white"
    assert sum(face == "white" for face in faces.values()) == 1


def test_every_series_is_in_the_legend_once() -> None:
    labels = [text.get_text() for text in front_chart(ITEMS, [], COLOURS, "title").legends[0].get_texts()]
    assert sorted(labels) == ["Pareto front", "net bf16", "net fp32", "solver alone"]


def test_bars_of_the_cost_add_up_to_the_time() -> None:
    figure = cost_chart(ITEMS[:3], "title")
    ends = [bar.get_x() + bar.get_width() for bar in figure.axes[0].patches]
    assert max(ends) == max(sum(item.parts.values()) for item in ITEMS[:3])
    assert "net + 2, fp32" in texts(figure)
    # The fewest and the most iterations of every series, and the converged solver.
    names = [text for text in texts(cost_chart(ITEMS, "title")).splitlines() if ", " in text]
    assert list(dict.fromkeys(names)) == [
        "solver alone, converged", "solver alone, 10 iterations", "solver alone, 1 iteration", "net + 5, bf16", "net, bf16",
        "net + 5, fp32", "net, fp32",
    ]  # fmt: skip


def test_svgs_are_whole_stand_in_one_page_and_load_nothing() -> None:
    one = inline_svg(front_chart(ITEMS, [], COLOURS, "title"), "a", "a chart")
    other = inline_svg(front_chart(ITEMS, [], COLOURS, "title"), "b", "a chart")
    root = ElementTree.fromstring(f"<div>{one}{other}</div>")
    ids = [element.get("id") for element in root.iter() if element.get("id")]
    assert len(ids) == len(set(ids))
    used = set(re.findall(r'href="#([^"]+)"|url\(#([^)]+)\)', one))
    assert {name for pair in used for name in pair if name} <= set(ids)
    assert not re.search(r'href="(?!#)', one)
    assert "width=" not in one[: one.index(">")]


def test_the_same_points_give_the_same_files(tmp_path: Path) -> None:
    for name in ("a.png", "b.png"):
        write_png(front_chart(ITEMS, [], COLOURS, "title"), tmp_path / name, dpi=40)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert inline_svg(cost_chart(ITEMS, "t"), "a", "l") == inline_svg(cost_chart(ITEMS, "t"), "a", "l")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.png", "b.png"]
