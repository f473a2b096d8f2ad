"""Libraries of a wheel: made for each generation of processors, chosen by what the processor can do."""

from __future__ import annotations

from pathlib import Path

import pytest

from hood.native import build as native_build
from hood.native import prebuilt
from hood.native.build import BuildError, Level, build, find_compiler

FLAGS = ("-O0", "-shared", "-fPIC", "-march=native")
#: Its library tells for which generation it was made.
SOURCE = 'extern "C" int lanes() {\n#if defined(WIDE)\nreturn 16;\n#else\nreturn 2;\n#endif\n}\n'
LEVELS = (Level("wide", frozenset({"everything"})), Level("plain"))


@pytest.fixture
def source(compiler: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A source whose library says for which of two generations it was made."""
    path = tmp_path / "lanes.cpp"
    path.write_text(SOURCE)
    for module in (prebuilt, native_build):
        monkeypatch.setattr(module, "levels", lambda: LEVELS)
    monkeypatch.setattr(native_build, "LIBRARIES", ((path, FLAGS),))
    monkeypatch.setattr(native_build, "SELDOM", ())
    chosen = {"wide": "-DWIDE", "plain": "-DPLAIN"}
    monkeypatch.setattr(
        native_build,
        "flags_for",
        lambda flags, level: [chosen[level.name] if flag == "-march=native" else flag for flag in flags],
    )
    return path


def test_the_widest_that_the_processor_can_run_is_taken(source, tmp_path):
    made, left_out = native_build.make(tmp_path)
    assert len(made) == 2
    assert not left_out
    assert prebuilt.prebuilt(tmp_path, source, FLAGS, frozenset({"everything"})).lanes() == 16
    assert prebuilt.prebuilt(tmp_path, source, FLAGS, frozenset()).lanes() == 2


def test_no_compiler_is_needed_where_a_library_is_prebuilt(source, tmp_path, monkeypatch):
    native_build.make(tmp_path)
    monkeypatch.setattr(native_build, "FOLDER", tmp_path)
    monkeypatch.setenv("CXX", "no-such-compiler")
    assert build(source, FLAGS).lanes() == 2
    source.write_text(SOURCE + "\n")  # another source: the prebuilt library is not its
    with pytest.raises(BuildError, match=r"no C\+\+ compiler"):
        build(source, FLAGS)


def test_a_damaged_library_leaves_the_next(source, tmp_path):
    made, _ = native_build.make(tmp_path)
    next(path for path in made if "wide" in path.name).write_bytes(b"half a file")
    assert prebuilt.prebuilt(tmp_path, source, FLAGS, frozenset({"everything"})).lanes() == 2


def test_what_cannot_be_compiled_is_left_out_and_named(source, tmp_path, monkeypatch):
    source.write_text("no C++")
    made, left_out = native_build.make(tmp_path)
    assert not made
    assert all("the wheel is without lanes-" in sentence for sentence in left_out)
    monkeypatch.setenv("CXX", "no-such-compiler")
    assert native_build.make(tmp_path) == ([], ["the wheel carries no compiled parts: " + str(_no_compiler())])


def test_the_list_names_what_the_modules_ask_for():
    from hood.media.renderer import raster
    from hood.mesh.closest_point import tree
    from hood.solver.compiled import newton

    assert (newton.SOURCE, native_build.WIDE_FLAGS) in native_build.SELDOM
    listed = {path for path, _ in native_build.LIBRARIES}
    assert {newton.SOURCE, tree.SOURCE, raster.SOURCE} <= listed
    assert all(path.exists() for path in listed)


def test_every_architecture_ends_with_a_level_that_runs_everywhere():
    for generations in prebuilt.LEVELS.values():
        assert not generations[-1].needs
        assert all(narrow.needs <= wide.needs for wide, narrow in zip(generations, generations[1:], strict=False))


def _no_compiler() -> BuildError:
    with pytest.raises(BuildError) as caught:
        find_compiler()
    return caught.value
