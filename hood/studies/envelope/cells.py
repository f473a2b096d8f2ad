"""The cells of the stability map. The list is fixed, so that no run decides what it is judged by."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from hood.assets.material import Material

#: Standard gravity [m/s²].
_G = 9.81
#: Frames of a rollout, least and most, whatever the time step.
_FRAMES = (20, 300)
#: The factor of the one cell in which everything is ordinary.
NOMINAL = "nominal"
#: Factors whose cells go from one end of a range to the other.
ORDERED = frozenset(
    "dt stretching bending density gravity friction speed teleport turn spin stop fall offset size resolution drop slivers "
    "duplicates isolated flipped irregular components damping".split()
)


@dataclass(frozen=True)
class Cell:
    """One setting of one factor, or of several at once; everything else is nominal."""

    factor: str
    value: str
    settings: tuple[str, ...] = ()  # keys of ``hood rollout``
    motion: str | None = None  # of hood.studies.envelope.extreme_files; None: ``sequence``
    fault: str | None = None  # of the garment, likewise
    garment: str | None = None  # embedded garment, or a list of them; None: whichever the map is made for
    sequence: str | None = None  # embedded motion; None: the nominal one
    still_body: bool = False  # a mesh in T-pose in place of the body and its motion
    fps: float = 30.0
    seconds: float = 2.0
    frames: int | None = None  # None: from the seconds
    bad_input: str = ""  # to be refused by a sentence with this word; "": good input
    long: bool = False  # takes an hour or so: left out unless asked for

    @property
    def num_frames(self) -> int:
        """Of its rollouts."""
        return self.frames or int(np.clip(round(self.seconds * self.fps), *_FRAMES))

    @property
    def name(self) -> str:
        """Good for a folder."""
        return re.sub(r"[^A-Za-z0-9.]+", "-", f"{self.factor} {self.value}".replace("×", "x")).strip("-")


def cells() -> tuple[Cell, ...]:
    """All of them, the nominal one first; those of a factor from one end of its range to the other."""
    settings = (_nominal, _scene, _motions, _poses, _garments, _meshes, _pins_and_layers, _air, _cloth, _changes)
    groups = (*settings, _pairs, _together, _long, _inputs)
    return tuple(cell for group in groups for cell in group())


def _nominal() -> Iterator[Cell]:
    """Everything ordinary, and the other garments and motions that come along."""
    yield Cell(NOMINAL, "all")
    for name in ("tank", "tshirt", "longsleeve", "shorts", "skirt", "trousers"):
        yield Cell("garment", name, garment=name)
    for name in ("walk_proud", "jog", "squats", "bends", "lunges", "kicks", "jumps"):
        yield Cell("motion", name, sequence=name)


def _scene() -> Iterator[Cell]:
    """Time step, fabric and forces."""
    for fps in (480.0, 240.0, 120.0, 60.0, 15.0, 10.0, 5.0):
        yield Cell("dt", f"1/{fps:g}", (f"fps={fps:g}",), fps=fps)
    for factor in (1e-3, 1e-2, 0.1, 10.0, 100.0, 1e3, 1e4):
        yield Cell("stretching", f"×{factor:g}", _stiffness(factor))
    for factor in (0.0, 1e-2, 1e2, 1e4, 1e6):
        yield Cell("bending", f"×{factor:g}", (f"material.bending_stiffness={_times('bending_stiffness', factor)}",))
    for density in (1e-3, 1e-2, 0.05, 1.0, 5.0, 50.0):
        yield Cell("density", f"{density:g} kg/m²", (f"material.density={density:g}",))
    for g in (0.0, 0.1, 3.0, 10.0):
        yield Cell("gravity", f"{g:g} g", (f"gravity={g * _G:g}",))
    for coefficient in (0.0, 0.1, 1.0, 10.0):
        yield Cell("friction", f"{coefficient:g}", (f"losses.terms.friction.coefficient={coefficient:g}",))
    for factor in (0.0, 20.0):
        yield Cell("friction", f"×{factor:g} on the legs", (f"body_friction={{below_pelvis:{factor:g}}}",))


def _motions() -> Iterator[Cell]:
    """Bodies that move too fast, or not at all."""
    for speed in (0.5, 2.0, 4.0, 8.0):
        yield Cell("speed", f"×{speed:g}", (_speed(speed),))
    for kind, unit, amounts in (
        ("teleport", "m", (0.1, 0.3, 0.5, 1.0)),
        ("turn", "degrees", (30.0, 90.0, 180.0)),
        ("spin", "rev/s", (0.5, 1.0, 2.0, 4.0)),
        ("stop", "g", (1.0, 3.0, 10.0)),
        ("fall", "m", (0.5, 2.0)),
        ("offset", "m", (1e2, 1e3, 1e4)),
    ):
        for amount in amounts:
            yield Cell(kind, f"{amount:g} {unit}", motion=f"{kind}:{amount:g}")
    yield Cell("rest", "still", motion="rest", seconds=10.0)


def _poses() -> Iterator[Cell]:
    """Poses and shapes of the body that cloth is caught in."""
    for pose in ("through:100", "through:130", "crossed:110", "crouch:110", "split:45", "reach:80", "handstand:180"):
        yield Cell("pose", pose.replace(":", " "), motion=pose, seconds=2.5)
    for number, word in enumerate(("first", "second")):
        for sign, amount in (("", 4.0), ("minus ", -4.0)):
            yield Cell("body", f"{word} shape {sign}4", (f"betas=[{'0,' * number}{amount:g}]",))


def _garments() -> Iterator[Cell]:
    """Garments that do not fit, and at other resolutions."""
    for size in (0.5, 0.7, 0.85, 1.2, 1.5, 2.0):
        yield Cell("size", f"×{size:g}", fault=f"size:{size:g}")
    yield Cell("resolution", "300", fault="remesh:300", garment="dress")
    yield Cell("resolution", "4k", garment="dress_4k", frames=30)
    yield Cell("resolution", "12k", garment="dress_12k", frames=20)
    yield Cell("resolution", "48k", fault="subdivide:1", garment="dress_12k", frames=6)
    for height in (0.5, 2.0):
        yield Cell("drop", f"{height:g} m", fault=f"sheet:{height:g}", garment="dress", still_body=True)


def _meshes() -> Iterator[Cell]:
    """Faults that meshes have."""
    for power in range(2, 7):
        yield Cell("slivers", f"1e{power}", fault=f"slivers:1e{power}")
    for kind, amounts in (
        ("duplicates", (5, 20, 80)),
        ("isolated", (1, 10, 100)),
        ("flipped", (3, 30, 300)),
        ("irregular", (0.3, 0.6, 0.9)),
        ("components", (2, 5, 10)),
    ):
        for amount in amounts:
            yield Cell(kind, f"{amount:g}", fault=f"{kind}:{amount:g}")


def _pins_and_layers() -> Iterator[Cell]:
    """Cloth that is held by limbs which part, and cloth that is pressed between them."""
    yield Cell("pins", "cuffs of raised arms", ("pins=[cuff_left,cuff_right]",), motion="reach:80", garment="longsleeve")
    yield Cell("pins", "cuffs of crossed arms", ("pins=[cuff_left,cuff_right]",), motion="crossed:110", garment="longsleeve")
    for degrees in (20, 45):
        held = ("pins=[waistband,hem]",)
        yield Cell("pins", f"hem, legs {2 * degrees} degrees apart", held, motion=f"split:{degrees}", garment="skirt")
    held = ("pins=[waistband,hem_left,hem_right]",)
    yield Cell("pins", "trousers, crouching", held, motion="crouch:110", garment="trousers")
    for outfit in ("[tank,skirt]", "[shorts,skirt]", "[tank,trousers]"):
        yield Cell("layers", outfit, garment=outfit)
        yield Cell("layers", f"{outfit} crouching", motion="crouch:110", garment=outfit)
    for friction in (0.5, 2.0):
        yield Cell(
            "layers",
            f"[tank,skirt], friction {friction:g}",
            (f"cloth_contact={{friction:{friction:g}}}",),
            garment="[tank,skirt]",
        )
    for garment, pose in (("dress", "crouch:110"), ("longsleeve", "crossed:110"), ("trousers", "crouch:130")):
        name = f"{garment} {pose.replace(':', ' ')}"
        yield Cell("compression", name, motion=pose, garment=garment)


def _air() -> Iterator[Cell]:
    """Wind, from still air to a storm, and damping of the fabric."""
    for wind, word in (("0", "still air"), ("5", "5 m/s"), ("20", "20 m/s"), ("[40,0,0]", "40 m/s from a side")):
        yield Cell("wind", word, (f"wind={wind}",))
    yield Cell("wind", "10 m/s, gusts of half as much", ("wind=10", "losses.terms.air.gusts=0.5"))
    for seconds in (1e-3, 1e-2, 0.1, 1.0):
        yield Cell("damping", f"{seconds:g} s", (f"damping={seconds:g}",))


def _cloth() -> Iterator[Cell]:
    """Cloth of threads, and cloth that differs from part to part."""
    for name in ("silk_habotai", "denim_12oz", "wool_felt"):
        yield Cell("woven", name, (f"material={name}", "material.woven=true"))
    for factor in (0.1, 10.0, 100.0, 1e3):
        yield Cell("woven", f"warp ×{factor:g}", (f"material.warp={factor:g}",))
    yield Cell("fabrics", "silk below, denim above", ("fabrics={below_waistband:silk,above_waistband:denim}",))
    for factor in (0.01, 100.0, 1e3):
        words = ",".join(f"{name}:{_times(name, factor)}" for name in ("lame_mu", "lame_lambda"))
        yield Cell("fabrics", f"stretching ×{factor:g} below", (f"fabrics={{below_waistband:{{{words}}}}}",))
    for friction in (0.0, 5.0):
        yield Cell("fabrics", f"friction {friction:g} below", (f"fabrics={{below_waistband:{{friction:{friction:g}}}}}",))


def _changes() -> Iterator[Cell]:
    """Garments that grow and shrink, and what opens, closes and comes off on the way."""
    for first, last in ((0.9, 1.1), (1.3, 0.9), (1.0, 1.5)):
        yield Cell("growth", f"×{first:g} to ×{last:g}", (f"size={first:g}", f"size_end={{size:{last:g},seconds:1}}"))
    for factor in (0.8, 1.2):
        yield Cell("growth", f"sleeves ×{factor:g}", (f"size={{sleeves:{factor:g}}}",), garment="longsleeve")
    for garment, row in (("shirt", "front_buttons"), ("jacket", "front_zip")):
        turns = f"[{{time: 0.4, open: {row}}}, {{time: 1.0, close: {row}}}]"
        fast = f"[{{time: 0.4, open: {row}}}, {{time: 1.0, close: {row}, speed: 3}}]"
        yield Cell("events", f"{garment}, slowly", (f"events={turns}",), garment=garment)
        yield Cell("events", f"{garment}, 3 m/s", (f"events={fast}",), garment=garment)
        yield Cell("events", f"{garment}, jog", (f"events={turns}",), garment=garment, sequence="jog")
    yield Cell("events", "skirt comes off", ("events=[{time: 0.5, detach: pins}]",), garment="skirt")


def _pairs() -> Iterator[Cell]:
    """Factors that interact."""
    for fps in (240.0, 60.0, 15.0, 10.0):
        for factor in (0.01, 0.1, 100.0, 1e4):
            yield Cell("dt × stretching", f"1/{fps:g} ×{factor:g}", (f"fps={fps:g}", *_stiffness(factor)), fps=fps)
    for density in (0.01, 1.0, 5.0):
        for factor in (0.01, 0.1, 100.0):
            settings = (f"material.density={density:g}", *_stiffness(factor))
            yield Cell("density × stretching", f"{density:g} ×{factor:g}", settings)
    for speed in (2.0, 4.0):
        for fps in (10.0, 60.0):
            yield Cell("speed × dt", f"×{speed:g} 1/{fps:g}", (_speed(speed), f"fps={fps:g}"), fps=fps)
    for speed in (2.0, 4.0):
        for name, fault, garment in (("300", "remesh:300", "dress"), ("4k", None, "dress_4k")):
            yield Cell("speed × resolution", f"×{speed:g} {name}", (_speed(speed),), fault=fault, garment=garment, frames=30)


def _together() -> Iterator[Cell]:
    """Several extremes at once."""
    soft, stiff, light, heavy = _stiffness(0.1), _stiffness(100.0), ("material.density=0.05",), ("material.density=1",)
    rough, slow, fast, weighty = (
        ("losses.terms.friction.coefficient=2",), ("fps=15",), (_speed(2.0),), (f"gravity={3 * _G:g}",),
    )  # fmt: skip
    for name, settings, motion, fault in (
        ("four: soft light fast rough", (*soft, *light, *fast, *rough), None, None),
        ("four: stiff heavy fast rough", (*stiff, *heavy, *fast, *rough), None, None),
        ("four: stiff light spinning tight", (*stiff, *light), "spin:1", "size:0.85"),
        ("five: soft heavy spinning loose 3 g", (*soft, *heavy, *weighty), "spin:1", "size:1.2"),
        ("five: 1/15 soft fast slivers 3 g", (*slow, *soft, *fast, *weighty), None, "slivers:1e4"),
        ("seven: 1/15 stiff heavy turned rough flipped, another body",
         (*slow, *stiff, *heavy, *rough, "betas=[3]"), "turn:90", "flipped:30"),
        ("eight: 1/15 soft light spinning rough 3 g irregular, another body",
         (*slow, *soft, *light, *rough, *weighty, "betas=[-3]"), "spin:2", "irregular:0.6"),
    ):  # fmt: skip
        yield Cell("together", name, settings, motion, fault, fps=15.0 if slow[0] in settings else 30.0)


def _long() -> Iterator[Cell]:
    """Whether anything grows slowly."""
    yield Cell("long", "rest, 10,000 frames", ("metrics={surface_every:100}",), motion="rest", fault="remesh:300",
               garment="dress", frames=10_000, seconds=334.0, long=True)  # fmt: skip
    yield Cell(
        "long", "walk, 3,000 frames", ("loop=50", "metrics={surface_every:20}"), sequence="walk_proud", frames=3_000, long=True
    )


def _inputs() -> Iterator[Cell]:
    """Input that cannot be used."""
    for name in ("nan:poses", "nan:trans", "nan:betas", "nan:mocap_framerate", "inf:poses", "inf:trans", "empty", "cut"):
        yield Cell("input", f"motion {name}", motion=name, bad_input=name.replace(":", "_") + ".npz")
    for name in (
        "nan:rest_pos", "inf:rest_pos", "nan:uv", "inf:uv", "nan:lbs_weights", "nan:shapedirs", "nan:stiffness", "faces:beyond",
        "faces:negative", "empty", "cut",
    ):  # fmt: skip
        yield Cell("input", f"garment {name}", fault=name, garment="dress", bad_input=name.replace(":", "_") + ".npz")
    for text in (
        "fps=0", "fps=nan", "fps=inf", "num_frames=0", "gravity=nan", "gravity=inf", "file_fps=0", "betas=[nan]", "loop=0",
        "material.density=0", "material.density=nan", "material.density=inf", "material.lame_mu=nan", "material.lame_mu=-1",
        "material.bending_stiffness=nan", "losses.terms.friction.coefficient=nan", "cloth_contact={friction:nan}",
        "pins=[1000000]", "pins=[-1]", "pins=knee", "metrics={surface_every:0}",
    ):  # fmt: skip
        yield Cell("input", text, (text,), bad_input=text.partition("=")[0].rpartition(".")[2])


def _times(name: str, factor: float) -> str:
    return f"{factor * float(getattr(Material(), name)):g}"


def _stiffness(factor: float) -> tuple[str, ...]:
    return tuple(f"material.{name}={_times(name, factor)}" for name in ("lame_mu", "lame_lambda"))


def _speed(factor: float) -> str:
    """The embedded motions are sampled 60 times a second."""
    return f"file_fps={60.0 * factor:g}"
