"""What a design of a sewing pattern is: how it is drawn, and the options it takes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import SimpleNamespace

from hood.assets.pattern.blocks import Table
from hood.assets.pattern.measures import Measures

#: What an option means, by its name.
MEANINGS = {
    "ease": "what the garment is wider than chest and hips, as a share of them",
    "length": "from the waist to the hem, as a share of the waist's height; of trousers, a share of the inside leg",
    "sleeve": "length of the sleeves, as a share of the arm; below 0.1 there are none",
    "cuff": "height of the cuffs [m]; below 0.02 there are none",
    "wide": "hem of the sleeves, as a share of their usual width there",
    "puff": "length of the sleeve's cap over that of the armhole; above 1.05 it is gathered",
    "depth": "of the neckline in front, as a share of the way to the waist",
    "width": "of the neckline, as a share of the shoulder that it leaves free",
    "strap": "where the shoulder ends, as a share of its length",
    "shape": "of the neckline",
    "collar": "of the neckline",
    "front": "what closes the front: buttons, a zip, or nothing, as it is one piece",
    "lapel": "width of the lapels [m]",
    "fit": "1: the side seams follow the waist; 0: they are straight",
    "flare": "what the hem is wider than the hips, as a share",
    "gathers": "length of a gathered edge over that of the one which it is sewn to",
    "tiers": "number of gathered rows",
    "pleats": "number of pleats all around; an odd one is rounded",
    "pleat": "what the pleats are: knife, all to one side, or box, to both sides in turn",
    "under": "what each pleat hides, as a share of the most that lies flat under it",
    "overlap": "of the two fronts at the hem, as a share of half its width that the outer one reaches beyond the middle",
    "bib": "height of the bib, as a share of the way from the waist to the shoulder",
    "straps": "where they go: neck, around it, or back, over the shoulders to the waist",
    "circle": "share of a circle that the skirt is cut from",
    "band": "height of the waistband [m]",
    "rib": "length of the ribbing of band and cuffs over that of the body in it",
    "tube": "height of the tubes that quilting makes [m]",
    "rise": "of the upper edge over the waist [m]",
    "knee": "what the leg is wider than the knee, as a share",
    "turn": "height of what is turned up at the hems [m]; below 0.02 nothing is",
    "hem": "width of the leg at its hem, as a share of that above it",
}
Choices = tuple[float, float, float] | tuple[str, ...]
#: Chosen options: numbers and words by their names.
Options = SimpleNamespace


@dataclass(frozen=True)
class Design:
    """A design: how it is drawn, and its options: (default, least, most) of numbers, else words of which the first is taken."""

    draw: Callable[[Table, Measures, Options], None]
    options: Mapping[str, Choices]


def entered(known: dict[str, Design], **options: Choices) -> Callable[[Callable[[Table, Measures, Options], None]], None]:
    """Enter a function among the known designs, by its name."""

    def enter(draw: Callable[[Table, Measures, Options], None]) -> None:
        known[draw.__name__.removeprefix("_")] = Design(draw, options)

    return enter
