"""Runs commands of hood on the stand-in device and on the CPU, and says what came of it: ``python ways.py FOLDER NAME …``.

One process for all of them: importing torch and hood takes as long as a rollout of three frames. Prints a line of JSON a way.
"""

from __future__ import annotations

import contextlib
import csv
import io
import json
import shutil
import sys
import traceback
import types
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import standin
import torch
from safetensors.torch import load_file
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

SHORT = ("num_frames=4", "video=none", "sheet=false")
NETWORK = ("checkpoint=quickstart", "refine=0", "kernels=torch")
SOLVER = ("stepper=newton",)
PLAIN = ("metrics=none", "guard=off")

#: The command of each way.
ROLLOUTS: dict[str, tuple[str, ...]] = {
    "network": ("garment=tshirt", *NETWORK, "step=plain"),
    "network captured by itself": ("garment=tshirt", *NETWORK),
    "network fixed": ("garment=tshirt", *NETWORK, *PLAIN, "step=fixed"),
    "network captured": ("garment=tshirt", *NETWORK, *PLAIN, "step=captured"),
    "paper's features": ("garment=tshirt", "checkpoint=small-ours", "refine=0", "settle=paper", "step=plain"),
    "network captured with elastic": ("garment=tshirt", "size={hem:{elastic:0.85}}", *NETWORK, *PLAIN, "step=captured"),
    "solver": ("garment=tshirt", *SOLVER),
    "solver captured": ("garment=tshirt", *SOLVER, *PLAIN, "step=captured"),
    "refined": ("garment=tshirt", "checkpoint=quickstart", "refine=2"),
    "refined captured": ("garment=tshirt", "checkpoint=quickstart", "refine=2", "kernels=torch", *PLAIN, "step=captured"),
    "outfit": ("garment=[tank,skirt]", "sequence=plie", *SOLVER, "num_frames=3"),
    "fasteners": ("garment=jacket", *SOLVER, "events=[{frame: 1, open: front_zip}]", "num_frames=3"),
}
TRAINING = (
    "experiment=quickstart",
    "model=small",
    "trainer.statistics_iterations=1",
    "trainer.workers=0",
    "data.garments=[tshirt]",
)


def main(folder: Path, names: list[str]) -> None:
    for name in names:
        text = io.StringIO()
        try:
            with contextlib.redirect_stdout(text), contextlib.redirect_stderr(text):
                found = run(name, folder / name.replace(" ", "_"))
        except BaseException:  # what a command may raise is what is looked for
            found = {"error": traceback.format_exc()}
        print(json.dumps({"way": name, "text": text.getvalue()[-3000:]} | found), flush=True)


def run(name: str, folder: Path) -> dict[str, object]:
    if name in OTHERS:
        return OTHERS[name](folder)
    words = (*SHORT, *ROLLOUTS[name])
    with one_start():
        codes = {device: command("rollout", *words, device, folder) for device in ("cpu", "standin")}
    waits = {key: number for key, number in torch.standin.counts().items() if key.startswith("sync")}
    return {"codes": codes, "apart": apart(folder), "waits": waits, "recorded": list(standin.recorded)}


@contextlib.contextmanager
def one_start() -> Iterator[None]:
    """The cloth is settled once, for both devices: where it comes to rest depends on the last bit."""
    from hood.rollouts import loop

    settle, found = loop.find_equilibrium, []

    def again(scene: Any, potential: Any, state: Any, *arguments: Any, **options: Any) -> Any:
        if not found:
            found.append(settle(scene, potential, state, *arguments, **options))
        return replace(found[0], pos=found[0].pos.to(state.pos))

    loop.find_equilibrium = again
    try:
        yield
    finally:
        loop.find_equilibrium = settle


def command(name: str, *words: str | Path) -> int:
    """The exit code of a command; the last two words are a device and a folder. A CPU has no graphs: steps are fixed there, and
    the solver is that of a GPU: the compiled one comes as near to a minimum by other ways."""
    from hood.cli.main import main as hood

    *given, device, folder = map(str, words)
    given = [word.replace("step=captured", "step=fixed") if device == "cpu" else word for word in given]
    given += ["solver.engine=torch"] if (name, device) == ("rollout", "cpu") else []
    torch.standin.forget()
    standin.recorded.clear()
    return hood([name, *given, f"device={device}", f"output={folder}/{device}"])


def apart(folder: Path) -> float:
    """Greatest distance [m] of vertices of the two rollouts; infinite where one is not finite."""
    return between(*(folder / device / "rollout.h5" for device in ("cpu", "standin")))


def between(*paths: Path) -> float:
    """The same of two files."""
    from hood.rollouts.file.reader import read_rollout

    first, second = (read_rollout(path).cloth_pos for path in paths)
    most = float(abs(first - second).max())
    return most if most == most else float("inf")


def train(folder: Path, *more: str) -> dict[str, object]:
    """Four updates on the CPU and on the device, and there the last two again, resumed."""
    words = (*TRAINING, "trainer.iterations=4", "trainer.keep_at=[2]", *more)
    codes = {device: command("train", *words, device, folder) for device in ("cpu", "standin")}
    shutil.copytree(folder / "standin", folder / "half" / "standin")
    shutil.copy(next((folder / "standin" / "kept").glob("*.pt")), folder / "half" / "standin" / "checkpoint.pt")
    codes["resumed"] = command("train", *words, "resume=true", "standin", folder / "half")
    cpu, whole, halves = (load_file(folder / one / "model.safetensors") for one in ("cpu", "standin", "half/standin"))
    same = all(torch.equal(whole[key], halves[key]) for key in whole)
    return {
        "codes": codes,
        "same": same,
        "apart": max(float((whole[key].double() - cpu[key].double()).abs().max()) for key in whole),
    }


class Launches(TorchDispatchMode):
    """Counts operations on the device; those on lists of tensors, which are a kernel or two, once."""

    def __init__(self) -> None:
        from hood.steppers.static_shapes.cuda_graph import VIEWS

        super().__init__()
        self.count, self._nothing = 0, (*VIEWS, "empty", "empty_like", "empty_strided", "new_empty")

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        out = function(*args, **(kwargs or {}))
        given = tree_leaves((args, kwargs, out))
        here = any(isinstance(one, torch.Tensor) and one.device.type == "standin" for one in given)
        self.count += here and function._opname not in self._nothing
        return out


def launches(folder: Path) -> dict[str, object]:
    """Operations and waits in the cheapest update of the paper's model, one in which no scene begins, and waits of a read of
    several updates, by how they are taken."""
    from hood.training.trainer import Trainer

    methods, found = {name: getattr(Trainer, name) for name in ("begin", "look")}, {}
    words = ("experiment=paper_fast", "model.latent_dim=8", *TRAINING[2:], "trainer.iterations=9", "trainer.horizon.every=2")
    words += ("trainer.collision.begin_iteration=2", "trainer.collision.end_iteration=9", "trainer.schedule.every=9")
    for step in ("plain", "captured"):
        counted: dict[str, list[tuple[int, int]]] = {name: [] for name in methods}

        def counting(name: str, counted: dict[str, list[tuple[int, int]]] = counted) -> Any:
            def counted_method(trainer: Any) -> Any:
                torch.standin.forget()
                with Launches() as launched:
                    came = methods[name](trainer)
                calls = torch.standin.counts()
                counted[name].append((launched.count, sum(number for key, number in calls.items() if key.startswith("sync"))))
                return came

            return counted_method

        for name in methods:
            setattr(Trainer, name, counting(name))
        try:
            code = command("train", *words, f"trainer.step={step}", "standin", folder / step)
        finally:
            for name in methods:
                setattr(Trainer, name, methods[name])
        found[step] = {"code": code, "launches and waits": min(counted["begin"][1:]), "recorded": list(standin.recorded)}
        found[step] |= {"all": counted["begin"], "reads": [waits for _, waits in counted["look"]]}
    return found


def evaluate(folder: Path) -> dict[str, object]:
    words = ("models=[quickstart,newton]", "garments=[tshirt]", "num_frames=4", "gap_states=1", "gap_iterations=5")
    codes = {device: command("evaluate", *words, device, folder) for device in ("cpu", "standin")}
    rows = [json.loads((folder / device / "table.json").read_text()) for device in ("cpu", "standin")]
    return {"codes": codes, "rows": [len(one) for one in rows]}


#: Runs a job of ``benchmarks/gpu.py`` there. Times mean nothing; constants are those of a data sheet.
JOB_ON_STANDIN = "import standin, ways; ways.benchmark_job()"


def benchmark_job() -> None:
    place = Path(__file__).parents[2] / "benchmarks" / "gpu_frames.py"
    module = types.ModuleType("gpu_frames_on_standin")
    sys.modules[module.__name__] = module
    sys.path.insert(0, str(place.parent))
    exec(compile(standin.otherwise(place.read_text(encoding="utf-8")), str(place), "exec"), vars(module))
    vars(module).update(
        measured_device=lambda: module.DATA_SHEETS["h100"],
        count_launches=lambda call: (call(), 0)[1],
        device_memory=lambda call: (call(), 0.0)[1],
    )
    module.main()


def benchmark(folder: Path) -> dict[str, object]:
    """Jobs of ``benchmarks/gpu.py`` on one small garment: rows of those that end, a line of one that does not."""
    sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
    import gpu

    folder.mkdir()
    gpu.COMMAND, gpu.COUNTS = (sys.executable, "-P", "-c", JOB_ON_STANDIN), (2,)
    words = ["--sizes", "1000", "--models", "small-ours", "nosuch", "--minutes", "8", "--csv", str(folder / "gpu.csv")]
    sys.argv = ["gpu.py", *words]
    code = gpu.main()
    rows = list(csv.DictReader((folder / "gpu.csv").read_text().splitlines()))
    return {"code": code, "ways": sorted({f"{row['method']} {row['way']}" for row in rows})}


#: A check of a GPU as it is, and one that a core can take.
SMALLER = (
    ("trainer.statistics_iterations=10", "trainer.statistics_iterations=2"),
    ("trainer.iterations=60", "trainer.iterations=12"),
    ("trainer.log_every=10", "trainer.log_every=2"),
    ('"experiment=paper_fast", "trainer.schedule.every=60", "trainer.horizon.every=20"',
     '"experiment=paper_fast", "trainer.schedule.every=12", "trainer.horizon.every=4", "model.latent_dim=16", '
     '"data.garments=[tshirt]"'),
    ("trainer.collision.begin_iteration=20", "trainer.collision.begin_iteration=4"),
    ("trainer.collision.end_iteration=40", "trainer.collision.end_iteration=8"),
    ('"experiment=quickstart"', '"experiment=quickstart", "model=small", "data.garments=[tshirt]"'),
    ("num_frames=10", "num_frames=4"),
    ("checkpoint=quickstart", "checkpoint=small3"),
    ("models=[quickstart,newton]", "models=[small3,newton]"),
)  # fmt: skip
#: Begins a command of hood there.
ON_STANDIN = "import sys, standin; from hood.cli.main import main; sys.exit(main())"


def checks(folder: Path) -> dict[str, object]:
    """The lines of ``benchmarks/gpu_checks.py``."""
    place = Path(__file__).parents[2] / "benchmarks" / "gpu_checks.py"
    text = standin.otherwise(place.read_text(encoding="utf-8"))
    for whole, smaller in SMALLER:
        assert whole in text, whole
        text = text.replace(whole, smaller)
    module = types.ModuleType("gpu_checks_on_standin")
    sys.modules[module.__name__] = module
    exec(compile(text, str(place), "exec"), vars(module))
    vars(module).update(COMMAND=(sys.executable, "-P", "-c", ON_STANDIN))
    folder.mkdir(parents=True)
    lines = vars(module)["run"](20.0, 300.0, folder / "checks.csv")
    written = list(csv.DictReader((folder / "checks.csv").read_text().splitlines()))
    return {"lines": [[line.check, line.found, line.holds] for line in lines], "written": len(written)}


def alone(_: Path) -> dict[str, object]:
    """What the device makes of calls that a GPU would refuse, without hood."""
    here = torch.ones(4, device="standin")
    graph = torch.standin.CUDAGraph()
    refused = {
        "arrays of two devices": raises(lambda: here + torch.ones(4)),
        "a generator of the CPU": raises(lambda: torch.empty(4, device="standin").normal_(generator=torch.Generator())),
    }
    with torch.standin.graph(graph):
        refused["a value read while a graph is recorded"] = raises(lambda: float(here.sum()))
        refused["a copy to the host while a graph is recorded"] = raises(here.cpu)
        twice = here * 2
    refused["fresh memory holds numbers"] = bool(torch.empty(4, device="standin").isfinite().any())
    here.fill_(3)
    graph.replay()
    refused["a replay computes anew"] = twice.tolist() == [6.0] * 4
    return {"refused": refused}


def sums(_: Path) -> dict[str, object]:
    """Sums at indices there and on the CPU: how far they are apart, and which of them a GPU would take as they come."""
    from hood.tensors.dense import add_rows, sum_scenes

    draw = torch.Generator().manual_seed(0)
    apart = []
    torch.standin.forget()
    for count, places, shape in ((0, 3, (2,)), (1, 1, ()), (500, 7, (3, 3)), (500, 7, ())):
        rows = torch.randn(count, *shape, generator=draw, dtype=torch.float64)
        index = torch.randint(places, (count,), generator=draw)
        for function, given in (
            (add_rows, (torch.ones(places, *shape, dtype=torch.float64), index, rows)),
            *([] if shape else [(sum_scenes, (rows, index, places))]),
        ):
            there = function(*(one.to("standin") if isinstance(one, torch.Tensor) else one for one in given))
            apart.append(float((there.cpu() - function(*given)).abs().max()))
    return {
        "apart": apart,
        "as they come": [name for name in torch.standin.counts() if "index_add" in name or "scatter" in name],
    }


def raises(function: Callable[[], object]) -> bool:
    try:
        function()
    except RuntimeError:
        return True
    return False


OTHERS = {
    "training": train,
    "training captured": lambda folder: train(folder, "trainer.step=captured", "trainer.kernels=torch"),
    "launches of an update": launches,
    "evaluation": evaluate,
    "benchmark": benchmark,
    "checks": checks,
    "the device alone": alone,
    "sums": sums,
}

if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
