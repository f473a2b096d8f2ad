"""The command line of a bake: words of ``hood rollout``, whose files are relative to the folder of the bake."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

#: Fabrics of hood; a test compares them with ``hood fabric --help``.
FABRICS = (
    "default",
    "chiffon",
    "coated_nylon",
    "cotton_canvas",
    "cotton_jersey",
    "cotton_poplin",
    "denim",
    "denim_12oz",
    "double_knit",
    "jersey",
    "linen",
    "nappa_leather",
    "silk",
    "silk_crepe",
    "silk_habotai",
    "wool_felt",
    "wool_suiting",
)
#: How far steps are solved: name, what it is for, words.
QUALITIES = (
    (
        "draft",
        "Draft",
        "For shape and fit: steps are solved to 5% of the weight",
        ("solver.target_rg=0.05", "metrics=strain"),
    ),
    ("standard", "Standard", "Steps are solved to 1% of the weight", ()),
    ("fine", "Fine", "For pictures from near: steps are solved to 0.3% of the weight", ("solver.target_rg=0.003",)),
)
BODY, RUN, PINS, GARMENTS = "capture/body.npz", "run", "pins.json", "garments"


@dataclass(frozen=True)
class Garment:
    """One garment of the command."""

    name: str  # of its file
    fabric: str = "default"
    parts: tuple[tuple[str, str], ...] = ()  # part and its fabric, where material slots have their own


@dataclass(frozen=True)
class Request:
    """What is simulated."""

    garments: tuple[Garment, ...]  # from the body outwards
    num_frames: int  # of the scene
    fps: float  # of the scene
    samples: int = 1  # steps per frame of the scene
    gravity: float = 9.81
    wind: tuple[float, float, float] | None = None
    quality: str = "standard"
    pinned: bool = False
    more: tuple[str, ...] = field(default=())  # words that the user or a repair adds; they count last


def words_of(request: Request) -> list[str]:
    """The words behind ``hood``."""
    names = [garment.name for garment in request.garments]
    fabrics = [(part, fabric) for garment in request.garments for part, fabric in _fabrics(garment, request.garments)]
    steps = request.samples * (request.num_frames - 1) + 1
    words = [
        "rollout",
        f"body={BODY}",
        f"garment=[{','.join(f'{GARMENTS}/{name}.obj' for name in names)}]",
        f"material={request.garments[0].fabric}",
        f"num_frames={steps}",
        f"fps={request.samples * request.fps:.12g}",
        f"gravity={request.gravity:.6g}",
        "up=y",
        "unit=m",
        "stepper=newton",
        "weld=none",
        "shells=keep",
        "small_parts=simulate",
        "video=none",
        "sheet=false",
        "formats=[pc2]",
        "resume=true",
        f"output={RUN}",
    ]
    words += [f"output_fps={request.fps:.12g}"] if request.samples > 1 else []
    words += [f"layers=[{','.join(names)}]"] if len(names) > 1 else []
    words += [f"fabrics={{{','.join(f'{part}:{fabric}' for part, fabric in fabrics)}}}"] if fabrics else []
    words += [] if request.wind is None else ["wind=[{:.6g},{:.6g},{:.6g}]".format(*request.wind)]
    words += [f"pins={PINS if request.pinned else 'none'}"]
    words += next(added for name, _, _, added in QUALITIES if name == request.quality)
    return _last_wins([*words, *request.more])


def _fabrics(garment: Garment, all_of_them: Sequence[Garment]) -> list[tuple[str, str]]:
    """Parts and fabrics other than that of the first garment, which is the command's ``material``."""
    if garment.parts:
        return list(garment.parts)
    return [(garment.name, garment.fabric)] if garment.fabric != all_of_them[0].fabric else []


def _last_wins(words: Sequence[str]) -> list[str]:
    """Of words with the same key the last one: hood refuses a key that is given twice."""
    kept: dict[str, str] = {}
    for word in words:
        key = word.partition("=")[0]
        kept.pop(key, None)
        kept[key] = word
    return list(kept.values())
