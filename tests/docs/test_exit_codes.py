"""Exit codes are told in one way: by the help and on the pages."""

from __future__ import annotations

import re

import pytest
from pages import ROOT, text_of

from hood.cli.main import EXIT_CODES, exit_code_lines, main

ROW = re.compile(r"^\| (\d+) \| (.+) \|$", re.MULTILINE)


def rows(page: str) -> dict[int, str]:
    """Exit codes and their meanings in the table of a page."""
    table = text_of(ROOT / "docs" / page).partition("| exit code | meaning |\n")[2].partition("\n\n")[0]
    return {int(code): meaning for code, meaning in ROW.findall(table)}


def test_the_page_has_the_table_of_the_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert rows("troubleshooting.md") == EXIT_CODES
    assert main(["--help"]) == 0
    assert "\n".join(exit_code_lines()) in capsys.readouterr().out


def test_the_page_of_rollouts_has_those_that_a_rollout_ends_with() -> None:
    assert [*rows("rollout.md")] == [code for code, meaning in EXIT_CODES.items() if code != 1]
    assert not re.search("rollout", EXIT_CODES[1])


def test_no_command_ends_with_another_number() -> None:
    told = set()
    for path in [path for room in ("app", "cli", "studies") for path in sorted((ROOT / "hood" / room).rglob("*.py"))]:
        text = text_of(path)
        told |= {
            int(number)
            for number in re.findall(r"^ +return (\d+)$|^ +code = (\d+)$", text, re.M)
            for number in number
            if number
        }
        told |= {int(number) for number in re.findall(r"^ +return (\d+) if ", text, re.M)}
    assert told <= {*EXIT_CODES}
    assert {0, 1, 2, 130} <= told
