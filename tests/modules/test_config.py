from __future__ import annotations

from typing import Any

import pytest

from vusfa.errors import ConfigError
from vusfa.modules import ARCHITECTURES, MODELS, resolve_config


class TestTables:
    def test_each_model_adds_one_idea(self) -> None:
        """GVF, + psi . omega, + SFDP, + bottleneck."""
        assert [sum(MODELS[model][:3]) for model in ("gvf", "usfa", "sfdp", "vusfa")] == [0, 1, 2, 3]

    def test_controlled_models_differ_in_nothing_but_their_idea(self) -> None:
        """All fields agree, except those that only the bottleneck reads."""
        configs = [vars(resolve_config(model)) for model in MODELS]
        of_the_bottleneck = {"scale", "initial_scale", "eval_latent"}
        for name in set(configs[0]) - {"model"} - of_the_bottleneck:
            assert len({config[name] for config in configs}) == 1, name

    def test_the_released_codes_quirks(self) -> None:
        reference = {model: resolve_config(model, "reference") for model in MODELS}
        assert [reference[model].history for model in MODELS] == [4, 4, 4, 1]
        assert [reference[model].shared_encoder for model in MODELS] == [True, False, True, True]
        assert [reference[model].embedding_layer for model in MODELS] == [False, True, True, True]
        assert [reference[model].state_layer for model in MODELS] == [False, False, False, True]
        assert [reference[model].rectify_logits for model in MODELS] == [False, False, False, True]
        assert reference["vusfa"].scale == "raw"

    def test_the_paper_samples_at_inference(self) -> None:
        assert resolve_config("vusfa", "paper").eval_latent == "sample"
        assert resolve_config("vusfa").eval_latent == "mean"
        assert resolve_config("vusfa", "paper").history == 4


class TestOverrides:
    def test_taken(self) -> None:
        config = resolve_config("sfdp", history=2, successor_norm=None)
        assert (config.history, config.successor_norm) == (2, None)

    def test_memory_needs_no_history(self) -> None:
        assert resolve_config("usfa", memory="lstm").history == 1
        assert resolve_config("usfa", memory="lstm", history=3).history == 3
        assert resolve_config("usfa", memory=None).history == 4

    def test_pixels_bring_convolutions(self) -> None:
        assert not resolve_config("usfa", observation="pixels").normalize_features
        assert resolve_config("usfa", observation="pixels").encoder == "conv"
        assert resolve_config("usfa", encoder="conv", picture_size=[40, 50]).picture_size == (40, 50)

    @pytest.mark.parametrize("architecture", ARCHITECTURES)
    @pytest.mark.parametrize("model", MODELS)
    def test_what_a_config_holds_builds_it_again(self, model: str, architecture: str) -> None:
        """Checkpoints hold all fields; given back, none of them is refused."""
        config = resolve_config(model, architecture)
        assert resolve_config(**vars(config)) == config

    @pytest.mark.parametrize(
        ("settings", "message"),
        [
            ({"model": "vufsa"}, "model is 'vufsa'; did you mean 'vusfa'"),
            ({"model": "dqn"}, "model is 'dqn'; there are gvf, usfa, sfdp, vusfa"),
            ({"architecture": "control"}, "architecture is 'control'; did you mean 'controlled'"),
            ({"embeding_size": 3}, "no field 'embeding_size'; did you mean 'embedding_size'"),
            ({"beta": 3}, "no field 'beta'; there are history, "),
            ({"history": 0}, "history is 0; it must be a whole number"),
            ({"history": 2.5}, "history is 2.5; it must be a whole number"),
            ({"hidden_size": True}, "hidden_size is True; it must be a whole number"),
            ({"hidden_size": 10**12}, "hidden_size is 1000000000000; it must be at most 65,536"),
            ({"history": 10**9}, "history is 1000000000; it must be at most 65,536"),
            ({"shared_heads": "yes"}, "shared_heads is 'yes'; it must be True or False"),
            ({"deduplicate": 1}, "deduplicate is 1; it must be True or False"),
            ({"successor_scale": float("nan")}, "successor_scale is nan; it must be a finite number"),
            ({"initial_scale": "1"}, "initial_scale is '1'; it must be a finite number"),
            ({"eval_latent": "means"}, "eval_latent is 'means'; did you mean 'mean'"),
            ({"observation": "feature"}, "observation is 'feature'; did you mean 'features'"),
            ({"observation": "features", "encoder": "conv"}, "'features' does not go with encoder 'conv'"),
            ({"observation": "pixels", "encoder": "mlp"}, "'pixels' does not go with encoder 'mlp'"),
            ({"encoder": "conv", "normalize_features": True}, "normalize_features is for precomputed"),
            ({"embedding_layer": False}, "embedding_layer is False, but the bottleneck"),
            ({"model": "gvf", "embedding_layer": False, "embedding_size": 8}, "they must be equal"),
            (
                {"architecture": "paper", "successor_norm": "layer"},
                "successor_norm is no part of",
            ),
            (
                {"architecture": "reference", "normalize_features": True},
                "no part of architecture 'ref",
            ),
            (
                {"architecture": "reference", "reward_scale": 0.5},
                "reward_scale is no part of",
            ),
            ({"picture_size": 60}, "picture_size is 60"),
            ({"picture_size": [60]}, r"picture_size is \[60\]"),
        ],
        ids=str,
    )
    def test_errors_name_the_culprit(self, settings: dict[str, Any], message: str) -> None:
        with pytest.raises(ConfigError, match=message):
            resolve_config(**{"model": "vusfa", **settings})
