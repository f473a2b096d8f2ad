"""Compiling at first use: kept, shared by processes, repaired, told about, and refused in one sentence."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from hood.native import build as native_build
from hood.native.build import BuildError, build, find_compiler

FLAGS = ("-O0", "-shared", "-fPIC", "-march=native")


def test_what_is_compiled_is_kept_and_said_once(source, monkeypatch):
    said: list[str] = []
    monkeypatch.setattr(native_build, "announce", said.append)
    assert build(source, FLAGS).answer() == 42
    assert build(source, FLAGS).answer() == 42
    assert said == ["compiling answer.cpp for this processor; this happens once and takes some seconds"]


def test_a_changed_source_or_flag_is_compiled_anew(source):
    build(source, FLAGS)
    source.write_text(source.read_text().replace("42", "43"))
    assert build(source, FLAGS).answer() == 43
    build(source, (*FLAGS, "-DMORE"))
    assert len(list((source.parent / "kept").rglob("*.so"))) == 3


def test_processes_that_compile_at_once_do_not_disturb_each_other(source):
    code = (
        "import sys; from pathlib import Path; from hood.native.build import build; "
        f"sys.exit(build(Path({str(source)!r}), {FLAGS!r}).answer() - 42)"
    )
    runs = [subprocess.Popen([sys.executable, "-c", code], env=os.environ) for _ in range(4)]
    assert [run.wait() for run in runs] == [0, 0, 0, 0]
    kept = [path for path in (source.parent / "kept").rglob("*") if path.is_file()]
    assert [path.suffix for path in kept] == [".so"]


def test_a_damaged_file_is_made_anew(source):
    build(source, FLAGS)
    (kept,) = (source.parent / "kept").rglob("*.so")
    kept.unlink()  # never write into a library that is loaded
    kept.write_bytes(b"half a file")
    assert build(source, FLAGS).answer() == 42


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9, 0.999])
def test_a_library_that_was_cut_off_is_made_anew(source, share):
    """The system's loader ends the process with a bus error there, so another process tries."""
    build(source, FLAGS)
    (kept,) = (source.parent / "kept").rglob("*.so")
    content = kept.read_bytes()
    kept.unlink()
    kept.write_bytes(content[: int(share * len(content))])
    code = (
        "import sys; from pathlib import Path; from hood.native.build import build; "
        f"sys.exit(build(Path({str(source)!r}), {FLAGS!r}).answer() - 42)"
    )
    assert subprocess.run([sys.executable, "-c", code], env=os.environ, check=False).returncode == 0
    assert len(kept.read_bytes()) == len(content)


def test_a_folder_that_cannot_be_written_to_is_done_without(source, monkeypatch):
    blocked = source.parent / "a file"
    blocked.write_text("")
    monkeypatch.setenv("HOOD_CACHE", str(blocked))
    assert build(source, FLAGS).answer() == 42


def test_a_compiler_that_does_not_know_the_processor_compiles_for_any(source, monkeypatch):
    script = source.parent / "old-compiler"
    script.write_text(
        "#!/bin/sh\n"
        'for word in "$@"; do if [ "$word" = -march=native ]; then\n'
        "echo \"error: unsupported argument 'native' to option '-march='\" >&2; exit 1; fi; done\n"
        f'exec {find_compiler()} "$@"\n'
    )
    script.chmod(0o755)
    monkeypatch.setenv("CXX", str(script))
    assert build(source, FLAGS).answer() == 42


def test_what_cannot_be_loaded_is_an_error_of_one_sentence(source, monkeypatch):
    script = source.parent / "broken-compiler"
    script.write_text('#!/bin/sh\nwhile [ $# -gt 0 ]; do if [ "$1" = -o ]; then echo no library > "$2"; fi; shift; done\n')
    script.chmod(0o755)
    monkeypatch.setenv("CXX", str(script))
    with pytest.raises(BuildError, match="a compiled library cannot be loaded .* HOOD_CACHE"):
        build(source, FLAGS)


def test_a_mistake_in_the_source_is_named(source):
    source.write_text("no C++")
    with pytest.raises(BuildError, match="fails .*error.*; name another in CXX"):
        build(source, FLAGS)
    assert not list((source.parent / "kept").rglob("*.so"))
