"""Reading schedules, and the propagation radius they promise."""

import pytest

from hood.model.graph.builder import edge_set_names, finest_level, parse_passes, parse_schedule, radius


def test_ours_is_the_papers_fifteen_steps():
    steps = parse_schedule("ours")
    down, middle, bottom = ("coarse0", "mesh"), ("coarse0", "coarse1"), ("coarse1",)
    assert steps == (down,) * 3 + (middle,) * 3 + (bottom,) * 3 + (middle,) * 3 + (down,) * 3
    assert edge_set_names(steps) == ("mesh", "coarse0", "coarse1")
    assert [finest_level(s) for s in steps[::3]] == [0, 1, 2, 1, 0]


@pytest.mark.parametrize("name, steps, expected", [("fine15", 15, 15), ("fine48", 48, 48), ("ours", 15, 48)])
def test_radius_of_table_one(name, steps, expected):
    schedule = parse_schedule(name)
    assert len(schedule) == steps
    assert radius(schedule) == expected


def test_coarse_edges_are_longer_where_levels_are_passed_over():
    assert [radius(parse_schedule("2x(mesh) 3x(mesh+coarse0) (coarse1)"), passed) for passed in (0, 1, 2)] == [12, 22, 42]


def test_text_is_read_with_or_without_counts_and_spaces():
    assert parse_schedule("(mesh) 2 x (coarse2 + mesh)") == (("mesh",), ("coarse2", "mesh"), ("coarse2", "mesh"))


@pytest.mark.parametrize(
    "text, message",
    [
        ("3x(mesh+corse0)", "did you mean 'coarse0'"),
        ("3x(mesh)+", "cannot read"),
        ("3x()", "unknown edge set ''"),
        ("0x(mesh)", "repeats 0 times"),
        ("(mesh+mesh)", "twice"),
        ("our", "did you mean 'ours'"),
        ("", "unknown schedule"),
        ("(body)", "unknown edge set 'body'"),
    ],
)
def test_misspelt_schedules_are_refused(text, message):
    with pytest.raises(ValueError, match=message.replace("(", "\\(")):
        parse_schedule(text)


def test_passes_of_a_schedule() -> None:
    text = "2x(mesh) 1x(coarse0) | 1x(mesh) | 4x(mesh+coarse0)"
    assert parse_passes(text) == (3, 1, 4)
    assert parse_schedule(text) == parse_schedule(text.replace("|", ""))
    assert parse_passes("ours") == (15,)
    for bad in ("1x(mesh) |", "| 1x(mesh)", "1x(mesh) || 1x(mesh)"):
        with pytest.raises(ValueError, match="has no steps"):
            parse_passes(bad)
