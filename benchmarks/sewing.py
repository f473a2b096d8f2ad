"""Own designs (``hood sew design:NAME``) sewn on bodies of three shapes: how each ends, and what it does when it is worn.

    python benchmarks/sewing.py --edge 0.03 --limit 120 --csv sewing.csv --pictures outputs/sewing
    python benchmarks/sewing.py --designs tshirt skirt --first 1 --betas 0 --wear walk_brisk

A row a garment: vertices, seconds, strain p99, pairs of triangles that pass through the body and through cloth, and what is
wrong with it. ``--wear`` runs each that is sewn well in motions and prints their verdicts, and how far the lengths at rest of
the cloth and its grain are from the flat pattern: at most 0.1% and 1° are allowed.
"""

from __future__ import annotations

import argparse
import contextlib
import csv
import io
import json
import re
import signal
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from types import FrameType

import numpy as np
import yaml

import hood
from hood.assets.garment.garment import load_garment
from hood.assets.pattern.designs import draft
from hood.assets.pattern.fronts import opened
from hood.assets.pattern.measures import measure_body
from hood.assets.pattern.sheet import sheet_of
from hood.cli.main import main as run_hood

#: Options of every variant, by design; the first of each has the defaults.
VARIANTS: dict[str, tuple[str, ...]] = {
    "tank": ("", "shape:v,length:0.1", "fit:1.0,ease:0.04", "length:0.4,ease:0.2"),
    "tshirt": ("", "sleeve:0.6,ease:0.2", "shape:v,depth:0.35", "sleeve:0.2,length:0.1,fit:0.6", "wide:1.6,length:0.35"),
    "shirt": ("", "collar:none,cuff:0.0", "ease:0.3,length:0.4", "sleeve:0.6,fit:0.8"),
    "hoodie": ("", "cuff:0.0,ease:0.12", "ease:0.35,length:0.3"),
    "bodice": ("", "sleeve:0.3", "shape:v,depth:0.4,ease:0.12", "sleeve:0.3,puff:1.4"),
    "sheath": ("", "length:0.7,flare:0.3", "sleeve:0.4,length:0.4", "shape:v,flare:-0.05"),
    "dress": ("", "gathers:2.2,length:0.4", "tiers:3,length:0.8", "sleeve:0.3,puff:1.3", "tiers:2,gathers:1.4,shape:v"),
    "swing": ("", "circle:1.1,length:0.4", "sleeve:0.3,circle:0.5"),
    "shift": ("", "flare:0.7,length:0.7", "sleeve:0.35,fit:0.0", "fit:1.0,flare:0.1"),
    "skirt": ("", "flare:0.0", "flare:0.8,length:0.75", "length:0.35,band:0.06"),
    "pencil": ("", "length:0.65", "flare:0.0,length:0.4"),
    "circle": ("", "circle:0.5", "circle:0.5,length:0.85", "length:0.35"),
    "gathered": ("", "gathers:2.2", "gathers:1.4,length:0.8"),
    "tiered": ("", "tiers:2,length:0.45", "tiers:4,length:0.9"),
    "trousers": ("", "knee:0.7,hem:1.3", "knee:0.2,hem:0.8,ease:0.04", "length:0.7,knee:0.5", "rise:-0.06"),
    "leggings": ("", "length:0.7", "ease:0.04,knee:0.12"),
    "shorts": ("", "length:0.5", "ease:0.2,hem:1.3", "length:0.15"),
    "jumpsuit": ("", "length:0.25", "knee:0.8,hem:1.3,ease:0.12", "sleeve:0.4,shape:v"),
    "poncho": ("", "length:0.35,shape:v", "sleeve:0.3,length:0.0"),
    "cape": ("", "circle:1.0,length:0.4"),
    "blouse": ("", "collar:stand,front:zip", "ease:0.3,length:0.45,cuff:0.0", "front:closed,collar:none,sleeve:0.5"),
    "bomber": ("", "front:closed,rib:0.85", "ease:0.4,length:0.2,front:buttons", "sleeve:0.5,wide:1.4"),
    "gilet": ("", "front:buttons,tube:0.15", "front:closed,length:0.35,ease:0.4"),
    "blazer": ("", "front:closed,length:0.5", "lapel:0.11,depth:0.6,ease:0.3", "fit:1.0,sleeve:0.7"),
    "pleated": ("", "pleat:box", "pleats:24,under:0.95,length:0.35", "pleats:8,length:0.75"),
    "wrap": ("", "overlap:0.3,length:0.35", "overlap:0.85,flare:0.8,length:0.85"),
    "apron": ("", "straps:back", "bib:0.75,flare:0.5,length:0.75", "straps:back,bib:0.45,length:0.25"),
    "jeans": ("", "knee:0.6,hem:1.5", "hem:0.7,turn:0.0,ease:0.02", "length:0.7,turn:0.08"),
}
#: Of the lengths at rest as a share, and of the grain in degrees.
LENGTH, GRAIN = 1e-3, 1.0


@dataclass(frozen=True)
class Row:
    """One garment on one body."""

    design: str
    options: str
    beta: float
    vertices: int
    seconds: float
    strain_p99: float  # share; NaN where it was not reached
    body_crossings: int
    self_crossings: int
    faults: str  # none where it is sewn well


class TooLong(Exception):
    """A garment took more time than it has."""


@contextlib.contextmanager
def time_limit(seconds: int) -> Iterator[None]:
    """Raise :class:`TooLong` in the block after so many seconds."""

    def stop(number: int, frame: FrameType | None) -> None:
        raise TooLong

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def sew(design: str, chosen: str, beta: float, edge: float, limit: int, folder: Path) -> tuple[Row, Path]:
    """A garment by ``hood sew``, and its file, which is there where it is sewn well; its sheet is beside it."""
    name = "_".join([design, *re.findall(r"[\w.-]+", chosen), f"{beta:+g}"])
    target, text, began = folder / f"{name}.npz", io.StringIO(), time.perf_counter()
    words = ["sew", f"design:{design}", f"betas=[{beta:g}]", f"edge={edge:g}", f"output={target}"]
    words += [f"design={{{chosen}}}"] if chosen else []
    fault = ""
    try:
        with time_limit(limit), contextlib.redirect_stdout(text), contextlib.redirect_stderr(text):
            if run_hood(words) == 2:
                fault = text.getvalue().strip().splitlines()[-1]
    except TooLong:
        fault = f"not sewn after {limit} s"
    said, seconds = text.getvalue(), time.perf_counter() - began
    found = re.search(r"strain p99 ([\d.]+|inf|nan)%.*?body (\d+), cloth (\d+)", said, re.DOTALL)
    vertices = re.search(r"([\d,]+) vertices", said)
    unsewn = re.search(r"not sewn: (.*?)\. How far", said, re.DOTALL)
    figures = (0.01 * float(found[1]), int(found[2]), int(found[3])) if found else (float("nan"), 0, 0)
    count = int(vertices[1].replace(",", "")) if vertices else 0
    return Row(design, chosen, beta, count, round(seconds, 1), *figures, unsewn[1] if unsewn else fault), target


def wear(path: Path, motion: str, beta: float, frames: int) -> str:
    """The verdict of a rollout of a garment by the solver."""
    folder, text = path.with_suffix(f".{motion}"), io.StringIO()
    words = ["rollout", f"garment={path}", f"sequence={motion}", f"betas=[{beta:g}]", "stepper=newton", f"num_frames={frames}"]
    with contextlib.redirect_stdout(text), contextlib.redirect_stderr(text):
        code = run_hood([*words, "fail_on=nothing", f"output={folder}"])
    if code:
        return text.getvalue().strip().splitlines()[-1]
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    return "sound" if summary["sound"] else "unsound: " + "; ".join(summary["unsound_reasons"])


def off_pattern(path: Path, row: Row, edge: float) -> tuple[float, float]:
    """How far a garment is from its pattern, on the body that it was made for: lengths at rest as a share, elastic apart, and
    grain in degrees."""
    body, betas, garment = hood.load_body(), np.array([row.beta]), load_garment(path)
    vertices, joints = body.shaped(betas)
    options = yaml.safe_load("{" + row.options.replace(":", ": ") + "}")
    sheet = sheet_of(draft(row.design, measure_body(vertices, body.faces, joints), options), edge, row.design)
    scene = hood.build_scene(garment, body, hood.load_sequence("plie"), hood.Material(warp=3.0), betas=betas)
    sheet = sheet if len(sheet.faces) == len(garment.faces) else opened(sheet, sheet.pos)[0]  # a front that opens has a strip
    corners = sheet.flat[:, 1:] - sheet.flat[:, :1]
    assert scene.cloth.flat is not None
    assert len(sheet.faces) == len(garment.faces)
    own, cut = (_sides(edges) for edges in (scene.cloth.flat.double().numpy(), corners))
    plain = np.ones(len(own), bool) if garment.elastic is None else (np.asarray(garment.elastic) == 1.0).all(axis=1)
    assert scene.cloth.grain is not None
    warp = np.einsum("fi,fix->fx", scene.cloth.grain.double().numpy(), corners)
    turn = np.degrees(np.abs(np.arctan2(warp[:, 0], warp[:, 1])))
    return float(np.abs(own[plain] / cut[plain] - 1.0).max()), float(turn.max())


def _sides(edges: np.ndarray) -> np.ndarray:
    """Lengths (F, 3) [m] of the sides of faces by two edges of each, (F, 2, 2)."""
    return np.linalg.norm(np.concatenate([edges, edges[:, 1:] - edges[:, :1]], axis=1), axis=2)


def line(row: Row) -> str:
    faults = row.faults or "sewn"
    return (
        f"{row.design:<10}{row.options:<34}{row.beta:>+5g}{row.vertices:>7}{row.seconds:>7.1f}{row.strain_p99:>8.1%}"
        f"{row.body_crossings:>6}{row.self_crossings:>6}  {faults}"
    )


def shares(rows: Sequence[Row]) -> Iterator[str]:
    """How many were sewn well, by design, by body and of all."""
    groups: dict[str, list[Row]] = defaultdict(list)
    for row in rows:
        for key in (row.design, f"betas=[{row.beta:g}]", "all"):
            groups[key].append(row)
    groups["all"] = groups.pop("all", [])
    for key, own in groups.items():
        sewn = [row for row in own if not row.faults]
        median = f", {np.median([row.seconds for row in own]):.1f} s in the median" if own else ""
        yield f"{key}: {len(sewn)} of {len(own)} sewn well{median}"


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--designs", nargs="+", default=list(VARIANTS), choices=list(VARIANTS), metavar="DESIGN")
    parser.add_argument("--first", type=int, default=None, help="variants of each design; all without it")
    parser.add_argument("--betas", nargs="+", type=float, default=[0.0, 2.0, -2.0], help="first shape coefficient, a body each")
    parser.add_argument("--edge", type=float, default=0.03, help="m, length of the mesh's edges")
    parser.add_argument("--limit", type=int, default=180, help="seconds for a garment")
    parser.add_argument("--csv", type=Path, default=None)
    parser.add_argument("--pictures", type=Path, default=None, help="folder for the garments and their sheets")
    parser.add_argument("--wear", nargs="+", default=[], metavar="MOTION", help="motions in which those sewn well are worn")
    parser.add_argument("--frames", type=int, default=60, help="of these motions")
    chosen = parser.parse_args(arguments)
    rows, bad = [], 0
    with tempfile.TemporaryDirectory() as temporary:
        folder = chosen.pictures or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        print(f"{'design':<10}{'options':<34}{'beta':>5}{'vert.':>7}{'s':>7}{'strain':>8}{'body':>6}{'self':>6}", flush=True)
        for design in chosen.designs:
            for options in VARIANTS[design][: chosen.first]:
                for beta in chosen.betas:
                    row, path = sew(design, options, beta, chosen.edge, chosen.limit, folder)
                    rows.append(row)
                    print(line(row), flush=True)
                    if chosen.wear and path.exists() and not row.faults:
                        length, grain = off_pattern(path, row, chosen.edge)
                        bad += length > LENGTH or grain > GRAIN
                        verdicts = ", ".join(f"{motion}: {wear(path, motion, beta, chosen.frames)}" for motion in chosen.wear)
                        print(f"  lengths at rest off by {length:.3%}, grain by {grain:.2f}°; {verdicts}", flush=True)
                    if chosen.csv is not None:
                        _write(chosen.csv, rows)
    print("\n".join(shares(rows)))
    if bad:
        print(f"{bad} garments are not those of their flat pattern")
    return int(bad > 0)


def _write(path: Path, rows: Sequence[Row]) -> None:
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(asdict(rows[0])))
        writer.writeheader()
        writer.writerows(asdict(row) for row in rows)


if __name__ == "__main__":
    raise SystemExit(main())
