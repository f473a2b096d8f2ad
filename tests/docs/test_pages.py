"""README and docs: short where they promise to be, and their links lead somewhere."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import yaml
from pages import CARDS, NOTES, PAGES, README, ROOT, headings, prose_of, text_of

import hood

#: Weight of pictures: the moving one of the README, others.
_MOVING, _STILL = 2 * 2**20, 400_000


def links(page: Path) -> list[str]:
    """Where the links and pictures of a page lead inside the repository."""
    return re.findall(r"\]\((?!https?:)([^)]+)\)", prose_of(page))


def test_the_readme_is_short_and_has_a_picture_first() -> None:
    text = text_of(README)
    assert len(text.splitlines()) <= 120
    assert len(text.split()) <= 900
    picture = re.search(r"!\[[^]]+\]\(([^)]+)\)", "\n".join(text.splitlines()[:20]))
    assert picture is not None
    assert (ROOT / picture[1]).stat().st_size <= _MOVING


@pytest.mark.parametrize("page", [*PAGES, *CARDS], ids=lambda page: "/".join(page.parts[-2:]))
def test_links_lead_to_what_is_there(page: Path) -> None:
    for link in links(page):
        name, _, anchor = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        assert target.exists(), link
        if anchor:
            assert anchor in headings(target), f"{link}: its anchors are {sorted(headings(target))}"


def test_every_page_is_reached_from_the_readme() -> None:
    seen, left = set(), [README]
    while left:
        page = left.pop()
        if page not in seen:
            seen.add(page)
            left += [(page.parent / link.partition("#")[0]).resolve() for link in links(page) if ".md" in link]
    assert {*PAGES, *NOTES} <= seen


def test_pictures_are_light_and_shown() -> None:
    shown = {(page.parent / link).resolve() for page in [*PAGES, *NOTES] for link in links(page)}
    for picture in [*(ROOT / "docs").glob("**/*.png"), *(ROOT / "docs").glob("**/*.gif")]:
        assert picture in shown, picture.name
        assert picture.stat().st_size <= (_MOVING if picture.suffix == ".gif" else _STILL), picture.name


def test_the_reference_lists_every_public_name() -> None:
    listed = re.findall(r"^::: hood\.(\w+)$", text_of(ROOT / "docs" / "api.md"), re.MULTILINE)
    assert sorted(listed) == sorted(set(hood.__all__) - {"__version__"})


def test_the_names_of_what_is_embedded_have_four_kinds() -> None:
    with pytest.raises(ValueError, match="did you mean 'garments'"):
        hood.names("garment")


def test_the_site_leads_to_every_page() -> None:
    site = yaml.safe_load(text_of(ROOT / "mkdocs.yml"))
    led = [page for entry in site["nav"] for page in ([entry] if isinstance(entry, str) else next(iter(entry.values())))]
    assert sorted(led) == sorted(page.name for page in PAGES if page.parent == ROOT / "docs")


def test_the_citation_is_that_of_the_readme_and_of_this_version() -> None:
    citation = yaml.safe_load(text_of(ROOT / "CITATION.cff"))
    paper = citation["preferred-citation"]
    assert citation["version"] == hood.__version__
    assert paper["title"].replace("HOOD", "{HOOD}") in text_of(README)
    assert all(f"{author['family-names']}, {author['given-names']}" in text_of(README) for author in paper["authors"])


def test_the_list_for_language_models_names_every_page() -> None:
    text = (ROOT / "docs" / "llms.txt").read_text(encoding="utf-8")
    pages = {page.name for page in (ROOT / "docs").glob("*.md")} - {"index.md"}
    assert set(re.findall(r"\]\(([^)]+)\)", text)) == pages
