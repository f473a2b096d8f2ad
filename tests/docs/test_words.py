"""The pages for users stay short: what was measured belongs into the notes beside the studies."""

from __future__ import annotations

from pages import PAGES, text_of

#: Words of README, CONTRIBUTING and all pages of docs/ together, as ``wc -w`` counts them.
MOST = 25_000


def test_the_pages_together_are_short() -> None:
    words = {page.name: len(text_of(page).split()) for page in PAGES}
    assert sum(words.values()) <= MOST, words
