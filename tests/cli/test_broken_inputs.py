"""Broken inputs of all commands: one line that names the key or the file and says what to give, exit code 2."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from hood.cli.main import main

TRAIN = ["output=run", "trainer.batch_size=1", "trainer.workers=0", "data.garments=[tank]", "data.sequences=[plie]"]


def motion(path: str, frames: int = 8, **changed: object) -> None:
    arrays = {"poses": np.zeros((frames, 156)), "trans": np.zeros((frames, 3)), "betas": np.zeros(16), "mocap_framerate": 30.0}
    np.savez(path, **{**arrays, **changed})


def write(path: str, text: str = "") -> Callable[[], object]:
    return lambda: Path(path).write_text(text, encoding="utf-8")


#: The command's words, pieces of what it says, what makes the input.
BROKEN: dict[str, tuple[list[str], tuple[str, ...], Callable[[], object] | None]] = {
    "no video": (
        ["rollout", "video=false"],
        ("video=false: give text or a list in brackets, such as video=mp4", "mp4, gif or none; png"),
        None,
    ),
    "frames of no video": (
        ["rollout", "video=[none,3]"],
        ("video=[none,3]: give mp4, gif or png, and every how many frames",),
        None,
    ),
    "video of no frames": (
        ["rollout", "video=[mp4,0]"],
        ("video=[mp4,0]: give mp4, gif or png, and every how many frames",),
        None,
    ),
    "another video": (["rollout", "video=mp5"], ("unknown value for video 'mp5': did you mean 'mp4'",), None),
    "dashes": (["rollout", "--video=mp4"], ("write video=mp4",), None),
    "dashes before a file": (["view", "--fps=3"], ("write fps=3", "hood view --help"), None),
    "open bracket": (["rollout", "garment=[tank"], ("close every bracket",), None),
    "several motions": (["rollout", "sequence=[plie,jog]"], ("give one text, not a list", "a folder, a glob"), None),
    "size of nothing": (["rollout", "size=0"], ("size=0: ", "give a factor of the garment, 0.2 to 5"), None),
    "last size": (["rollout", "size_end=wide"], ("size_end=wide: ", "give one factor"), None),
    "time of growing": (["rollout", "size_end={size:1.1,seconds:0}"], ("size_end: seconds is 0; give seconds above 0",), None),
    "precision without a network": (["rollout", "stepper=newton", "precision=fp16"], ("precision", "known are fp32"), None),
    "gender": (["rollout", "gender=man"], ("gender 'man'", "known are neutral, male, female"), None),
    "fingers": (["rollout", "hands=open"], ("hands 'open'", "known are flat, file"), None),
    "first pose": (["rollout", "blend_in=[1,x]"], ("blend_in=[1,x]: give seconds", "a pose, t or a, blend_in=[1,a]"), None),
    "unit of the body": (["rollout", "unit=0"], ("unit=0: give m, cm, mm, or metres per unit", "such as unit=0.01"), None),
    "rate of the file": (["rollout", "file_fps=fast"], ("file_fps=fast: give a number, such as file_fps=120",), None),
    "iterations": (["rollout", "refine=many"], ("refine=many: give a whole number of iterations, or auto",), None),
    "parts of an iteration": (["rollout", "refine=2.5"], ("refine=2.5: give a whole number of iterations, or auto",), None),
    "an event without its list": (
        ["rollout", "events={time: 1.0, open: front_buttons}"],
        ("events={time:1,open:front_buttons}: give a list in brackets",),
        None,
    ),
    "formats in braces": (["rollout", "formats={a:1}"], ("formats={a:1}: give a list in brackets", "formats=[]"), None),
    "exported values": (["rollout", "metrics={fields:[strain]}"], ("strain", "give some of [rg]"), None),
    "energy that another one needs": (
        ["rollout", "losses.terms.collision=null"],
        ("losses.terms.friction takes values from it", "friction=null as well"),
        None,
    ),
    "typo in an outfit": (["rollout", "stepper=newton", "garment=[tank,skrit]"], ("'skrit'", "did you mean 'skirt'"), None),
    "empty mesh": (
        ["rollout", "stepper=newton", "garment=a.obj"],
        ("a.obj: the mesh is empty", "at least one triangle"),
        write("a.obj"),
    ),
    "words in a mesh": (
        ["rollout", "stepper=newton", "garment=a.obj"],
        ("a.obj: line 2 is not readable", "repair or remove the line"),
        write("a.obj", "v 0 0 0\nv a b c\n"),
    ),
    "empty garment file": (
        ["rollout", "stepper=newton", "garment=a.npz"],
        ("a.npz: not a readable garment", "it is empty", "write or download"),
        write("a.npz"),
    ),
    "garment without an ending": (
        ["rollout", "stepper=newton", "garment=my_shirt"],
        ("my_shirt: its name has no ending", "give one of .npz"),
        write("my_shirt", "x"),
    ),
    "body without an ending": (
        ["rollout", "stepper=newton", "body=person"],
        ("person: its name has no ending", "give .npz or .pkl"),
        write("person", "x"),
    ),
    "start after the end": (
        ["rollout", "stepper=newton", "start=99"],
        ("with start=99 fewer than two", "choose a longer part"),
        None,
    ),
    "motion without frames": (
        ["rollout", "stepper=newton", "sequence=m.npz"],
        ("m.npz: poses has no frames", "at least one"),
        lambda: motion("m.npz", frames=0),
    ),
    "no motions": (["rollout", "sequence=."], ("no motions", "give a folder that holds such files"), None),
    "missing pins": (["rollout", "stepper=newton", "pins=no.txt"], ("no.txt: no such file", "check the path"), None),
    "checkpoint of text": (
        ["rollout", "checkpoint=w.pth"],
        ("w.pth: not a readable torch file", "write or download"),
        write("w.pth", "x"),
    ),
    "output is a file": (
        ["rollout", "stepper=newton", "output=o"],
        ("output=o: a file of this name exists", "a folder"),
        write("o", "x"),
    ),
    "output where none can be": (
        ["rollout", "stepper=newton", "output=/proc/o"],
        ("output=/proc/o: ", "choose another output"),
        None,
    ),
    "training seed": (["train", *TRAIN, "seed=-1"], ("seed=-1: must be at least 0",), None),
    "training gap": (["train", *TRAIN, "validation_states=-1"], ("validation_states=-1: must be at least 0",), None),
    "training frames": (["train", *TRAIN, "data.validation_frames=0"], ("data.validation_frames=0: must be at least 2",), None),
    "training rate": (["train", *TRAIN, "data.fps=0"], ("data.fps=0: give the simulation's frames per second",), None),
    "training axis": (["train", *TRAIN, "data.up=w"], ("data.up 'w'", "known are auto, y, z"), None),
    "unusable motions": (["train", *TRAIN, "data.unusable=drop"], ("data.unusable 'drop'", "known are refuse, skip"), None),
    "nothing to wear": (["train", *TRAIN, "data.garments=[]"], ("data.garments=[]: give at least one",), None),
    "one garment as text": (["train", "data.garments=tank"], ("data.garments=tank: give a list in brackets",), None),
    "bodies": (["train", *TRAIN, "data.sampling.beta_range=-1"], ("data.sampling.beta_range is -1; give 0",), None),
    "sizes in the wrong order": (
        ["train", *TRAIN, "data.sampling.size_range=[2,1]"],
        ("size_range is [2, 1]; give the least",),
        None,
    ),
    "sizes of text": (["train", *TRAIN, "data.sampling.size_range=[a,b]"], ("size_range is ['a', 'b']; give the least",), None),
    "one size": (["train", *TRAIN, "data.sampling.size_range=[1]"], ("size_range is [1]; give the least",), None),
    "share": (["train", *TRAIN, "data.sampling.piecewise_fraction=2"], ("piecewise_fraction is 2; give a share",), None),
    "fabric by name": (
        ["train", *TRAIN, "data.sampling.material=silk"],
        ("material=silk: give properties", "density:0.2"),
        None,
    ),
    "fabric's property": (
        ["train", *TRAIN, "data.sampling.material={densty: 1}"],
        ("'densty'", "did you mean 'density'"),
        None,
    ),
    "fabric's value": (["train", *TRAIN, "data.sampling.material={density: a}"], ("density is 'a'; give a number",), None),
    "averages": (["train", *TRAIN, "trainer.ema_decay=2"], ("trainer.ema_decay is 2; it must be",), None),
    "kept iterations": (
        ["train", *TRAIN, "trainer.keep_at=[a]"],
        ("trainer.keep_at is ['a']; iterations are whole numbers",),
        None,
    ),
    "horizon": (["train", *TRAIN, "trainer.horizon.start=0"], ("trainer.horizon.start is 0; it must be at least 1",), None),
    "warm-up": (
        ["train", *TRAIN, "trainer.schedule.warmup=-1"],
        ("trainer.schedule.warmup is -1; it must be at least 0",),
        None,
    ),
    "collision": (
        ["train", *TRAIN, "trainer.collision.start=-1"],
        ("trainer.collision.start is -1; it must be at least 0",),
        None,
    ),
    "clipping": (["train", *TRAIN, "trainer.clip_norm=0"], ("trainer.clip_norm is 0; it must be > 0",), None),
    "evaluated seed": (["evaluate", "models=[newton]", "seed=-1"], ("seed=-1: must be at least 0",), None),
    "map of an unknown motion": (["envelope", "sequence=wlak_proud"], ("'wlak_proud'", "did you mean 'walk_proud'"), None),
    "map beside nothing": (["envelope", "jobs=0"], ("jobs=0: must be at least 1",), None),
    "map without time": (["envelope", "timeout=0"], ("timeout=0: give a number above 0",), None),
    "map's limit": (["envelope", "strain=-1"], ("strain=-1: give a number above 0",), None),
    "map without models": (["envelope", "models=[]"], ("models=[]: give at least one, such as models=[newton]",), None),
    "prepared frame": (["prepare", "garment=tank", "frame=-1"], ("frame=-1: must be at least 0",), None),
    "prepared rate": (["prepare", "garment=tank", "fps=0"], ("fps=0: give the simulation's frames per second",), None),
    "prepared body's axis": (["prepare", "garment=tank", "body_up=w"], ("body_up 'w'", "known are auto, y, z"), None),
    "prepared body's unit": (["prepare", "garment=tank", "body_scale=cm"], ("body_scale=cm: give metres per unit",), None),
    "inspected rate": (["inspect", "dress", "fps=0"], ("fps=0: give the simulation's frames per second",), None),
    "inspected axis": (["inspect", "dress", "up=w"], ("up 'w'", "known are auto, y, z"), None),
    "size of a word": (["sizes", "sizes={S:small}"], ("sizes: S is small; give what size of hood rollout takes",), None),
    "no sizes": (["sizes", "sizes={}"], ("sizes={}: give names and factors",), None),
    "one body": (["sizes", "shapes=[1]"], ("shapes=[1]: give lists of shape coefficients",), None),
    "frames of a size run": (["sizes", "num_frames=0"], ("num_frames=0: must be at least 1",), None),
    "part of a garment": (["rollout", "size={sleeves:wide}"], ("sleeves is 'wide'; give a factor of the part",), None),
    "nothing to view": (["view"], ("number of rollouts given: 0", "hood view rollout.h5"), None),
    "nothing to export": (["export"], ("number of rollouts given: 0; give one",), None),
    "one to compare": (["compare", "a.h5"], ("number of rollouts given: 1; give two or more",), None),
}


@pytest.mark.parametrize("what", BROKEN)
def test_a_broken_input_is_told_in_one_line_with_the_fix(
    what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    words, told, make = BROKEN[what]
    if make is not None:
        make()
    assert main(words) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1, said
    assert said.startswith("hood: error: ")
    assert all(piece in said for piece in told), said
    assert not Path("run").exists()
