"""hood beside other open simulators, with equal cloth, body and motion, on one thread of a CPU.

    python benchmarks/peers.py drape_1k                                      # 1,024 vertices hang from two corners, 1 s
    python benchmarks/peers.py drape_4k --methods newton vbd:10x10 xpbd:40x5 mujoco-discrete:1
    python benchmarks/peers.py body --frames 60 --picture outputs/peers.png  # the dress on the embedded body, walk_proud
    python benchmarks/peers.py drape_1k --stretch 10                         # a fabric ten times as hard to stretch
    python benchmarks/peers.py drape_1k --one-step                           # the error of one frame, under two energies
    python benchmarks/peers.py curtain_1k --self-contact                     # cloth is kept off cloth, where a program can

The others are no part of hood: NVIDIA Newton (``pip install newton==1.8.0 warp-lang==1.19.0``), of which ``vbd:SxI``,
``xpbd:SxI`` and ``style3d:SxI`` are its solvers VBD, XPBD and Style3D with S substeps a frame of I iterations each (in
``style3d:SxIxL`` of L linear ones instead of 10), and MuJoCo (``pip install mujoco==4.0.0``) with S steps a frame,
``mujoco-discrete:S`` and ``mujoco-Euler:S``. By ``vbd:SxI:R`` contact sets in at R mm instead of 2, by ``vbd-surface:SxI``
edges and faces touch the body as well. hood's are ``newton`` (its solver, as
``stepper=newton``), ``newton:S`` (the same with S steps a frame), weights, ``weights+K`` refined by K iterations, and
``guess+K`` (as ``stepper=refine``). How the fabric is said in the terms of the others is in ``peer_newton.py``,
``peer_style3d.py`` and ``peer_mujoco.py``.

All methods start from the same positions and velocities and go frame by frame in turns: a busy machine slows all of them. A row
a method: median CPU milliseconds of a frame; mean 99th percentile of the edge strain; of the frames that --stride says the mean
share of the cloth's triangles that the skin cuts, the greatest height of skin above the cloth, the most pairs of triangles of
cloth that pass through each other, and the median γ; and of a sheet
at the end the energy of stretching, bending and gravity above the minimum at rest, and the kinetic energy. γ is the energy that
a frame leaves above the exact implicit step of hood's potential, from the method's own state: whoever divides a frame into
substeps follows another path through it, and γ is large for that alone.

``--one-step`` gives every method the same states, of hood's solver, and lets it take one frame: γ of hood's potential, and of
VBD's and Style3D's first substep as well that of their own energy, above the minimum that L-BFGS finds of it. For a sheet.
``--rest``: where a sheet comes to rest by the energies of hood, VBD and Style3D, above hood's rest by hood's energy.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import peer_laws
import peer_mujoco
import peer_newton
import torch
from peer_scenes import (
    SCENES,
    SHEETS,
    CannotDoError,
    Measures,
    Moment,
    Row,
    Setting,
    Simulation,
    gamma,
    make_potential,
    make_setting,
    problem_at,
    static_minimum,
)

from hood.app.candidates import machine_name
from hood.assets.files.library import locate
from hood.energies.potential import Potential
from hood.energies.self_contact import for_networks
from hood.media.renderer.raster import Camera
from hood.media.renderer.render import BODY_COLOR, RenderMesh, captioned, render_frame
from hood.media.video import save_png
from hood.model.network.kernel_choice import choose_kernels
from hood.rollouts.frame import Frame
from hood.rollouts.loop import simulate
from hood.solver.newton import NewtonSettings
from hood.steppers.checkpoint import load_simulator
from hood.steppers.newton import NewtonStepper, Stepper
from hood.steppers.refined import GuessStepper, RefinedStepper, prepare_stepper
from hood.steppers.stopping import Count

VBD = ("vbd:10x5", "vbd:10x10", "vbd:10x20", "vbd:20x10")
STYLE3D = ("style3d:1x10", "style3d:1x50", "style3d:10x5", "style3d:10x10")
XPBD = ("xpbd:10x10", "xpbd:20x2", "xpbd:20x10", "xpbd:40x5")
MUJOCO = ("mujoco-discrete:1", "mujoco-discrete:10", "mujoco-Euler:40")
HOOD = ("newton", "newton:10", "guess+5", "quickstart", "quickstart+5")
HEADER = (
    f"{'':22}{'ms':>9}{'strain p99':>12}{'cut':>8}{'skin, mm':>10}{'crossed':>9}{'gamma':>10}{'above rest, mJ':>16}"
    f"{'kinetic, mJ':>13}"
)
#: A cloth whose edges are longer by so many times their length has come apart.
DIVERGED = 3.0
#: Frames whose states single steps are taken from.
STEPS_FROM = (5, 15, 25)


class Hood:
    """A scene in hood, from frame 0."""

    def __init__(self, setting: Setting, name: str, potential: Potential) -> None:
        self.name = f"hood {name}"
        base, _, substeps = name.partition(":")
        self._substeps = int(substeps or 1)
        self.stepper, dtype = make_stepper(base, potential)
        self.scene, count = setting.at(dtype, self._substeps), (setting.num_frames - 1) * self._substeps + 1
        self._frames: Iterator[Frame] = simulate(self.stepper, self.scene, potential, count, 0, metrics="none")
        self._now = next(self._frames)

    def step(self) -> float:
        """From one frame to the next; CPU milliseconds, the body's poses among them."""
        began = time.process_time()
        for _ in range(self._substeps):
            self._now = next(self._frames)
        return 1e3 * (time.process_time() - began)

    def now(self) -> Moment:
        """The cloth at this frame."""
        return Moment(self._now.world_pos.numpy(), self._now.state.vel.double().numpy())


def make_stepper(name: str, potential: Potential) -> tuple[Stepper, torch.dtype]:
    """hood's stepper of a name, and the precision it takes its steps in."""
    base, _, count = name.partition("+")
    if base == "newton":
        return NewtonStepper(potential, NewtonSettings(target_rg=1e-2)), torch.float64
    if base == "guess":
        return RefinedStepper(GuessStepper(potential), potential, Count(int(count or 1))), torch.float64
    simulator = load_simulator(locate("weights", base)).eval()
    simulator.network.use_kernels(choose_kernels("fp32", simulator.network.latent_dim, torch.device("cpu")).kernels)
    simulator.use_potential(for_networks(potential))
    return (RefinedStepper(simulator, potential, Count(int(count))), torch.float64) if count else (simulator, torch.float32)


def make_method(name: str, setting: Setting, potential: Potential) -> Simulation:
    """A method by its name.

    Raises:
        CannotDoError: it cannot do the scene.
        SystemExit: its package is not installed.
    """
    kind, _, effort = name.partition(":")
    if kind in ("vbd", "vbd-surface", "xpbd", "style3d"):
        counts, _, radius = effort.partition(":")
        substeps, iterations, *linear = map(int, counts.split("x"))
        solver, surface = kind.removesuffix("-surface"), kind == "vbd-surface"
        chosen = peer_newton.Effort(solver, substeps, iterations, surface=surface, self_contact=setting.self_contact)
        chosen = replace(chosen, linear=linear[0]) if linear else chosen
        return peer_newton.Newton(setting, replace(chosen, radius=1e-3 * float(radius)) if radius else chosen)
    if kind.startswith("mujoco-"):
        return peer_mujoco.MuJoCo(setting, peer_mujoco.Effort(kind.removeprefix("mujoco-"), int(effort)))
    return Hood(setting, name, potential)


def line(row: Row) -> str:
    """A row of the table; what a scene does not have is a dash."""

    if not row.strain < DIVERGED:
        return f"{row.name:22}{row.ms:>9.1f}  diverged"

    def known(value: float, form: str) -> str:
        return format(value, form) if np.isfinite(value) else "-"

    return (
        f"{row.name:22}{row.ms:>9.1f}{row.strain:>12.3f}{known(row.cut, '.2%'):>8}{known(1e3 * row.depth, '.1f'):>10}"
        f"{known(row.crossed, '.0f'):>9}"
        f"{known(row.gamma, '.3g'):>10}{known(1e3 * row.energy, '.2f'):>16}{1e3 * row.kinetic:>13.2f}"
    )


def compare(
    setting: Setting, names: Sequence[str], potential: Potential, stride: int
) -> tuple[list[Row], dict[str, np.ndarray]]:
    """All methods through the setting, frame by frame in turns: their rows, and the last positions (V, 3) by name."""
    methods: list[Simulation] = []
    for name in names:
        try:
            methods.append(make_method(name, setting, potential))
        except CannotDoError as refusal:
            print(f"{name}: left out, {refusal}")
    measures = [Measures(setting, potential, stride) for _ in methods]
    for frame in range(1, setting.num_frames):
        for method, measure in zip(methods, measures, strict=True):
            ms = method.step()
            measure.see(frame, ms, method.now())
    minimum = min(static_minimum(setting, potential, method.now().pos) for method in methods if isinstance(method, Hood))
    if setting.name in SHEETS:
        print(f"at rest: {minimum:.6f} J, the lowest that hood's solver comes to from the last frames of hood's methods")
    rows = [measure.row(method.name, minimum) for method, measure in zip(methods, measures, strict=True)]
    whole = [method for method, row in zip(methods, rows, strict=True) if row.strain < DIVERGED]
    return rows, {method.name: method.now().pos for method in whole}


def draw(setting: Setting, last: dict[str, np.ndarray], path: Path) -> None:
    """The last frame of every method, at most six in a row."""
    faces, body = setting.cloth.faces.numpy(), setting.body[-1]
    cloud = np.concatenate([body.reshape(-1, 3), setting.start.pos, *last.values()])
    camera = Camera.framing(cloud, azimuth_deg=25.0, aspect=200 / 364)
    pictures = []
    for name, pos in last.items():
        skin = [RenderMesh(body, setting.scene.motion.faces, BODY_COLOR)] if len(body) else []
        floor = float(cloud[:, 1].min()) - 0.01
        pictures.append(captioned(render_frame([*skin, RenderMesh(pos, faces)], camera, 200, 364, floor=floor), name))
    columns = math.ceil(len(pictures) / math.ceil(len(pictures) / 6))
    pictures += [np.full_like(pictures[0], 255)] * (-len(pictures) % columns)
    rows = [np.concatenate(pictures[start : start + columns], axis=1) for start in range(0, len(pictures), columns)]
    save_png(path, np.concatenate(rows))


def one_steps(setting: Setting, names: Sequence[str], potential: Potential) -> None:
    """Single steps of a whole frame from the same states: a line a method."""
    steady = Hood(setting, "newton", potential)
    states = {}
    for frame in range(1, max(STEPS_FROM) + 1):
        steady.step()
        states[frame] = steady.now()
    own = peer_laws.own_potentials(setting, potential)
    print(f"{'':22}{'ms':>9}{'gamma':>10}{'gamma, own':>12}")
    for name in names:
        take = _taking(name, setting, potential)
        times, ours, theirs = [], [], []
        for frame in STEPS_FROM:
            take(frame, states[frame])  # warm
            ms, pos = take(frame, states[frame])
            times.append(ms)
            ours.append(gamma(setting, potential, frame, states[frame], pos))
            if (kind := name.partition(":")[0]) in own:
                theirs.append(_own_gamma(own[kind], name, setting, potential, frame, states[frame]))
        shown = f"{np.median(theirs):.3g}" if theirs else "-"
        print(f"{name:22}{np.median(times):>9.1f}{np.median(ours):>10.3g}{shown:>12}", flush=True)


def _own_gamma(own: Potential, name: str, setting: Setting, potential: Potential, frame: int, moment: Moment) -> float:
    """γ of Newton's first substep from a state, of the solver's own energy."""
    method = make_method(name, setting, potential)
    assert isinstance(method, peer_newton.Newton)
    method.put(moment, frame)
    method.substep()
    problem, origin = problem_at(setting, frame, moment)
    dt = problem.step.dt / method.effort.substeps
    return peer_laws.own_gamma(own, replace(problem, step=replace(problem.step, dt=dt)), origin, method.now().pos)


def _taking(name: str, setting: Setting, potential: Potential) -> Callable[[int, Moment], tuple[float, np.ndarray]]:
    """What takes one step from a frame and a state: CPU milliseconds and positions (V, 3) [m]."""
    method = make_method(name, setting, potential)
    if not isinstance(method, Hood):

        def by_peer(frame: int, moment: Moment) -> tuple[float, np.ndarray]:
            method.put(moment, frame)  # type: ignore[attr-defined]
            return method.step(), method.now().pos

        return by_peer
    stepper, prepared = method.stepper, prepare_stepper(method.stepper, method.scene)

    def by_hood(frame: int, moment: Moment) -> tuple[float, np.ndarray]:
        problem, origin = problem_at(setting, frame, moment, method.scene)
        began = time.process_time()
        with torch.no_grad():
            prediction = stepper.predict(stepper.search(problem), prepared)
        return 1e3 * (time.process_time() - began), prediction.next_pos.double().numpy() + origin

    return by_hood


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", choices=SCENES)
    parser.add_argument("--methods", nargs="+", default=(*HOOD, *VBD, *STYLE3D, *XPBD, *MUJOCO), help="see above")
    parser.add_argument("--frames", type=int, default=31, help="with frame 0")
    parser.add_argument("--stride", type=int, default=10, help="of the frames whose surface and gamma are measured")
    parser.add_argument("--stretch", type=float, default=1.0, help="how many times as hard to stretch the fabric is")
    parser.add_argument("--picture", type=Path, default=None, help="a PNG of the last frame of all methods")
    parser.add_argument("--one-step", action="store_true", help="single steps from the same states instead")
    parser.add_argument(
        "--rest", action="store_true", help="where a sheet rests by the energies of hood, VBD and Style3D instead"
    )
    parser.add_argument("--self-contact", action="store_true", help="cloth is kept off cloth")
    chosen = parser.parse_args(arguments)
    torch.set_num_threads(1)
    potential = make_potential(chosen.self_contact)
    setting = make_setting(chosen.scene, chosen.frames, potential, chosen.stretch)
    print(f"{chosen.scene}: {setting.cloth.num_vertices} vertices, {chosen.frames} frames, {machine_name('cpu')}", flush=True)
    if chosen.rest:
        peer_laws.rests(setting, potential)
        return
    if chosen.one_step:
        one_steps(setting, chosen.methods, potential)
        return
    rows, last = compare(setting, chosen.methods, potential, chosen.stride)
    print(HEADER)
    for row in rows:
        print(line(row))
    if chosen.picture is not None:
        draw(setting, last, chosen.picture)


if __name__ == "__main__":
    main()
