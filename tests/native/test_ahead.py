"""Libraries made in the background: once, waited for, and left without a trace when the program ends before."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from pathlib import Path

from hood.native import build as native_build
from hood.native.build import build, keep

FLAGS = ("-O0", "-shared", "-fPIC")


def kept(source: Path) -> list[Path]:
    return [path for path in (source.parent / "kept").rglob("*") if path.is_file()]


def test_who_needs_what_is_being_made_waits_for_it(source, monkeypatch):
    said: list[str] = []
    monkeypatch.setattr(native_build, "announce", said.append)
    threads = [threading.Thread(target=keep, args=(source, FLAGS)) for _ in range(3)]
    for thread in threads:
        thread.start()
    assert build(source, FLAGS).answer() == 42
    for thread in threads:
        thread.join()
    assert len(said) == len(kept(source)) == 1


def test_nothing_is_made_where_nothing_is_kept(source, monkeypatch):
    monkeypatch.setenv("HOOD_CACHE", "off")
    keep(source, FLAGS)
    assert not kept(source)


def test_all_that_a_wheel_would_carry_is_made(source, monkeypatch):
    other = source.with_name("other.cpp")
    other.write_text(source.read_text().replace("42", "43"))
    monkeypatch.setattr(native_build, "LIBRARIES", ((source, FLAGS), (other, FLAGS)))
    native_build._make_all(threading.Event())
    assert len(kept(source)) == 2
    assert build(other, FLAGS).answer() == 43


def test_a_program_that_ends_first_stops_the_compiler_and_leaves_nothing(source):
    script = source.parent / "slow-compiler"
    script.write_text('#!/bin/sh\n[ "$1" = --version ] && exit 0\ntouch "$(dirname "$0")/begun"\nexec sleep 60\n')
    script.chmod(0o755)
    code = (
        "import time; from pathlib import Path; from hood.native import build\n"
        f"build.LIBRARIES = ((Path({str(source)!r}), {FLAGS!r}),); build.start()\n"
        f"while not Path({str(source.parent / 'begun')!r}).exists(): time.sleep(0.01)\n"
    )
    environment = {**os.environ, "CXX": str(script)}
    subprocess.run([sys.executable, "-c", code], env=environment, check=True, timeout=30)
    assert not kept(source)
    assert not any((source.parent / "kept" / "kernels").iterdir())
