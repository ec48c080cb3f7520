"""Settings: from a name, a file, or words on the command line; a wrong one is told what is expected."""

import json
import re

import pytest

from ipjax.config import Config, OnboardConfig
from ipjax.files.settings import describe_config, list_fields, override, read_config


def test_settings_from_a_file(tmp_path):
    path = tmp_path / "settings.json"
    path.write_text('{"from": "paper", "match": {"views": 4, "cycle": 3}, "align": {"scale_gate": [0.1, 10]}}')
    config = read_config(path)
    assert (config.match.views, config.match.cycle, config.align.scale_gate) == (4, 3.0, (0.1, 10.0))
    assert config.score == Config.paper().score
    assert read_config("paper") == Config.paper() != read_config("default") == Config()
    assert read_config("fast") == Config.fast() != Config()
    with pytest.raises(ValueError, match="no settings 'slow'; there are default, fast, paper"):
        Config.named("slow")
    for text, says in (
        ('{"match": {"view": 4}}', "match: no setting 'view'"),
        ('{"match": 4}', "match holds settings of its own"),
        ('{"match": {"views": "many"}}', "views is 8 by default"),
        ('{"align": {"count": true}}', "of another kind"),
        ('{"align": {"size": 2}}', "a whole number from 3 is expected"),
        ('{"match": {"cycle": 1%s}}' % ("0" * 400), "a number is expected"),
        ('{"from": "nowhere"}', "'from' is one of default, fast, paper, not 'nowhere'"),
        ("[1]", 'a JSON object, like {"match": {"views": 4}}'),
        ('{"match": {"views": [true, null]}}', "[true, null] is of another kind"),
        ("{", "not valid JSON"),
    ):
        path.write_text(text)
        with pytest.raises(ValueError, match=re.escape(says)):
            read_config(path)
    with pytest.raises(ValueError, match="neither default, fast, paper nor a file"):
        read_config("slow")


def test_settings_are_plain_json_even_where_they_are_infinite():
    told = describe_config(Config.paper())
    assert json.loads(json.dumps(told, allow_nan=False)) == told
    assert told["match"]["cycle"] == "inf"


def test_a_configuration_survives_being_written_and_read(tmp_path):
    path = tmp_path / "settings.json"
    for config in (Config(), Config.fast(), Config.paper()):
        path.write_text(json.dumps(describe_config(config)))
        assert read_config(path) == config


def test_any_field_is_changed_by_its_path():
    changes = [
        "match.views=4",
        "match.cycle = 2",
        "match.shortlist=100",
        "match.ranking=cyclic",
        "match.centred=no",
        "align.scale_gate=0.25,inf",
        "refine.settle=false",
        "match.views=6",  # of two, the last counts
    ]
    config = read_config("default", changes)
    assert (config.match.views, config.match.cycle, config.match.shortlist) == (6, 2.0, 100)
    assert (config.match.ranking, config.match.centred, config.refine.settle) == ("cyclic", False, False)
    assert config.align.scale_gate == (0.25, float("inf"))
    assert override(["match.shortlist=none"], config).match.shortlist is None
    assert override(["directions=7", "describe.cover=0.5"], OnboardConfig()).describe.cover == 0.5
    assert read_config("fast", ["match.views=6"]) == Config.fast()


def test_every_field_takes_the_value_that_it_has():
    for config in (Config(), Config.paper(), OnboardConfig()):
        for name, value in list_fields(config):
            text = ",".join(map(str, value)) if isinstance(value, tuple) else str(value)
            assert override([f"{name}={text}"], config) == config, name


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ("match.view=4", "there is no setting 'match.view'; near it: match.views"),
        ("views=4", "there is no setting 'views'; near it: match.views, resect.views, score.views"),
        ("view=4", "near it: match.views"),
        ("mach.views=4", "near it: match.views"),
        ("macth=4", "near it: match"),
        ("colour=red", "there is no setting 'colour'; there are match, align, refine, resect, score, confidence"),
        ("match.colour=red", "there is no setting 'match.colour'; there are match.ranking, match.centred"),
        ("match=4", "match is a group of settings: name one of them, for instance match."),
        ("match.views.more=4", "match.views is one value, not a group"),
        ("match.views", "give FIELD=VALUE, for instance match.views=8"),
        ("=4", "give FIELD=VALUE"),
        ("match.views=", "give FIELD=VALUE"),
        ("match.views=four", "match.views: a whole number from 1 is expected, for instance 8, not 'four'"),
        ("match.views=4.5", "a whole number from 1 is expected"),
        ("match.views=0", "match.views: a whole number from 1 is expected, for instance 8, not '0'"),
        ("refine.steps=-1", "a whole number from 0 is expected"),
        ("match.cycle=long", "match.cycle: a number is expected, for instance 1.5, not 'long'"),
        ("match.cycle=nan", "a number is expected"),
        ("match.centred=2", "true or false is expected"),
        ("match.ranking=best", "'cyclic' or 'cosine' is expected"),
        ("match.shortlist=few", "a whole number from 1 or none is expected"),
        ("align.scale_gate=0.5", "align.scale_gate: a list of 2 numbers is expected, for instance 0.5,2.0, not '0.5'"),
        ("align.scale_gate=0.5,big", "a list of 2 numbers is expected"),
    ],
)
def test_a_change_that_cannot_be_made_is_told_what_can(change, says):
    with pytest.raises(ValueError, match=re.escape(says)):
        override([change], Config())
