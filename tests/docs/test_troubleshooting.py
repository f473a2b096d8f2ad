"""The messages of docs/troubleshooting.md are those of the code, and the fixes have keys that exist."""

from __future__ import annotations

import re

import pytest
from pages import ROOT, text_of

from hood.app.settings.compose import load_config
from hood.app.setup import check_config

ROWS = re.findall(r"^\| (`.*?) \| (.*?) \| (.*?) \|$", text_of(ROOT / "docs" / "troubleshooting.md"), re.MULTILINE)
_TEXT = "\n".join(path.read_text(encoding="utf-8") for path in sorted((ROOT / "hood").rglob("*.py")))
#: Strings of one message may stand on several lines; what stands for a value is …, as on the page.
SOURCE = re.sub(r"\{[^{}\n]*\}", "…", re.sub(r'"\s*\n\s*f?"', "", _TEXT))
#: The shortest piece of a message that is looked for.
_LEAST = 6


@pytest.mark.parametrize("symptom", [row[0] for row in ROWS])
def test_symptoms_are_messages_of_the_code(symptom: str) -> None:
    (message,) = re.findall(r"^`([^`]+)`", symptom)
    fixed = [part.strip() for part in re.split("…|; |: ", message) if len(part.strip()) >= _LEAST]
    assert fixed
    for part in fixed:
        assert part in SOURCE, part


def test_fixes_have_keys_that_exist() -> None:
    known, prepare = (set(load_config(command)) for command in ("rollout", "prepare"))
    for _, _, fix in ROWS:
        for span in re.findall(r"`([^`]+)`", fix):
            if re.match(r"[a-z_]+=", span):
                words = span.split()
                keys = {word.partition("=")[0] for word in words}
                assert keys <= known | prepare | {"format"}, span
                if keys <= known and not re.search(r"\.(npz|pkl)|pins", span):
                    check_config(load_config("rollout", words))
