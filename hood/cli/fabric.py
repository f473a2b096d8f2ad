"""``hood fabric [NAME …]``: fabrics beside each other, in the units of a textile laboratory, and draped over a disc."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from hood.app.common import output_folder, prepare_folder, require_distinct, require_package, split_words
from hood.app.scene.fabrics import fabric_named, is_measured
from hood.app.settings.compose import ConfigError, load_config, options, plain
from hood.assets.files.atomic import write_atomically
from hood.assets.files.library import unknown
from hood.assets.material import Material, bending_length, stretch_stiffness, values_of
from hood.evaluation.drape import COARSEST, FINEST, Drape, drape

_PLAIN = ("density", "lame_mu", "lame_lambda", "bending_stiffness", "thickness")


@dataclass(frozen=True)
class Described:
    """A fabric as a laboratory would tell it, and what the simulation makes of it.

    Args:
        density: kg/m².
        stretch: N/m along warp and weft.
        shear: N/m per radian.
        bending: N·m along warp and weft.
        bending_length: [m] of the mean of warp and weft.
        material: of the simulation.
        simulated_stretch: N/m along warp and weft, of ``material``.
        measured: whether the file tells measured cloth; else all is that of the isotropic ``material``.
    """

    name: str
    density: float
    stretch: tuple[float, float]
    shear: float
    bending: tuple[float, float]
    bending_length: float
    material: Material
    simulated_stretch: tuple[float, float]
    measured: bool


def run(arguments: Sequence[str]) -> int:
    """Run the command; returns the exit code."""
    names, config = split_words("fabric", arguments)
    edges = _checked_edges(config)
    require_distinct("fabrics", names)
    folder = None if config.output is None else output_folder(config)
    if folder is not None and names and edges:
        require_package("matplotlib", "matplotlib", "charts", "hood fabric output=…")
    fabrics = [described(name, bool(config.woven)) for name in names or options("material")]
    if folder is not None:
        prepare_folder(folder)
    print("\n".join(_table(fabrics)), flush=True)
    drapes: dict[str, list[Drape]] = {}
    if names and edges:
        print("\n" + _row(["drape coefficient", *(f"{1e3 * edge:g} mm" for edge in edges), "folds"]), flush=True)
        for fabric in fabrics:
            drapes[fabric.name] = [drape(fabric.material, edge) for edge in edges]
            print(_drape_row(fabric.name, drapes[fabric.name]), flush=True)
    elif edges:
        print("\nhood fabric NAME … drapes the fabrics that are named")
    if folder is not None:
        _write(folder, fabrics, drapes)
    return 0


def described(name: str, woven: bool = False) -> Described:
    """The fabric of an option of ``material=``; measured cloth stretches as measured if ``woven``.

    Raises:
        ConfigError: there is none of this name, or it is not the same everywhere.
    """
    known = options("material")
    if name not in known:
        raise ConfigError(unknown("fabric", name, known))
    told = is_measured(name)
    material = fabric_named(name, woven if told else None)
    if any(values_of(getattr(material, key))[1] for key in Material.names()):
        raise ConfigError(f"fabric {name!r} is not the same everywhere, and has no one value of its properties; name another")
    numbers = {key: float(values_of(getattr(material, key))[0]) for key in Material.names()}
    density, mu, lam, k, thickness = (numbers[key] for key in _PLAIN)
    isotropic = stretch_stiffness(mu, lam, thickness)
    stretch = isotropic * numbers["warp"], isotropic * numbers["weft"]
    node = load_config("rollout", [f"material={name}"]).material
    warp, weft = (node.stretch_warp, node.stretch_weft) if told else stretch
    along, across = (node.bending_warp, node.bending_weft) if told else (0.25 * k, 0.25 * k)
    return Described(
        name,
        density,
        (float(warp), float(weft)),
        thickness * mu * numbers["shear"],
        (float(along), float(across)),
        bending_length(0.25 * k, density),
        material,
        stretch,
        told,
    )


def _checked_edges(config: DictConfig) -> list[float]:
    edges = plain(config.edges)
    for edge in edges:
        if isinstance(edge, bool) or not isinstance(edge, (int, float)) or not FINEST <= edge <= COARSEST:
            raise ConfigError(
                f"edges: {edge!r} is no edge of a mesh; give metres from {FINEST} to {COARSEST}, e.g. [0.01,0.007]"
            )
    require_distinct("edges", edges)
    return [float(edge) for edge in edges]


def _table(fabrics: Sequence[Described]) -> list[str]:
    head = ["fabric", "density", "warp", "weft", "simulated", "shear", "bending", "length"]
    units = ["", "g/m²", "N/m", "N/m", "N/m", "N/m", "µN·m", "mm"]
    rows = [
        [
            fabric.name,
            f"{1e3 * fabric.density:.0f}",
            *(f"{value:.0f}" for value in fabric.stretch),
            "/".join(dict.fromkeys(f"{value:.0f}" for value in fabric.simulated_stretch)),
            f"{fabric.shear:.0f}",
            "/".join(f"{1e6 * value:.3g}" for value in dict.fromkeys(fabric.bending)),
            f"{1e3 * fabric.bending_length:.1f}",
        ]
        for fabric in fabrics
    ]
    return [_row(cells) for cells in (head, units, *rows)]


def _row(cells: Sequence[str]) -> str:
    return f"{cells[0]:<18}" + "".join(f"{cell:>12}" for cell in cells[1:])


def _drape_row(name: str, drapes: Sequence[Drape]) -> str:
    unrest = "" if all(found.rest.reached for found in drapes) else "   not at rest"
    return _row([name, *(f"{100 * found.rest.coefficient:.1f}%" for found in drapes), str(drapes[-1].rest.folds)]) + unrest


def _write(folder: Path, fabrics: Sequence[Described], drapes: dict[str, list[Drape]]) -> None:
    record = {fabric.name: _as_dict(fabric, drapes.get(fabric.name, [])) for fabric in fabrics}
    write_atomically(folder / "fabrics.json", json.dumps(record, indent=1).encode())
    written = [folder / "fabrics.json"]
    if drapes:
        from hood.media.bars import write_shadows

        written.append(folder / "shadows.png")
        write_shadows({name: found[-1].rest for name, found in drapes.items()}, written[-1])
    print("\nwritten: " + ", ".join(map(str, written)))


def _as_dict(fabric: Described, drapes: Sequence[Drape]) -> dict[str, Any]:
    """SI units."""
    return {
        "density": fabric.density,
        "stretch_warp": fabric.stretch[0],
        "stretch_weft": fabric.stretch[1],
        "shear": fabric.shear,
        "bending_warp": fabric.bending[0],
        "bending_weft": fabric.bending[1],
        "bending_length": fabric.bending_length,
        "measured": fabric.measured,
        "simulated": {
            "stretch_warp": fabric.simulated_stretch[0],
            "stretch_weft": fabric.simulated_stretch[1],
            **{key: float(values_of(getattr(fabric.material, key))[0]) for key in Material.names()},
        },
        "drape": [
            {
                "edge": found.edge,
                "vertices": len(found.rest.pos),
                "coefficient": found.rest.coefficient,
                "folds": found.rest.folds,
                "at_rest": found.rest.reached,
                "states": [
                    {"coefficient": state.coefficient, "folds": state.folds, "energy": state.energy} for state in found.states
                ],
            }
            for found in drapes
        ],
    }
