"""Models and engines as the configs have them: what a figure tells is what a user gets."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any

from inference.posterior import Posterior


def made(words: list[str], *groups: str, root: str = "run") -> tuple[Any, ...]:
    """What these groups of the config make that the words compose: models, engines that wait for their arguments.

    root  the config that the words are for: of experiments.run or experiments.drive"""
    from hydra import compose, initialize_config_module
    from omegaconf import OmegaConf

    from experiments.schema import build

    with initialize_config_module("configs", version_base="1.3"):
        config = compose(root, words)
    return tuple(build(OmegaConf.to_container(config[group], resolve=True), group) for group in groups)


@lru_cache
def configured(group: str, name: str) -> Any:
    """What the config GROUP=NAME makes: a model, or an engine that waits for its arguments."""
    return made([f"{group}={name}"], group)[0]


def quiet_engine(name: str, **knobs: Any) -> Callable[..., Posterior]:
    """The engine of the config engine=NAME with further knobs, without a progress bar."""
    engine = configured("engine", name)
    if "progress" in engine.keywords:
        knobs["progress"] = False
    return partial(engine.func, **(engine.keywords | knobs))  # Hydra's own checks its target at each call, for .3 ms
