"""The published layouts by their keys: what each holds, its custom of the up axis, and the frame rate of its recordings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

#: Numbers of one rotation: axis-angle vectors, quaternions, 6D, matrices.
PER_TURN = (3, 4, 6, 9)
#: Numbers of joints of a whole skeleton: without hands, SMPL, SMPL-H, SMPL-X.
WHOLE = (22, 24, 52, 55)
_ROOT, _BODY = (1,), (21, 23)
#: The joints that a key of rotations holds: how many, from which on.
_COUNTS: dict[str, tuple[tuple[int, ...], int]] = {
    "rootorient": (_ROOT, 0), "globalorient": (_ROOT, 0), "posesroot": (_ROOT, 0), "worldglobalrots": (_ROOT, 0),
    "posebody": (_BODY, 1), "bodypose": (_BODY, 1), "posesbody": (_BODY, 1),
}  # fmt: skip
#: Keys of a translation in the world, and of one in front of a camera.
WORLD_TRANSL = (
    "trans", "transl", "translation", "smpltrans", "smpltransl", "transworld", "worldtrans", "roottrans", "roottranslation",
)  # fmt: skip
CAMERA_TRANSL = ("predtrans", "predcamt", "camt", "camtrans", "transcam", "cameratranslation", "camera", "cameratransl")
#: A frame rate of recordings from video, where their layout says none.
VIDEO_FPS = 30.0


@dataclass(frozen=True)
class MotionLayout:
    """How a published file is told by its keys; keys are in lower case, without signs.

    ``fps`` is the rate that recordings of the layout are known to have where no file says it; None: a file must say it.
    """

    name: str
    poses: tuple[str, ...]  # keys of the joint rotations, in the order of the joints
    transl: tuple[str, ...] = WORLD_TRANSL  # keys that may hold the translation, the first counts
    marks: tuple[str, ...] = ()  # keys of which one must be there as well
    above: str = ""  # key of the dict that the layout stands in
    fps: float | None = VIDEO_FPS
    up: str = "y"
    camera: bool = False  # as seen from a camera, which need not be level
    family: str | None = None  # None: by the number of joints
    scaling: str = ""  # key of the number by which its translation is larger than metres
    ids: tuple[str, ...] = field(default=())  # keys of the person that each row is of

    def fits(self, keys: Mapping[str, str], above: str) -> bool:
        """Whether a dict with these keys under the key ``above`` is of this layout."""
        marked = not self.marks or any(mark in keys for mark in self.marks)
        placed = not self.above or self.above == above
        return marked and placed and all(key in keys for key in self.poses)


def counts_of(key: str) -> tuple[tuple[int, ...], int]:
    """How many joints a squeezed key of rotations may hold, and from which on."""
    return _COUNTS.get(key, (WHOLE, 0))


def layout_sizes(key: str) -> set[int]:
    """How many numbers a pose under a squeezed key of rotations may have, in whatever representation."""
    return {count * per for count in counts_of(key)[0] for per in PER_TURN}


_TRACKS = ("trackids", "trackedids", "tid", "subjectids")
#: In the order in which they are tried: those told by special keys before those whose keys others have as well.
LAYOUTS = (
    MotionLayout("AIST++", ("smplposes",), ("smpltrans",), ("smplscaling",), fps=60.0, family="smpl", scaling="smplscaling"),
    MotionLayout("3DPW", ("poses",), marks=("poses60hz", "vtemplateclothed", "camposevalid", "camposes"), family="smpl"),
    MotionLayout("EMDB", ("posesroot", "posesbody"), family="smpl"),
    MotionLayout("BEDLAM labels", ("poseworld",), ("transworld",), marks=("imgname",), family="smplx"),
    MotionLayout("BEDLAM labels", ("posecam",), ("transcam",), marks=("imgname",), camera=True, up="-y", family="smplx"),
    MotionLayout("WHAM", ("poseworld",), ("transworld",), family="smpl"),
    MotionLayout("GVHMR", ("globalorient", "bodypose"), above="smplparamsglobal", family="smplx"),
    MotionLayout("GVHMR, in its camera", ("globalorient", "bodypose"), above="smplparamsincam", camera=True, up="-y",
           family="smplx"),
    MotionLayout(
        "SLAHMR", ("rootorient", "posebody"), marks=("trackmask", "floorplane", "worldscale", "latentpose", "camr"),
        camera=True, up="-y", family="smplh",
    ),
    MotionLayout("TRACE", ("worldglobalrots", "smplthetas"), ("worldtrans",), family="smpl", up="-y", camera=True, ids=_TRACKS),
    MotionLayout("ROMP", ("smplthetas",), CAMERA_TRANSL, camera=True, up="-y", family="smpl", ids=_TRACKS),
    MotionLayout("TRAM", ("predrotmat",), CAMERA_TRANSL, camera=True, up="-y", family="smpl"),
    MotionLayout("Motion-X", ("rootorient", "posebody"), above="motionx", family="smplx"),
    MotionLayout("MDM", ("thetas",), ("roottranslation",), fps=20.0, family="smpl"),
    MotionLayout("GRAB", ("fullpose",), above="params", fps=None, up="z"),
    MotionLayout("SMPL-X stage ii", ("fullpose",), marks=("stageiidebugdetails", "markerslatent"), fps=None, up="z"),
    MotionLayout("fullpose", ("fullpose",), fps=None, up="z"),
    MotionLayout("PHC", ("poseaa",), ("trans", "transorig", "roottransoffset"), up="z"),
    MotionLayout("HybrIK", ("predthetas",), ("transl", *CAMERA_TRANSL), camera=True, up="-y", family="smpl"),
    MotionLayout("AMASS", ("poses",), fps=None, up="z"),
    MotionLayout("AMASS", ("rootorient", "posebody"), fps=None, up="z"),
    MotionLayout("body_pose", ("globalorient", "bodypose")),
    MotionLayout("pose and translation", ("pose",)),
    MotionLayout("image estimator", ("globalorient", "bodypose"), CAMERA_TRANSL, CAMERA_TRANSL, camera=True, up="-y"),
    MotionLayout("image estimator", ("pose",), CAMERA_TRANSL, CAMERA_TRANSL, camera=True, up="-y"),
    MotionLayout("SMPL poses", ("smplposes",)),
    MotionLayout("SMPL poses", ("smplpose",)),
    MotionLayout("SMPL poses", ("thetas",)),
)  # fmt: skip


def find_layout(keys: Mapping[str, str], above: str = "") -> MotionLayout | None:
    """The layout of a dict with the squeezed ``keys``; one whose translation is there goes before one where it is not."""
    fitting = [layout for layout in LAYOUTS if layout.fits(keys, above)]
    return next((layout for layout in fitting if any(key in keys for key in layout.transl)), next(iter(fitting), None))
