"""Words as a shell hands them over: any name of a file is a value, lists and tables stay what they are."""

from __future__ import annotations

from pathlib import Path

import pytest

from hood import api
from hood.app.settings.compose import ConfigError, load_config, plain, with_words
from hood.app.settings.overrides import plain_word

NAMES = (
    "Röckchen.obj", "tänzer.glb", "out/möbel", "karo ö.png", "cape (1).obj", "cape#2.obj", "cape&b.obj", "cape,v2.obj",
    "cape's.obj", "a=b.obj", "C:cape.obj", "裙子.obj", "é!.obj", "cape [2].obj", '5" hem.obj', "\udce4.obj",
    "2024_01", "007", "1e3",
)  # fmt: skip


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("key", ["garment", "output", "texture", "body"])
def test_a_name_needs_no_quotes_but_those_of_the_shell(key: str, name: str) -> None:
    assert plain(load_config("rollout", [f"{key}={name}"])[key]) == name
    assert with_words(load_config("rollout"), [f"{key}={name}"])[key] == name


@pytest.mark.parametrize("name", [*NAMES, "[x] cape.obj", "'tis.obj", "smile :).obj", "a,b", "tank,skirt"])
def test_what_there_is_goes_before_every_other_meaning(name: str) -> None:
    Path(name).parent.mkdir(exist_ok=True)
    Path(name).touch()
    assert load_config("rollout", [f"garment={name}"]).garment == name


@pytest.mark.parametrize("name", [*NAMES, "dress", "12", "null", "[x]", "'tis.obj", "a,b", "a\\,b.obj", "${x", "ends\\"])
def test_a_printed_word_gives_its_value_back(name: str) -> None:
    if name == "${x":
        assert plain_word("garment", name) == "garment='${x'"
        return
    assert str(load_config("rollout", [plain_word("garment", name)]).garment) == name


def test_a_printed_word_has_no_more_quotes_than_it_needs() -> None:
    assert plain_word("garment", "out/cape (1).obj") == "garment=out/cape (1).obj"
    assert plain_word("garment", "null") == "garment='null'"


@pytest.mark.parametrize(
    ("word", "value"),
    [
        ("garment=[tank,Röckchen.obj]", ["tank", "Röckchen.obj"]),
        ("garment=[cape (1,2).obj, cape's.obj,'a,b',\"c'd\",it's]", ["cape (1,2).obj", "cape's.obj", "a,b", "c'd", "it's"]),
        ("garment=[ö,[1,2.5],null,true]", ["ö", [1, 2.5], None, True]),
        ("fabrics={Schößchen:denim,a b:{material:größer, density:1},red@karte ö.png:silk}",
         {"Schößchen": "denim", "a b": {"material": "größer", "density": 1}, "red@karte ö.png": "silk"}),
        ("fabrics={'ns:front':silk,tank#2:denim}", {"ns:front": "silk", "tank#2": "denim"}),
        ("texture={Röckchen:karo ö.png}", {"Röckchen": "karo ö.png"}),
        ("events=[{time: 0.5, open: Knöpfe}]", [{"time": 0.5, "open": "Knöpfe"}]),
        ("garment='a=b.obj'", "a=b.obj"),
        ("output=${seed} ö", "0 ö"),
        ("betas=null", None),
        ("betas=[]", []),
    ],
)  # fmt: skip
def test_lists_tables_and_quotes_are_read_as_such(word: str, value: object) -> None:
    key = word.partition("=")[0]
    assert plain(load_config("rollout", [word])[key]) == value
    assert plain(with_words(load_config("rollout"), [word])[key]) == value


@pytest.mark.parametrize(
    ("word", "told"),
    [
        ("garment=dress,skirt", "garment=dress,skirt: several values stand in brackets, garment=[dress,skirt]; a name that"),
        ("garment=dres,skirt", "garment=[dres,skirt]"),
        ("garment=Röckchen.obj,tank.obj", "garment=[Röckchen.obj,tank.obj]"),
        ("refine=most:9", "refine=most:9: the shell has taken the braces apart; put the word in quotes, 'refine={most:9,…}'"),
        ("betas=1,-0.5", "betas=1,-0.5: several values stand in brackets, betas=[1,-0.5]"),
        ("wind=1,ö,3", "several values stand in brackets, wind=[1,ö,3]"),
        ("objects='a','b'", "objects='a','b': several values stand in brackets"),
        ("sequence=plie,jog", "sequence=[plie,jog]: give one text, not a list"),
        ("num_frames=1,2", "num_frames=1,2: a command takes one value of a key"),
        ("garment=range(1,3)", "a command takes one value of a key, a loop of the shell"),
        ("garment=[tank,ö", "'garment=[tank,ö': close every bracket"),
        ("garment=tank,ö]", "close every bracket"),
        ("garment=cape (1.obj", "'garment=cape (1.obj': close every bracket"),
        ("garment='ö", "close every bracket and quote"),
        ("garment=[tank,,ö]", "a value is missing beside a comma"),
        ("fabrics={ö:}}", "close every bracket"),
        ("gärment=dress", "'gärment' cannot be a key"),
        ("material=Loden ö", "unknown material 'Loden ö'"),
        ("fabrics.ö=silk", "'fabrics.ö' cannot be a key"),
    ],
)
def test_what_cannot_be_read_is_told_with_its_own_reason(word: str, told: str) -> None:
    with pytest.raises(ConfigError) as error:
        load_config("rollout", [word])
    assert told in str(error.value)
    assert "\n" not in str(error.value)


def test_numbers_alone_are_no_name() -> None:
    with pytest.raises(ConfigError) as error:
        load_config("rollout", ["size=0.9,1.1"])
    assert "name" not in str(error.value)


def test_tables_of_python_take_names_of_every_alphabet() -> None:
    fabrics = {"Schößchen": "silk", "red@karte.png": "denim", "Scho\u0308n": "linen"}
    assert plain(load_config("rollout", api.overrides({"fabrics": fabrics})).fabrics) == fabrics
