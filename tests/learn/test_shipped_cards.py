"""The command on the card of each shipped policy repeats its training: environment, seed, arguments and settings."""

import json
import re
import shlex

import pytest
from toy import jobs

from ce_gym.learn.training import learner_of
from ce_gym.policies import load_policy, shelf, shipped_policies


@pytest.mark.parametrize("name", shipped_policies())
def test_the_command_on_the_card_repeats_the_training(name):
    record, text = load_policy(name).record, (shelf() / name / "card.md").read_text()
    found = re.search(r"^Trained by\n\n```sh\n(.*)\n```$", text, re.MULTILINE)
    if record["resumed_from"]:
        assert found is None
        assert "No single command repeats it: resumed from" in text
        return
    program, words = shlex.split(found[1])[:4], shlex.split(found[1])[4:]
    assert program == ["python", "-m", "ce_gym", "train"]
    (job,) = jobs(*words)
    assert (job.algo, job.env_id, job.seed) == (learner_of(record), record["env"], record["seed"])
    assert job.env_kwargs == record["env_kwargs"]
    settings = json.loads(json.dumps(job.settings.as_dict()))
    trained = record["settings"] | {"steps": min(record["settings"]["steps"], record["steps"])}
    assert {key: settings[key] for key in trained} == trained
