"""What a bake is to do, what it shows meanwhile, and what its capture hands to its run. No pointers of Blender: they do not
survive undo.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from .fault import Fault
from .meshes import Exported


@dataclass
class GarmentPlan:
    """A garment that is baked."""

    object: str
    uid: int
    file: str  # name of its files
    fabric: str
    slots: tuple[str, ...] = ()  # fabrics of the material slots; empty: one fabric
    pins: str = ""  # vertex group
    follows: str = ""  # vertex group of the body; empty: its skin
    sew: float = 0.0  # m


@dataclass
class Plan:
    """What the user has asked for, read from the scene when the bake begins."""

    scene: str
    layer: str
    folder: Path
    hood: list[str]
    body: str
    body_uid: int
    garments: list[GarmentPlan]
    first: int
    last: int
    quality: str
    keys: bool  # shape keys instead of the modifier
    halves: bool = True
    threads: int = 1
    more: tuple[str, ...] = ()
    again: bool = False  # capture again, whatever lies there
    estimate: bool = False  # a few frames, for the time that they take


@dataclass
class Progress:
    """What the panel shows."""

    work: str = "Starting"
    done: int = 0
    total: int = 0
    left: str = ""
    seconds_per_frame: float = 0.0
    runs: bool = False  # a process, which has to be asked to end
    cancel: bool = False  # the user wants it to end
    faults: list[Fault] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


@dataclass
class Captured:
    """What the capture says to the run."""

    exported: list[Exported]
    matrices: np.ndarray  # (G, T, 4, 4) of every garment in every frame
    origin: np.ndarray  # (3,) m
    samples: int  # of the body a frame
    scale: float
