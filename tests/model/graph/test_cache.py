"""Hierarchies on disk: found again, told apart, repaired, done without."""

from pathlib import Path

import numpy as np
import pytest
import torch

from hood.mesh.topology import unique_edges
from hood.model.graph import known_hierarchies
from hood.model.graph.hierarchy import Hierarchy, build_hierarchy
from hood.model.graph.known_hierarchies import cached_hierarchy, template_hierarchy
from hood.native.build import cache_folder
from hood.testing import grid

POS, FACES = grid(12, 9)
EDGES = unique_edges(FACES)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("HOOD_CACHE", str(tmp_path))
    monkeypatch.setattr(known_hierarchies, "MIN_VERTICES", 0)
    return tmp_path / "hierarchy"


@pytest.fixture
def builds(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Grows by one with every hierarchy that is really built."""
    calls: list[int] = []

    def counted(*arguments: object) -> Hierarchy:
        calls.append(1)
        return build_hierarchy(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(known_hierarchies, "build_hierarchy", counted)
    return calls


def get(pos: np.ndarray = POS, edges: np.ndarray = EDGES, num_coarse: int = 2, passed_over: int = 0) -> Hierarchy:
    return cached_hierarchy(len(pos), edges, pos, num_coarse, passed_over)


def assert_same(a: Hierarchy, b: Hierarchy) -> None:
    assert torch.equal(a.node_level, b.node_level)
    assert len(a.coarse_edges) == len(b.coarse_edges)
    for x, y in zip(a.coarse_edges, b.coarse_edges, strict=True):
        assert x.dtype == y.dtype
        assert torch.equal(x, y)


def test_second_call_reads_what_the_first_built(folder: Path, builds: list[int]) -> None:
    first, second = get(), get()
    assert len(builds) == 1
    assert_same(first, second)
    assert [path.suffix for path in folder.iterdir()] == [".npz"]


def test_entries_depend_on_all_that_the_result_depends_on(
    folder: Path, builds: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    moved = POS.copy()
    moved[0] += 5.0
    get()
    get(num_coarse=3)
    get(passed_over=1)
    get(pos=moved)
    get(edges=EDGES[1:])
    monkeypatch.setattr(known_hierarchies, "VERSION", known_hierarchies.VERSION + 1)
    get()
    assert len(builds) == 6


@pytest.mark.parametrize("damage", ["empty", "text", "cut", "wrong length", "outside"])
def test_damaged_entries_are_built_again_and_replaced(folder: Path, builds: list[int], damage: str) -> None:
    good = get()
    (path,) = folder.iterdir()
    content = path.read_bytes()
    if damage in ("empty", "text", "cut"):
        path.write_bytes({"empty": b"", "text": b"not an archive", "cut": content[: len(content) // 2]}[damage])
    else:
        level = good.node_level.numpy()[: -1 if damage == "wrong length" else None]
        np.savez(path, node_level=level, coarse0=good.coarse_edges[0].numpy() + 10**6, coarse1=good.coarse_edges[1].numpy())
    assert_same(get(), good)
    assert len(builds) == 2
    assert path.read_bytes() == content


@pytest.mark.parametrize("value", ["", "off", "OFF"])
def test_caching_can_be_turned_off(folder: Path, builds: list[int], monkeypatch: pytest.MonkeyPatch, value: str) -> None:
    monkeypatch.setenv("HOOD_CACHE", value)
    get()
    get()
    assert len(builds) == 2
    assert not folder.exists()


def test_small_meshes_are_not_kept(folder: Path, builds: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(known_hierarchies, "MIN_VERTICES", len(POS) + 1)
    get()
    assert not folder.exists()


def test_a_folder_that_cannot_be_made_is_done_without(
    tmp_path: Path, builds: list[int], folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("HOOD_CACHE", str(tmp_path / "file"))
    assert_same(get(), get())
    assert len(builds) == 2


def test_oldest_entries_make_room(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(known_hierarchies, "MAX_ENTRIES", 2)
    for k in (1, 2, 3):
        get(num_coarse=k)
    assert len(list(folder.iterdir())) == 2


def test_default_folder_follows_the_platform(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("HOOD_CACHE", raising=False)
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "hood"
    monkeypatch.setattr("sys.platform", "darwin")
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    assert cache_folder() == tmp_path / "Library" / "Caches" / "hood"


def test_a_process_keeps_the_garments_met_last(builds: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(known_hierarchies, "MAX_TEMPLATES", 3)
    monkeypatch.setattr(known_hierarchies, "_TEMPLATES", type(known_hierarchies._TEMPLATES)())

    def meet(pos: np.ndarray, edges: np.ndarray = EDGES) -> Hierarchy:
        return template_hierarchy(len(pos), edges, pos, 2)

    first, *others = (POS + k for k in range(6))
    kept = meet(first)
    assert meet(first) is kept
    for other in others:
        meet(other)
        assert meet(first) is kept  # met again and again, so it stays
        assert len(known_hierarchies._TEMPLATES) <= 3
    assert len(builds) == 6
    meet(others[-1])
    assert len(builds) == 6
    meet(others[0])
    assert len(builds) == 7  # the one that was not met for longest had to go
    assert_same(meet(first, EDGES[1:]), build_hierarchy(len(POS), EDGES[1:], first, 2))  # other faces of the same vertices
