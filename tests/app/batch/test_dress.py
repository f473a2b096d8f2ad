"""``hood dress``: names of rows, the manifest, what a kill leaves, what is made again, and what is refused."""

from __future__ import annotations

import errno
import importlib
import importlib.util
import json
import multiprocessing
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from hood.app.batch import engines, work
from hood.app.batch.dress import _frames_of
from hood.app.batch.manifest import Manifest, own_line, parquet_columns, read_manifest
from hood.app.batch.rows import DataRow, row_seed, rows_of
from hood.app.batch.work import Call, HopelessError, pull, settings_of
from hood.app.settings.compose import ConfigError, load_config
from hood.app.settings.rollout_settings import RolloutSettings, overrides
from hood.cli.main import main
from hood.media.film import Film

#: What makes rows cheap.
CHEAP = ["garments=[tank]", "num_frames=2", "metrics=none", "guard=off", "stepper=guess", "settle=0"]

BLANK = np.zeros((8, 8, 3), dtype=np.uint8)


@pytest.fixture
def motions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Two subjects with a motion of the same file name each, and a broken one."""
    monkeypatch.chdir(tmp_path)
    for name in ("s0/walk", "s1/walk"):
        write(tmp_path / "motions" / f"{name}.npz")
    write(tmp_path / "motions" / "s1" / "broken.npz", broken=True)
    return tmp_path / "motions"


def write(path: Path, broken: bool = False, frames: int = 4) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    poses = np.full((frames, 156), np.nan if broken else 0.0)
    np.savez(path, poses=poses, trans=np.zeros((frames, 3)), mocap_framerate=30.0, betas=np.zeros(16), gender="neutral")


def planned(*words: str) -> list[DataRow]:
    return rows_of(load_config("dress", words), [word.partition("=")[0] for word in words])[0]


def in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """The rows of ``engine=local`` are made here."""

    def work_here(self: engines.Pool, follow: Any, stay: bool = True) -> None:
        pull(self.call, self.rows)
        follow()

    monkeypatch.setattr(engines.Pool, "work", work_here)


def content(path: Path) -> dict[str, bytes]:
    """What a rollout file holds beside times."""
    found: dict[str, bytes] = {}
    with h5py.File(path, "r") as file:
        file.visititems(
            lambda name, item: (
                found.update({name: item[()].tobytes()}) if isinstance(item, h5py.Dataset) and "/ms_" not in name else None
            )
        )
    return found


def test_names_and_seeds_of_a_product(motions: Path) -> None:
    rows = planned("garments=[tank,[tank,skirt]]", "bodies=[default,{betas:[1.5],name:tall}]", "motions=[motions]")
    assert [row.name for row in rows[:3]] == [f"tank/default/default/{name}" for name in ("s0/walk", "s1/broken", "s1/walk")]
    assert len({row.name for row in rows}) == 2 * 2 * 3
    assert {row.name.split("/")[0] for row in rows} == {"tank", "tank+skirt"}
    assert {row.keys.get("betas") for row in rows if "/tall/" in row.name} == {"[1.5]"}
    seeds = {row.name: row.keys["seed"] for row in rows}
    assert len({*seeds.values()}) == len(rows)
    assert seeds[rows[0].name] == str(row_seed(0, rows[0].name))
    write(motions / "s0" / "another.npz")
    more = planned("garments=[tank,[tank,skirt]]", "bodies=[default,{betas:[1.5],name:tall}]", "motions=[motions]")
    assert seeds.items() <= {row.name: row.keys["seed"] for row in more}.items()


def test_combinations_are_drawn_by_motion(motions: Path) -> None:
    words = ("garments=[tank,skirt,dress]", "fabrics=[default,silk]", "per_motion=2", "root=motions")
    rows = planned(*words, "motions=[motions]")
    assert [sum(name in row.name for row in rows) for name in ("s0/walk", "s1/walk", "s1/broken")] == [2, 2, 2]
    alone = planned(*words, "motions=[motions/s0]")
    assert {row.name for row in alone} == {row.name for row in rows if "s0/walk" in row.name}


def test_rows_of_files(motions: Path) -> None:
    Path("rows.csv").write_text("garment,motion,size,name\ntank,motions/s0/walk.npz,1.05,a/first\nskirt,plie,,\n")
    rows = planned("rows=rows.csv")
    assert [row.name for row in rows] == ["skirt/default/default/plie", "a/first"]
    assert rows[1].keys["size"] == "1.05"
    assert rows[1].keys["sequence"] == str(motions / "s0" / "walk.npz")
    Path("rows.jsonl").write_text('{"garment": ["tank", "skirt"], "sequence": "plie", "seed": 7}\n')
    (row,) = planned("rows=rows.jsonl")
    assert row.name == "tank+skirt/default/default/plie"
    assert (row.keys["garment"], row.keys["seed"]) == ("[tank,skirt]", "7")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["motions=[motions]", "root=/etc"], "walk.npz is not below it"),
        (["motions=[motions/s0/walk.npz,motions/s0/walk.pkl]"], "would both go to"),
        (["motions=[motions/up.npz,motions/up/walk.npz]"], "would lie in that of another row"),
        (["motions=[plie]", "garments=[tank,tank]"], "two entries would both go to folders named tank"),
        (["motions=[plie]", "garments=[tnk]"], r"garments\[0\]: unknown garment 'tnk': did you mean 'tank'"),
        (["motions=[plie]", "fabrics=[silc]"], "unknown fabric 'silc': did you mean 'silk'"),
        (["motions=[plie]", "bodies=[{betas:[1],sizze:2}]"], "unknown key 'sizze': did you mean 'size'"),
        (["motions=[]"], "give names, files, folders, globs or lists"),
        (["rows=rows.csv", "motions=[plie]"], "the rows come from rows=rows.csv"),
        (["rows=rows.csv"], "rows.csv, row 2: unknown key 'garmet'"),
        (["rows=rows.jsonl"], "rows.jsonl, line 2: not readable as JSON"),
        (["rows=twice.csv"], "two rows would both go to tank/default/default/plie"),
        (["motions=[plie]", "per_motion=0"], "per_motion=0: give a whole number from 1 on"),
    ],
)
def test_rows_that_cannot_be_meant_are_refused(words: list[str], said: str, motions: Path) -> None:
    for name in ("s0/walk.pkl", "up.npz", "up/walk.npz"):
        (motions / name).parent.mkdir(exist_ok=True)
        (motions / name).write_bytes(b"")
    Path("rows.csv").write_text("garmet,sequence\ntank,plie\n")
    Path("rows.jsonl").write_text('{"sequence": "plie"}\nnonsense\n')
    Path("twice.csv").write_text("garment,sequence\ntank,plie\ntank,plie\n")
    with pytest.raises((ConfigError, FileNotFoundError), match=said):
        planned(*words)


def test_a_half_line_stays_alone(tmp_path: Path) -> None:
    line = {"row": "a", "verdict": "sound", "settings": {}}
    manifest = Manifest(tmp_path)
    manifest.append(line)
    with open(manifest.path, "ab") as file:
        file.write(json.dumps(line | {"row": "torn"}).encode()[:20])
    assert [found["row"] for found in Manifest(tmp_path).new()] == ["a"]
    manifest.append(line | {"row": "b"})
    assert {*read_manifest(tmp_path)} == {"a", "b"}


def test_a_set_with_a_broken_row_goes_on_and_is_not_made_twice(
    motions: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    in_this_process(monkeypatch)
    command = ["dress", *CHEAP, "motions=motions", "output=out", "fail_on=nothing"]
    assert main([*command, "fail_fraction=0.2"]) == 2
    told = capsys.readouterr()
    assert told.out.count("[") == 3
    assert "1 × failed:" in told.out
    assert "1 of 3 rows failed, more than fail_fraction=0.2 allows; exit code 2" in told.err
    lines = read_manifest(Path("out"))
    assert lines["tank/default/default/s1/broken"]["verdict"] == "failed"
    assert "broken.npz" in lines["tank/default/default/s1/broken"]["error"]
    good = lines["tank/default/default/s0/walk"]
    assert (good["frames"], good["inputs"]["sequence"]) == (2, lines["tank/default/default/s1/walk"]["inputs"]["sequence"])
    assert own_line(Path("out/tank/default/default/s0/walk")) == good
    assert not Path("out/.work").exists()

    before = Path("out/manifest.jsonl").read_bytes()
    assert main([*command, "fail_fraction=0.5"]) == 0
    assert Path("out/manifest.jsonl").read_bytes() == before
    assert main([*command, "num_frames=3"]) == 2
    assert "num_frames is 2 there, 3 in this command" in capsys.readouterr().err
    assert main([*command, "garments=[{garment:tank,size:1.1,name:tank}]"]) == 2
    assert "size of row tank/default/default/s0/walk is null there, 1.1 in this command" in capsys.readouterr().err
    assert Path("out/manifest.jsonl").read_bytes() == before

    write(motions / "s1" / "broken.npz")
    assert main([*command, "retry=failed"]) == 0
    assert read_manifest(Path("out"))["tank/default/default/s1/broken"]["verdict"] != "failed"
    write(motions / "s0" / "walk.npz", frames=5)
    Path("out/manifest.jsonl").write_text("")  # as where a disk was full: the folders have the lines
    capsys.readouterr()
    assert main(command) == 0
    told = capsys.readouterr()
    assert "3 rows were whole and had no line" in told.out
    assert "1 rows are made again: their files have other content now" in told.out
    assert len(read_manifest(Path("out"))) == 3


def test_settings_of_a_row_are_those_of_its_words(tmp_path: Path) -> None:
    words = ("stepper=guess", "num_frames=2")
    for sequence in ("plie", str(tmp_path / "2024_01"), "007", "a b, c's [1].npz", 'ü"q\\.npz', "none"):
        (row,) = rows_of_keys([{"sequence": sequence, "garment": "tank"}])
        assert settings_of(words, row) == RolloutSettings.from_words([*words, *row.words])
        assert settings_of(words, row).sequence == sequence


def rows_of_keys(keys: list[dict[str, Any]]) -> list[DataRow]:
    return [DataRow(f"r{number}", tuple(overrides({"seed": number, **one}))) for number, one in enumerate(keys)]


def test_thumbnails_show_the_worst_row_in_its_worst_frame(
    motions: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    in_this_process(monkeypatch)
    drawn = list[tuple[str, int]]()
    monkeypatch.setattr(Film, "picture", lambda film, frame: drawn.append((film.data.attributes["sequence"], frame)) or BLANK)
    command = ["dress", *CHEAP, "motions=motions", "output=out", "fail_on=nothing"]
    assert main([*command, "thumbnails=0"]) == 2
    assert not Path("out/thumbnails.png").exists()
    lines = [json.loads(text) for text in Path("out/manifest.jsonl").read_text().splitlines()]
    for line in lines:
        line |= {"verdict": "unsound", "worst": {"value": 0.1, "frame": 1}} if "s1/walk" in line["row"] else {}
    Path("out/manifest.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    main([*command, "thumbnails=1"])
    assert "1 rows by chance and the 1 worst" in capsys.readouterr().out
    assert drawn[1] == ("walk", 1)
    assert Path("out/thumbnails.png").stat().st_size > 0
    main([*command, "thumbnails=1"])  # nothing is made: it stays
    assert len(drawn) == 2


def test_a_script_makes_a_data_set_and_is_not_run_again(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    keys = "garments=['tank'], motions=['plie'], num_frames=2, metrics='none', guard='off', stepper='guess', settle=0"
    script.write_text(f"print('begun')\nimport hood\nprint(hood.dress({keys}, output='out', workers=1).keys())\n")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run([sys.executable, str(script)], cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.stdout == "begun\ndict_keys(['tank/default/default/plie'])\n", done.stderr


@pytest.mark.parametrize(
    "error",
    [
        OSError(errno.ENOSPC, "No space left on device", "out/x"),
        RuntimeError("Unable to flush file (file write failed: errno = 28, error message = 'No space left on device')"),
    ],
)
def test_a_full_disk_ends_the_work_and_fails_no_row(error: Exception, motions: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    call = Call(Path("out"), ("stepper=guess",), 3, 0)
    Path("out").mkdir()

    def full(*arguments: object) -> None:
        raise error

    monkeypatch.setattr(work, "roll_out_into", full)
    with pytest.raises(HopelessError) as raised:
        pull(call, planned("garments=[tank]", "motions=[motions]"))
    cause = raised.value.__cause__
    assert isinstance(cause, OSError)
    assert (cause.errno, cause.filename) == (errno.ENOSPC, "out")
    assert read_manifest(Path("out")) == {}


def test_a_row_whose_process_is_killed_each_time_fails(motions: Path) -> None:
    """A claim of a process that is gone counts as an attempt; one that is there is left alone."""
    call, (row, *_) = Call(Path("out"), (), 2, 0), planned("motions=[plie]")
    Path("out").mkdir()
    for attempt in (1, 2):
        gone = subprocess.Popen([sys.executable, "-c", ""])
        gone.wait()
        path = work._claims(call.folder) / work._code(row)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(work._me() | {"pid": gone.pid, "attempt": attempt}))
    assert not work.is_held(call.folder, row)
    assert work.make_row(call, row)
    assert "was killed 2 times" in read_manifest(call.folder)[row.name]["error"]
    path.write_text(json.dumps(work._me() | {"attempt": 1}))
    assert work.is_held(call.folder, row)
    assert not work.make_row(Call(call.folder, (), 2, Manifest(call.folder).size()), row)


def test_what_a_lost_cluster_goes_on_to_make_gets_no_second_line(motions: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    call, (row, *_) = Call(Path("out"), (), 2, 0), planned("motions=[plie]")
    Path("out").mkdir()
    line = {"row": row.name, "verdict": "sound", "settings": row.keys}

    def made_by_two(*_: Any) -> dict[str, Any]:
        Manifest(call.folder).append(line)  # the other process is first
        return line

    monkeypatch.setattr(work, "_made", made_by_two)
    assert work.make_row(call, row, claimed=False)
    assert not work.make_row(call, row, claimed=False)
    assert len(Path("out/manifest.jsonl").read_text().splitlines()) == 1


@pytest.mark.skipif(not hasattr(os, "killpg"), reason="ends a tree of processes by its group")
def test_a_killed_call_goes_on_where_it_stopped(motions: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The whole tree is killed while rows are made; afterwards each row is there once, with the bits of an undisturbed run."""
    for name in ("s2/walk", "s3/walk", "s4/walk"):
        write(motions / f"{name}.npz")
    words = [*CHEAP, "motions=motions", "workers=1", "fail_fraction=1", "fail_on=nothing"]
    program = [sys.executable, "-P", "-m", "hood", "dress", *words, "output=out"]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    killed = subprocess.Popen(program, start_new_session=True, env=environment, stdout=subprocess.DEVNULL)
    try:
        end = time.monotonic() + 120
        while not read_manifest(Path("out")) and time.monotonic() < end:
            time.sleep(0.02)
    finally:
        os.killpg(killed.pid, signal.SIGKILL)
        killed.wait()
    done = read_manifest(Path("out"))
    assert 1 <= len(done) < 6
    in_this_process(monkeypatch)
    assert main(["dress", *words, "output=out"]) == 0
    assert main(["dress", *words, "output=other"]) == 0
    lines = [json.loads(line)["row"] for line in Path("out/manifest.jsonl").read_text().splitlines()]
    assert len(lines) == len({*lines}) == 6
    files = sorted(path.relative_to("out") for path in Path("out").rglob("rollout.h5"))
    assert len(files) == 5
    for file in files:
        assert content("out" / file) == content("other" / file)


@pytest.mark.slow
def test_a_killed_process_is_replaced(motions: Path) -> None:
    """One process of a pool is killed; the others, and a new one, make all rows."""
    Path("out").mkdir()
    rows = planned("garments=[tank,skirt]", "motions=[motions]")
    call = Call(Path("out"), tuple(word for word in CHEAP if not word.startswith("garments")), 3, 0)
    pool, killed = engines.Pool(call, rows, 2), list[int]()

    def kill_one() -> None:
        held = list(work._claims(call.folder).glob("*"))
        if held and not killed:
            child = multiprocessing.active_children()[0]
            assert child.pid is not None
            os.kill(child.pid, signal.SIGKILL)
            killed.append(child.pid)

    pool.work(kill_one)
    assert killed
    assert {*read_manifest(call.folder)} == {row.name for row in rows}


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["engine=slrum"], "did you mean 'slurm'"),
        (["engine=torchrun"], "torchrun did not start this process"),
        (["workers=0"], "workers=0: give a whole number"),
        (["cluster=local"], "cluster=local: is of engine=ray an address"),
        (["job={a:1}"], "is a table for engine=slurm"),
        (["retry=all"], "unknown value for retry 'all'"),
        (["fail_fraction=2"], "give a share of the rows"),
        (["garment=tank"], r"come from garments=\[…\]"),
        (["resume=true"], "goes on by itself"),
        (["garmnets=[tank]"], "did you mean 'garments'"),
        (["plan=0.01"], "a plan is of one scene"),
    ],
)
def test_keys_that_cannot_be_meant_are_refused(words: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["dress", "motions=[plie]", *words, "output=unused"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert re.search(said, error), error
    assert not Path("unused").exists()


@pytest.mark.parametrize(("engine", "package"), [("ray", "ray"), ("slurm", "submitit")])
def test_a_missing_package_is_named_with_its_command(
    engine: str, package: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(engines.importlib.util, "find_spec", lambda name: None)
    assert main(["dress", "motions=[plie]", f"engine={engine}", "workers=1", "output=unused"]) == 2
    assert f'engine={engine} needs the package {package}: pip install "hood-cloth[{engine}]"' in capsys.readouterr().err


def test_a_manifest_as_columns() -> None:
    lines = [
        {"row": "a", "verdict": "sound", "settings": {"garment": "tank"}, "frames": 3, "doubts": [{"kind": "speed"}]},
        {"row": "b", "verdict": "failed", "settings": {"garment": "skirt", "size": "1.1"}, "error": "torn"},
    ]
    assert parquet_columns(lines) == {
        **{"row": ["a", "b"], "verdict": ["sound", "failed"], "frames": [3, None], "doubts": ['[{"kind": "speed"}]', None]},
        **{"settings.garment": ["tank", "skirt"], "error": [None, "torn"], "settings.size": [None, "1.1"]},
    }


def test_a_manifest_as_parquet_or_how_to_install_it(
    motions: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    in_this_process(monkeypatch)
    command = ["dress", *CHEAP, "motions=motions", "output=out", "fail_on=nothing", "fail_fraction=1", "parquet=true"]
    if importlib.util.find_spec("pyarrow") is None:
        assert main(command) == 2
        assert 'parquet=true needs the package pyarrow: pip install "hood-cloth[parquet]"' in capsys.readouterr().err
        assert not Path("out").exists()
        return
    assert main(command[:-1]) == 0
    assert not Path("out/manifest.parquet").exists()
    assert main(command) == 0  # all rows were done before
    table = importlib.import_module("pyarrow.parquet").read_table("out/manifest.parquet").to_pydict()
    assert table == parquet_columns(read_manifest(Path("out")).values())
    assert sorted(table["verdict"]) == ["doubtful", "doubtful", "failed"]


def test_a_dry_run_counts_and_writes_nothing(motions: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["dress", *CHEAP, "motions=motions", "output=out", "dry_run=true"]) == 0
    told = capsys.readouterr().out
    assert "rows: 3\n" in told
    assert "hours of a core" in told
    assert "GB" in told
    assert not Path("out").exists()
    rows = planned("garments=[tank]", "motions=[motions,plie]")
    frames = _frames_of(["stepper=guess", "num_frames=40", "loop=2"], rows)
    assert frames == [8.0, 8.0, 8.0, 40.0]
