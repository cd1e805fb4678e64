"""Keys that the chosen methods do not read are refused where they are typed; those that one of them reads are taken."""

from __future__ import annotations

from dataclasses import replace
from operator import attrgetter

import pytest

from playslot_rl.config import ExperimentConfig, to_dict
from playslot_rl.config.compose import compose, spelled
from playslot_rl.config.method_keys import chosen
from playslot_rl.config.methods import METHODS
from playslot_rl.config.plain import flatten
from playslot_rl.config.roles import declared
from playslot_rl.errors import ConfigError

LAPO_STEPS = "baselines.lapo.model.steps= or baselines.lapo.policy.steps="
LABELS = "behaviour.labelled_demos"
NONE = "none: leave it out"

TABLE = {  # of each method: a key that it reads, others that it does not, and what is said instead
    "playslot": ("behaviour.labelled_demos", {"baselines.act.optim.lr": "behaviour.optim.lr"}),
    "slot_oracle": ("behaviour.trim", {LABELS: "demos", "dynamics.steps": "behaviour.steps"}),
    "slot_bc": ("behaviour.log_every", {LABELS: "demos", "baselines.act.steps": "behaviour.steps"}),
    "resnet_oracle": ("behaviour.loss", {LABELS: "demos", "behaviour.trim": NONE}),
    "resnet_bc": ("baselines.resnet_oracle.shift", {LABELS: "demos", "behaviour.shift": "baselines.resnet_oracle.s"}),
    "history_bc": ("baselines.resnet_oracle.history", {LABELS: "demos", "baselines.laom.loss": "behaviour.loss"}),
    "act": ("baselines.act.chunk", {LABELS: "demos", "baselines.diffusion.chunk": "baselines.act.chunk"}),
    "act_state": ("baselines.act.chunk", {LABELS: "demos", "behaviour.steps": "baselines.act.steps"}),
    "diffusion": ("behaviour.trim_pixels", {LABELS: "demos", "behaviour.loss": NONE}),
    "diffusion_state": ("baselines.diffusion.steps", {LABELS: "demos", "behaviour.loss": NONE}),
    "autoencoder_bc": ("model.policy.dim", {LABELS: "demos", "baselines.lapo.hidden": NONE}),
    "inverse_bc": ("baselines.inverse_bc.hidden", {LABELS: "demos", "behaviour.decoder_lr": NONE}),
    "slot_vpt": ("behaviour.decoder_steps", {"behaviour.finetune_steps": NONE, "dynamics.steps": "behaviour.steps"}),
    "lapo": ("behaviour.policy_from", {"behaviour.steps": LAPO_STEPS, "behaviour.loss": "baselines.lapo.loss"}),
    "lapo_slots": ("behaviour.validate_every", {"behaviour.imagined": NONE, "baselines.lapo.hidden": NONE}),
    "laom": (LABELS, {"behaviour.loss": "baselines.laom.loss", "model.policy.dim": NONE}),
    "clam": ("baselines.clam.world", {"behaviour.finetune_steps": NONE, "model.policy.dim": NONE}),
    "dreamer": ("baselines.dreamer.lr", {"demos": NONE, "data.draw": NONE, LABELS: NONE}),
    "sold": ("baselines.sold.dim", {"demos": NONE, "baselines.dreamer.steps": "baselines.sold.steps"}),
    "caddy_policy": ("baselines.caddy.actions", {"baselines.caddy_oracle.shift": "baselines.caddy_policy.shift"}),
    "caddy_oracle": ("baselines.caddy.actions", {LABELS: "demos", "behaviour.decoder_state": NONE}),
    "svg": ("baselines.svg.hidden", {"demos": NONE, "dynamics.seed_frames": "baselines.svg.seed_frames"}),
    "caddy": ("baselines.caddy.steps", {LABELS: NONE, "baselines.caddy_policy.decoder_steps": NONE}),
    "slotformer": ("model.savi.slot_dim", {"model.predictor.layers": "baselines.slotformer.predictor.layers"}),
    "ocvp_seq": ("baselines.ocvp_seq.steps", {"model.predictor.layers": "baselines.ocvp_seq.predictor.layers"}),
}  # fmt: skip
VALUES = flatten(to_dict(compose())) | {"demos": 3, "data.draw": 3, "behaviour.policy_from": "runs/first"}
VALUES |= {"baselines.clam.world": "runs/first", "baselines.resnet_oracle.history": 3}


def typed(command: str, text: str) -> ExperimentConfig:
    return compose(text.split(), command)


@pytest.mark.parametrize("name", METHODS)
def test_a_method_takes_what_it_reads_and_refuses_what_it_does_not(name: str) -> None:
    read, unread = TABLE[name]
    assert typed("train-baseline", f"method={name} {read}={VALUES[read]}").method == name
    for key, instead in unread.items():
        with pytest.raises(ConfigError) as caught:
            typed("train-baseline", f"method={name} {key}={VALUES[key]}")
        said = str(caught.value)
        assert said.startswith(f"{key}: got {str(VALUES[key]).lower()} with method={name}, which does not read it")
        assert f"expected {instead}" in said
        assert "\n" not in said


@pytest.mark.parametrize("preset", ["smoke", "compact", "paper"])
def test_what_a_preset_says_is_not_typed(preset: str) -> None:
    for name in METHODS:
        assert typed("train-baseline", f"preset={preset} method={name} seed=1 data.stride=2 threads=1").seed == 1


def test_no_other_command_has_a_choice() -> None:
    for command in ("train-slots", "train-policy", "pipeline", "evaluate", ""):
        assert typed(command, "behaviour.labelled_demos=10 slots.steps=3").slots.steps == 3


@pytest.mark.parametrize(
    "text",
    [
        "methods=slot_oracle,playslot demos=20 behaviour.labelled_demos=10",
        "methods=playslot slots.steps=3 dynamics.steps=3 model.savi.token_dim=8",
        "methods=slot_bc labels=5 slots.steps=3 model.savi.n_slots=3",
        "methods=resnet_bc,slot_oracle labels=5",
    ],
)
def test_a_comparison_takes_what_one_of_its_methods_reads(text: str) -> None:
    assert typed("compare", text).compare.methods


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            "methods=resnet_bc,act labels=5 behaviour.labelled_demos=10",
            "behaviour.labelled_demos: got 10 with methods=resnet_bc,act, which do not read it, expected labels=",
        ),
        (
            "methods=playslot,lapo labels=5 behaviour.labelled_demos=10",
            "got 10 with methods=playslot,lapo, which do not read it, expected labels=",
        ),
        ("methods=slot_oracle behaviour.labelled_demos=10", "expected demos="),
        ("methods=resnet_oracle dynamics.steps=3", "expected baselines.resnet_oracle.steps="),
        ("methods=dreamer demos=5", "demos: got 5 with methods=dreamer, which does not read it"),
        ("methods=slot_oracle labels=5", "labels: got 5 with methods=slot_oracle, which does not read it"),
        ("methods=playslot,lapo baselines.act.chunk=5", f"expected {NONE}"),
    ],
)
def test_a_comparison_refuses_what_none_of_its_methods_reads(text: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        typed("compare", text)


def test_a_comparison_of_videos_trains_no_policy() -> None:
    assert typed("compare-video", "methods=svg,playslot_m dynamics.steps=3 slots.steps=3").dynamics.steps == 3
    with pytest.raises(ConfigError, match="got 3 with methods=svg,playslot_m, which do not read it"):
        typed("compare-video", "methods=svg,playslot_m behaviour.steps=3")
    with pytest.raises(
        ConfigError, match=r"^dynamics\.steps: got 3 with methods=svg, which does not read it, expected b"
    ):
        typed("compare-video", "methods=svg dynamics.steps=3")


def test_the_command_of_a_comparisons_job_names_what_its_method_reads_alone() -> None:
    own = typed("compare", "methods=resnet_bc,act labels=5 baselines.act.chunk=5 baselines.resnet_oracle.shift=3")
    behaviour = replace(own.behaviour, labelled_demos=5, oracle=False)
    job = replace(own, method="resnet_bc", demos=5, behaviour=behaviour, out="runs/job")
    arguments = spelled(job, "train-baseline")
    assert {"method=resnet_bc", "demos=5", "baselines.resnet_oracle.shift=3"} <= {*arguments}
    assert not any("act.chunk" in word or word.startswith("behaviour.") for word in arguments)
    again = compose(arguments, "train-baseline")
    assert (again.demos, again.baselines.resnet_oracle) == (5, own.baselines.resnet_oracle)


def test_every_key_of_the_shared_groups_is_read_by_a_method() -> None:
    everything = [chosen(replace(compose(), method=name), "train-baseline") for name in METHODS]
    everything.append(chosen(typed("compare", "methods=playslot"), "compare"))
    keys = [key for key in VALUES if key.partition(".")[0] in ("model", "slots", "dynamics", "behaviour", "baselines")]
    assert not [key for key in keys if not any(methods is not None and methods.reads(key) for methods in everything)]


@pytest.mark.parametrize("key, setter", declared(ExperimentConfig, "set_by").items())
def test_what_another_key_sets_is_not_typed(key: str, setter: str) -> None:
    value = {"model.policy.gain": 0.5, "model.action_decoder.slots": "[1]"}.get(key, "true")
    with pytest.raises(ConfigError) as caught:
        typed("train-policy", f"{key}={value}")
    assert str(caught.value) == f"{key}: got {value}, expected none: {setter}= sets it"
    attrgetter(setter)(compose())  # a key that there is
